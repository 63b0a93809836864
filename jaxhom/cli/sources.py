"""What the commands work on: a model with what is known of it, trajectories and policies, from wherever they come.

Whatever is wrong with a source is one `ValueError` that names it (and line, column, array or row), before anything
is computed.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import os
import sys
import warnings
from collections.abc import Hashable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom import checks
from jaxhom.cli.options import environment_options
from jaxhom.domains.racetrack import Racetrack, racetrack
from jaxhom.domains.tile_map import TileMap
from jaxhom.domains.track_maps import SHIPPED
from jaxhom.interop.csv_steps import demonstrations_from_csv
from jaxhom.interop.environment_makers import make_environment
from jaxhom.interop.environment_maps import tile_map
from jaxhom.interop.environment_tables import require_steps_of_table
from jaxhom.interop.environments import from_gymnasium
from jaxhom.interop.files import FileError, load_arrays, load_demonstrations, load_mdp, load_policy
from jaxhom.models.demonstrations import Demonstrations, sample_demonstrations
from jaxhom.models.impossible_steps import ImpossibleStepsWarning
from jaxhom.models.inputs import check_coordinates, check_policy
from jaxhom.models.mdp import MDP, absorbing_states
from jaxhom.models.names import look_up
from jaxhom.planning.optimal import Plan, optimal_policy
from jaxhom.similarity.table import SimilarityTable

_DISCOUNT = 0.99  # as the domains of the library
_TRACK_STEPS = 20  # of a demonstration on a racetrack, and of a trial below, as in the paper
_TRACK_TRIAL = 30
_STEPS = 100  # of either, where the source has no limit


@dataclasses.dataclass(frozen=True, eq=False)
class Problem:
    """A model and what else its source knows.

    Attributes:
      name: the source, for messages and tables.
      mdp: the model.
      trial: steps of a trial, unless told otherwise.
      demonstration: steps of a sampled demonstration, unless told otherwise.
      reward: [S, A], or None where it is not known.
      terminal: bool [S], states in which an episode ends; None if there are none.
      off_road: [S, A], on racetracks: the probability of leaving the road.
      coordinates: [S, D], or None.
      domain: what pictures are drawn on; None for models without a map.
    """

    name: str
    mdp: MDP
    trial: int = _STEPS
    demonstration: int = _STEPS
    reward: jax.Array | None = None
    terminal: np.ndarray | None = None
    off_road: jax.Array | None = None
    coordinates: np.ndarray | None = None
    domain: Racetrack | TileMap | None = None

    @functools.cached_property
    def plan(self) -> Plan:
        """An optimal policy.

        Raises:
          ValueError: if no reward is known.
        """
        if self.reward is None:
            raise ValueError(f"{self.name} has no reward (array 'reward')")
        return optimal_policy(self.mdp, self.reward)

    def similarity(self, distance: int = 1, *, anchored: bool = True, **compared: Any) -> SimilarityTable:
        """The table of the model's local models, one for all sets of demonstrations: no pair is solved again.

        What else is `compared`, labels and the relation, is the same in all calls.
        """
        key = distance, anchored
        if key not in self._tables:
            self._tables[key] = SimilarityTable(self.mdp, distance=distance, anchored=anchored, **compared)
        return self._tables[key]

    @functools.cached_property
    def _tables(self) -> dict[tuple[int, bool], SimilarityTable]:
        return {}

    def labels(self, source: str) -> np.ndarray:
        """The labels that a user means: the model's `features` or `reward`, or a file.

        Raises:
          ValueError: if the model has none of these; naming the file if it cannot be read.
        """
        if source == "features":
            if not self.mdp.num_features:
                raise ValueError(f"--labels features: {self.name} has none")
            return np.asarray(self.mdp.features)
        if source == "reward":
            if self.reward is None:
                raise ValueError(f"--labels reward: {self.name} has none (array 'reward')")
            return np.asarray(self.reward)
        try:
            array = np.load(source, allow_pickle=False)
        except OSError as error:
            raise FileError(f"--labels {source}: not features or reward, and no .npy file: {error.strerror}") from None
        except (ValueError, EOFError):
            raise FileError(f"--labels {source}: not features or reward, and no .npy file of numbers") from None
        if not isinstance(array, np.ndarray):
            raise FileError(f"--labels {source}: must be an .npy file of a single array")
        return array

    @property
    def events(self) -> dict[str, Any]:
        return {} if self.off_road is None else {"off_road": self.off_road}

    def state_of(self, text: str) -> int:
        """The state that a user means: `12`, on maps `row,column`, on racetracks `row,column,down,right` with a speed.

        Of models whose states have names it is a name, tuples without parentheses, or else a number.

        Raises:
          ValueError: if there is no such state.
        """
        if self.mdp.state_names is not None:
            by_text: dict[Hashable, int] = {
                plain_text(name): number for number, name in enumerate(self.mdp.state_names)
            }
            if text in by_text or not text.isdigit():
                return look_up("state", by_text, text)
        try:
            numbers = [int(part) for part in text.split(",")]
        except ValueError:
            raise ValueError(f"state {text!r} must be a number, or numbers with commas between them") from None
        if len(numbers) == 1:
            if not 0 <= numbers[0] < self.mdp.num_states:
                raise ValueError(f"state {text} must lie in [0, {self.mdp.num_states})")
            return numbers[0]
        if isinstance(self.domain, Racetrack) and len(numbers) == 4:
            return self.domain.state_of(numbers[:2], numbers[2:])
        if self.domain is not None and len(numbers) == 2:
            return self.domain.state_of(numbers)
        raise ValueError(f"state {text!r}: {self.name} numbers its states from 0 to {self.mdp.num_states - 1}")


def plain_text(name: Hashable) -> str:
    """A name as people type it: tuples without parentheses and blanks."""
    return ",".join(map(str, name)) if isinstance(name, tuple) else str(name)


def load_problem(options: argparse.Namespace) -> Problem:
    """The model of `--env` or `--mdp`.

    Raises:
      ValueError: naming the source and what is wrong with it.
      ImportError: if an optional library is missing.
    """
    if options.discount is not None and not 0.0 < options.discount < 1.0:
        raise ValueError(f"--discount must lie strictly between 0 and 1, got {options.discount}")
    if options.env:
        return _environment(options)
    if options.end_state:
        raise ValueError("--end-state belongs to --env")
    path = options.mdp
    kind = os.path.splitext(path)[1].lower()
    if path not in SHIPPED and not os.path.exists(path):
        raise FileError(f"{path}: no such file")
    if path in SHIPPED or kind in (".track", ".txt"):
        return racetrack_problem(path, options.discount)
    if kind == ".npz":
        return _archive(path, options.discount)
    raise FileError(f"{path}: models are .npz archives or .track maps; {' and '.join(SHIPPED)} come with the library")


def _environment(options: argparse.Namespace) -> Problem:
    name, *words = options.env
    arguments = environment_options(words)
    env = make_environment(name, **arguments)
    try:
        discount = _DISCOUNT if options.discount is None else options.discount
        model = from_gymnasium(env, discount=discount, end_state=options.end_state)
        require_steps_of_table(env)
        domain, limit = tile_map(env, model.mdp), (env.spec and env.spec.max_episode_steps) or _STEPS
    except ValueError as error:
        raise ValueError(f"{name}: {str(error).replace('end_state=True', '--end-state')}") from None
    finally:
        env.close()
    return Problem(
        name=name + "".join(f" {word}" for word in words),
        mdp=model.mdp,
        trial=limit,
        demonstration=limit,
        reward=model.reward,
        terminal=np.asarray(model.terminal) if model.terminal.any() else None,
        coordinates=None if domain is None else domain.coordinates,
        domain=domain,
    )


def racetrack_problem(path: str, discount: float | None = None) -> Problem:
    """A racetrack: one that comes with the library, or the file of a map; 0.99 if no discount is given.

    Raises:
      FileError: naming the file and what is wrong with its map.
      OSError: if there is no such file.
    """
    try:
        track = racetrack(path, discount=_DISCOUNT if discount is None else discount)
    except ValueError as error:
        raise FileError(f"{path}: {error}") from None
    return Problem(
        name=f"racetrack {path}",
        mdp=track.mdp,
        trial=_TRACK_TRIAL,
        demonstration=_TRACK_STEPS,
        reward=track.mdp.features @ track.weights,
        terminal=np.asarray(track.terminal),
        off_road=track.off_road,
        coordinates=np.asarray(track.coordinates),
        domain=track,
    )


def _archive(path: str, discount: float | None) -> Problem:
    mdp = load_mdp(path, discount=discount)
    arrays = load_arrays(path, "reward", "coordinates", "terminal")
    try:
        known: dict[str, Any] = {name: _CHECKS[name](mdp, array) for name, array in arrays.items()}
    except ValueError as error:
        raise FileError(f"{path}: {error}") from None
    return Problem(name=path, mdp=mdp, **known)


def _reward(mdp: MDP, reward: np.ndarray) -> jax.Array:
    states, actions = mdp.num_states, mdp.num_actions
    good = reward.shape in ((states,), (states, actions))
    checks.require_shape("reward", reward, f"({states}, {actions}) or ({states},)", good)
    reward = checks.require_floats_in(mdp.dtype, "reward", reward)
    return jnp.broadcast_to(checks.to_device(reward.reshape(states, -1)), (states, actions))


def _terminal(mdp: MDP, terminal: np.ndarray) -> np.ndarray:
    checks.require_shape("terminal", terminal, f"({mdp.num_states},)", terminal.shape == (mdp.num_states,))
    if terminal.dtype != bool:
        raise ValueError(f"terminal must be bool, got dtype {terminal.dtype}")
    starts = np.asarray(mdp.initial) > 0
    checks.require_all("terminal", terminal, ~(terminal & starts), "must be False where episodes start")
    return terminal


_CHECKS = {"reward": _reward, "coordinates": check_coordinates, "terminal": _terminal}


def load_trajectories(problem: Problem, options: argparse.Namespace) -> tuple[Demonstrations, str]:
    """The demonstrations of `--demonstrations` or `--expert`, and where they come from, in words.

    Raises:
      ValueError: naming the file, and line and column or the array's entry; or if no expert is known.
    """
    if options.expert:
        return _sample(problem, options), f"sampled from the optimal policy (seed {options.seed})"
    if options.steps is not None:
        raise ValueError("--steps belongs to --expert")
    return load_demonstrations_of(problem, options.demonstrations, options.impossible)


def load_demonstrations_of(problem: Problem, path: str, impossible: str = "refuse") -> tuple[Demonstrations, str]:
    """Trajectories in the problem's model, from a .csv or .npz file, and what was read, in words.

    Steps of probability 0 are refused, told on stderr ("warn") or let pass ("ignore").

    Raises:
      FileError: naming the file, and line and column or the array's entry.
    """
    origin = path
    if path.lower().endswith(".csv"):
        demonstrations, report = demonstrations_from_csv(path, mdp=problem.mdp)
        origin = "; ".join([path, *str(report).splitlines()])
    else:
        demonstrations = load_demonstrations(path)
    try:
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always", ImpossibleStepsWarning)
            demonstrations.validate(problem.mdp, impossible)
    except ValueError as error:
        raise FileError(f"{path}: {error}") from None
    for warning in told:
        print(f"jaxhom: warning: {path}: {warning.message}", file=sys.stderr)
    warnings.simplefilter("ignore", ImpossibleStepsWarning)  # it has been decided once
    return demonstrations, origin


def _sample(problem: Problem, options) -> Demonstrations:
    """Trajectories of the optimal policy, each up to the end of its episode."""
    if problem.reward is None:
        raise ValueError(f"--expert needs a reward, and {problem.name} has none (array 'reward'): use --demonstrations")
    steps = options.steps or problem.demonstration
    key = jax.random.key(options.seed)
    samples = sample_demonstrations(key, problem.mdp, problem.plan.policy, options.expert, steps)
    if problem.terminal is None:
        return samples
    if np.asarray(absorbing_states(problem.mdp))[problem.terminal].all():
        ends = checks.to_device(problem.terminal)
        return sample_demonstrations(key, problem.mdp, problem.plan.policy, options.expert, steps, terminal=ends)
    ended = np.cumsum(problem.terminal[np.asarray(samples.states)], axis=1) > 0
    lengths = (~ended).sum(axis=1)  # at least 1: no episode starts in a terminal state
    rows = zip(np.asarray(samples.states), np.asarray(samples.actions), lengths, strict=True)
    return Demonstrations.from_trajectories([(states[:n], actions[:n]) for states, actions, n in rows])


def load_policy_of(problem: Problem, path: str) -> np.ndarray:
    """A policy [S, A] of the problem's model.

    Raises:
      FileError: naming the file, if it holds no policy or that of another model.
    """
    policy = load_policy(path)
    shape = (problem.mdp.num_states, problem.mdp.num_actions)
    if policy.shape != shape:
        raise FileError(f"{path}: its policy is {policy.shape}, but {problem.name} has {shape} states and actions")
    try:
        return np.asarray(check_policy(problem.mdp, policy, batch=False))
    except ValueError as error:
        raise FileError(f"{path}: {error}") from None
