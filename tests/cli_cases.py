"""One small problem for the tests of the command line, in every form that it takes: FrozenLake's 4x4 map.

All forms have the same shapes, so that what is compiled for one serves the others.
"""

import json

import numpy as np
import oracles
from small_models import dense_transition

from jaxhom.interop import from_gymnasium, load_policy, save_mdp

LAKE = "FrozenLake-v1"
STATES, ACTIONS = 16, 4
TRACK = "S..F\n"
STEPS = [("a", 0, 1), ("a", 4, 1), ("b", 0, 1), ("b", 4, 1), ("b", 8, 2), ("b", 9, 1), ("b", 10, 1), ("b", 14, 2)]
"""Episode, state and action of the demonstrations in files."""
VISITED = [0, 4, 8, 9, 10, 14]


class Files:
    """A folder with the problem in it."""

    def __init__(self, folder):
        self.folder = folder
        self.lake = from_gymnasium(LAKE, discount=0.99)
        self.write_model()
        self.write_demonstrations()
        self["a.track"].write_text(TRACK)
        lines = [f"{episode},{state},{action}" for episode, state, action in STEPS]
        self["demos.csv"].write_text("\n".join(["episode,state,action", *lines, ""]))

    def __getitem__(self, name):
        return self.folder / name

    def path(self, name):
        return str(self[name])

    def write_model(self, **changes):
        """The lake as arrays, with the given ones exchanged, or left out if None."""
        save_mdp(self["model.npz"], self.lake.mdp)
        with np.load(self["model.npz"]) as archive:
            arrays = dict(archive)
        arrays |= {"reward": np.asarray(self.lake.reward), "terminal": np.asarray(self.lake.terminal)}
        arrays["coordinates"] = np.stack(np.divmod(np.arange(STATES), 4), axis=1)
        self._write("model.npz", arrays, changes)

    def write_demonstrations(self, **changes):
        """The same steps as in the table."""
        states, actions = [[0, 4, 0, 0, 0, 0], [0, 4, 8, 9, 10, 14]], [[1, 1, 0, 0, 0, 0], [1, 1, 2, 1, 1, 2]]
        self._write("demos.npz", {"states": states, "actions": actions, "length": [2, 6]}, changes)

    def _write(self, name, arrays, changes):
        arrays = {**arrays, **changes}
        np.savez(self[name], **{key: array for key, array in arrays.items() if array is not None})

    def options(self, output="out"):
        """Of the command `learn`, for the files."""
        model, demonstrations = self.path("model.npz"), self.path("demos.npz")
        return ["--mdp", model, "--demonstrations", demonstrations, "--output", self.path(output)]

    def arrays(self, name):
        """The contents of an archive."""
        with np.load(self[name]) as archive:
            return dict(archive)

    def policy(self, name="out/policy.npz"):
        return load_policy(self[name])

    def report(self, name="out/report.json"):
        return json.loads(self[name].read_text())


TRAJECTORIES = [([s for e, s, _ in STEPS if e == name], [a for e, _, a in STEPS if e == name]) for name in "ab"]


def lake_transition(files):
    return dense_transition(files.lake.mdp)


def values(files, policies):
    """Discounted values from the start, and the largest that there is, by the oracle."""
    mdp, reward = files.lake.mdp, np.asarray(files.lake.reward)
    initial, transition = np.asarray(mdp.initial), lake_transition(files)
    best, _ = oracles.optimal_value(transition, 0.99, reward)
    return [oracles.policy_value(transition, 0.99, policy, reward) @ initial for policy in policies], best @ initial
