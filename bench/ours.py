"""This library under the protocol of `bench.processes`: LPAL, planning, occupancies and values of policies.

Lanes that are loaded together go into one call with a leading axis, a lane alone into one without.
"""

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

import jaxhom  # noqa: E402
from bench import instances  # noqa: E402


class _Solver:
    """Calls `function(mdp, *lane)`; `read_off` makes (answers, statuses, methods, iterations) of what it returns."""

    def __init__(self, mdp: jaxhom.MDP, function, read_off):
        self._mdp, self._function, self._read_off = jax.block_until_ready(mdp), function, read_off

    def load(self, lanes: list) -> None:
        """Puts the lanes where the library wants them."""
        lanes = [lane if isinstance(lane, tuple) else (lane,) for lane in lanes]
        arrays = [jnp.asarray(np.stack(parts)) for parts in zip(*lanes, strict=True)]
        self._alone, self._count = len(lanes) == 1, len(lanes)
        self._lane = jax.block_until_ready([array[0] for array in arrays] if self._alone else arrays)

    def solve(self, limit: float):
        """What the library returns. It knows no time limit."""
        del limit
        return jax.block_until_ready(self._function(self._mdp, *self._lane))

    def read(self, found) -> list:
        """Answers, the library's words and iterations, lane by lane."""
        parts = self._read_off(jax.tree.map(np.asarray, found))
        parts = jax.tree.map(lambda leaf: np.asarray(leaf)[None] if self._alone else np.asarray(leaf), parts)
        lanes = [jax.tree.map(lambda leaf, k=k: leaf[k], parts) for k in range(self._count)]
        return [(answer, _words(status, method), int(iterations or 0)) for answer, status, method, iterations in lanes]


def _words(status: np.ndarray | None, method: np.ndarray | None) -> str:
    """How a lane ended, and which method decided it where the library says so."""
    words = [] if status is None else [jaxhom.Status(int(status)).name]
    words += [] if method is None else [f"by {jaxhom.LPALMethod(int(method)).name.lower()}"]
    return " ".join(words)


def lpal(name: str, method: str | None, tolerance: float | None = None, **_) -> _Solver:
    """LPAL on an instance; a lane is (expectations,), its answer (x, w). The default tolerance if None."""
    options = {} if method is None else {"method": method}

    def read_off(found):
        return (found.occupancy, found.weights), found.status, getattr(found, "decided_by", None), found.iterations

    return _Solver(
        instances.LPAL[name].build(),
        lambda mdp, expectations: jaxhom.lpal(mdp, expectations, tolerance=tolerance, **options),
        read_off,
    )


def planning(name: str, work: str, tolerance: float, **_) -> _Solver:
    """Planning and evaluation on an instance; a lane is a reward and a policy, its answer that of `planning_peers`."""
    mdp = instances.PLANNING[name][1]()
    if work == "planning":
        return _Solver(
            mdp,
            lambda mdp, reward, _: jaxhom.optimal_policy(mdp, reward, tolerance=tolerance),
            lambda found: (found.policy.argmax(axis=-1), None, None, found.iterations),
        )
    if work == "occupancy":
        return _Solver(mdp, lambda mdp, _, policy: jaxhom.occupancy(mdp, policy), lambda x: (x, None, None, None))
    return _Solver(mdp, lambda mdp, r, policy: jaxhom.policy_value(mdp, policy, r), lambda v: (v, None, None, None))
