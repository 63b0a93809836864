"""What a method of LPAL answers, `Found`, and what the caller gets, `LPALSolution`."""

from __future__ import annotations

import dataclasses
import enum
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxhom.planning.occupancy import NO_OCCUPANCY
from jaxhom.status import Record

if TYPE_CHECKING:
    from jaxtyping import Array, Float, Int


RARE_STATES = 1e-14
"""Share of all time that counts as none in mixtures of policies: they are exact, and many rare states add up."""


class LPALMethod(enum.IntEnum):
    """The method whose policy and weights a solution of LPAL has; `method` says which was asked for.

    Example:
      >>> import jaxhom
      >>> mdp = jaxhom.gridworld(4, num_regions=4).mdp
      >>> solution = jaxhom.lpal(mdp, [30.0, 10.0, 10.0, 10.0], method="interior_point")
      >>> print(jaxhom.LPALMethod(int(solution.decided_by)).name)
      INTERIOR_POINT
    """

    COLUMNS = 0
    INTERIOR_POINT = 1
    PDHG = 2


class LPALSolution(Record):
    """A policy with its margin and a bound on the best margin; a batch adds a leading axis [B] to every field.

    The bounds hold whatever the status is. A pytree: `jax.tree.map(lambda leaf: leaf[2], solution)` is its third lane.

    Attributes:
      policy: [S, A], rows sum to 1.
      occupancy: [S, A], of that policy; sums to 1 / (1 - discount).
      margin: scalar, min_i V_i(policy) - expectations_i, the true margin of the returned policy, rounded down.
      margin_bound: scalar, no policy's margin is larger; rounded up.
      weights: [K], the reward weights that prove `margin_bound`: non-negative, sum 1.
      iterations: int32 scalar: columns, interior-point steps and PDHG iterations.
      decided_by: int32 scalar, a `jaxhom.LPALMethod`: PDHG where its own weights or policy closed the lane, with the
        best responses to them; COLUMNS where columns had to go on from there.
      status: int32 scalar, a `jaxhom.Status`.
    """

    policy: Float[Array, "*B S A"]
    occupancy: Float[Array, "*B S A"]
    margin: Float[Array, "*B"]
    margin_bound: Float[Array, "*B"]
    weights: Float[Array, "*B K"]
    iterations: Int[Array, "*B"]
    decided_by: Int[Array, "*B"] | int = LPALMethod.COLUMNS
    status: Int[Array, "*B"]


@dataclasses.dataclass(frozen=True, eq=False)
class Found:
    """What a method proposes for its lanes, in NumPy; nothing of it certified.

    Attributes:
      x: [B, S, A], an occupancy up to scale and rounding, whose policy (eq. 5) is meant.
      weights: [B, K], about in the simplex.
      iterations: int [B]. stopped: [B], the status of a lane whose gap turns out to be open.
      decided_by: int [B], an `LPALMethod`.
      gap: [B], what the method takes to be open; infinite where it does not know.
      value: [B, S], guesses of the optimal values for the weights, in the method's units; or None.
      negligible: share of all discounted time below which x is taken for nothing; of each lane [B], or of all.
    """

    x: Float[np.ndarray, "B S A"]
    weights: Float[np.ndarray, "B K"]
    iterations: Int[np.ndarray, " B"]
    stopped: Int[np.ndarray, " B"]
    decided_by: Int[np.ndarray, " B"]
    gap: Float[np.ndarray, " B"]
    value: Float[np.ndarray, "B S"] | None = None
    negligible: Float[np.ndarray, " B"] | float = NO_OCCUPANCY

    def lane(self, number: int) -> Found:
        """One lane, without its axis."""
        return self.part(number)

    def part(self, numbers: Int[np.ndarray, " C"] | int) -> Found:
        """Some of the lanes; one without its axis."""
        return Found(**{name: None if leaf is None else leaf[numbers] for name, leaf in self._by_lane().items()})

    def with_lanes(self, numbers: Int[np.ndarray, " C"], other: Found) -> Found:
        """What was found, with the given lanes as in `other`."""

        def exchanged(mine, others):
            if mine is None or others is None:
                return None
            mine = np.array(mine)
            mine[numbers] = others
            return mine

        pairs = zip(self._by_lane().items(), other._by_lane().values(), strict=True)
        return Found(**{name: exchanged(mine, others) for (name, mine), others in pairs})

    def is_as(self, other: Found) -> bool:
        """Whether two lanes say the same."""
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return all(one is two or (one is not None and np.array_equal(one, two, equal_nan=True)) for one, two in pairs)

    def _by_lane(self) -> dict[str, Any]:
        return vars(self) | {"negligible": np.broadcast_to(self.negligible, np.shape(self.iterations))}
