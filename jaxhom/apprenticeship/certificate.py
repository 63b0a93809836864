"""The two sides of LPAL's certificate, and the solutions that are made of them.

Any policy bounds v* from below by its margin min_i V_i(pi) - Vhat_i, one linear solve. Any w in the simplex bounds it
from above by max_pi w . V(pi) - w . Vhat, one planning problem. Neither relies on how pi or w were found. Both are
computed in float64 (`exact`), whatever the model's type, and rounded outwards.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom.apprenticeship.exact import NEAR_ONE, Exact, exact_rows, rounded_down
from jaxhom.apprenticeship.presolve import Reduction
from jaxhom.apprenticeship.solution import Found, LPALSolution
from jaxhom.models.mdp import MDP
from jaxhom.planning.occupancy import occupancy, policy_from_occupancy
from jaxhom.status import Status

if TYPE_CHECKING:
    from jaxtyping import Float, Int

_EPS = np.finfo(np.float64).eps


class ExactSides:
    """Both sides of the certificate of a model, for any expectations, in float64.

    Attributes:
      mdp: the model.
      exact: the same on the host.
    """

    def __init__(self, mdp: MDP):
        self.mdp, self.exact = mdp, Exact(mdp)
        self._variants = [exact for exact in (self.exact, self.exact.as_stored()) if exact]
        # The initial distribution likewise, as it is stored and as it should be: all expectations are linear in it.
        self._masses = np.array([1.0, 1.0 / self.exact.initial.sum()])
        is_rough = mdp.dtype != jnp.float64 or float(mdp.discount) > NEAR_ONE
        self._by_host_alone = self.exact.model.is_narrow or (is_rough and self.exact.is_direct)

    def below(
        self, policy: Float[np.ndarray, "S A"], expectations: Float[np.ndarray, " K"], tolerance: float
    ) -> tuple[Float[np.ndarray, " S"], float]:
        """The occupancy of the states, and what the policy's margin is at least; rows sum to exactly 1."""
        guess = None
        if not self._by_host_alone:
            guess = np.asarray(occupancy(self.mdp, policy), np.float64).sum(axis=1)
        mu, margin = None, np.inf
        for exact in self._variants:
            found, expected, error = exact.expectations(policy.astype(np.float64), guess, tolerance)
            error = error + 2.0 * _EPS * (np.abs(expected) + np.abs(expectations))
            mu, guess = found if mu is None else mu, found
            margin = min(margin, float((self._masses[:, None] * expected - expectations - error).min()))
        return mu, margin

    def above(
        self,
        weights: Float[np.ndarray, " K"],
        expectations: Float[np.ndarray, " K"],
        value: Float[np.ndarray, " S"] | None,
        tolerance: float,
    ) -> tuple[float, Int[np.ndarray, " S"]]:
        """No policy's margin is larger; and the best actions for the weights. `value`: a guess of their values."""
        weights = weights.astype(np.float64)
        weights /= weights.sum()
        best, actions = -np.inf, None
        for exact in self._variants:
            bound, value, actions = exact.plan(weights, value, actions, tolerance)
            best = max(best, *(self._masses * bound))
        target = weights * expectations
        rounding = (len(weights) + 4) * _EPS * (np.abs(target).sum() + abs(best))
        return float(best - target.sum() + rounding), actions


class Certifier:
    """Makes the solutions of one call from what methods find.

    Args:
      sides: of the model, as the caller gave it.
      expectations: [B, K], float64, as the caller gave them. tolerance: [B].
      reduction: what methods solve for instead.
      unit: what the methods' features and margins are in.
    """

    def __init__(
        self,
        sides: ExactSides,
        expectations: Float[np.ndarray, "B K"],
        tolerance: Float[np.ndarray, " B"],
        reduction: Reduction,
        unit: float,
    ):
        self._sides, self._expectations, self._tolerance = sides, expectations, tolerance
        self._reduction, self._unit = reduction, unit
        self._latest: dict[int, tuple[Found, LPALSolution]] = {}

    def certify(self, found: Found, lanes: Int[np.ndarray, " C"]) -> LPALSolution:
        """The solutions of the given lanes of the call, NumPy arrays with a leading axis [C].

        A lane for which nothing new was found since it was last certified keeps its solution.
        """
        solutions = [self._certified(int(lane), found.lane(k)) for k, lane in enumerate(lanes)]
        return jax.tree.map(lambda *leaves: np.stack(leaves), *solutions)

    def _certified(self, lane: int, found: Found) -> LPALSolution:
        known, solution = self._latest.get(lane, (None, None))
        if known is None or not found.is_as(known):
            solution = self._certify(lane, found)
            self._latest[lane] = found, solution
        return solution

    def _certify(self, lane: int, found: Found) -> LPALSolution:
        sides, tolerance, asked = self._sides, self._tolerance[lane], self._expectations[lane]
        dtype = np.dtype(sides.mdp.dtype)
        weights = self._reduction.weights(lane, simplex_point(found.weights)).astype(dtype)
        value = None if found.value is None else found.value.astype(np.float64) * self._unit
        bound, actions = sides.above(weights, asked, value, tolerance)
        policy = self._policy(found, actions)
        mu, margin = sides.below(policy, asked, tolerance)
        # Bounds that rounding has made to cross are both uncertain.
        low, high = min(margin, bound), max(margin, bound)
        low, high = rounded_down(low, dtype), -rounded_down(-high, dtype)
        is_closed = float(high) - float(low) <= tolerance
        return LPALSolution(
            policy=policy,
            occupancy=(mu[:, None] * policy).astype(dtype),
            margin=low,
            margin_bound=high,
            weights=weights,
            iterations=np.int32(found.iterations),
            decided_by=np.int32(found.decided_by),
            status=np.int32(Status.SOLVED if is_closed else found.stopped),
        )

    def _policy(self, found: Found, actions: Int[np.ndarray, " S"]) -> Float[np.ndarray, "S A"]:
        """Eq. (5); where nothing happens, the best actions for the weights."""
        exact, mdp = self._sides.exact, self._sides.mdp
        x = np.where(exact.allowed, np.nan_to_num(found.x, posinf=0.0, neginf=0.0), 0.0)
        best = np.eye(x.shape[1])[actions]
        return exact_rows(policy_from_occupancy(mdp, x, best, found.negligible), mdp.dtype)


def simplex_point(weights: Float[np.ndarray, "*B K"]) -> Float[np.ndarray, "*B K"]:
    """Non-negative weights with sum 1; uniform ones where there is nothing to go by."""
    weights = np.maximum(np.nan_to_num(np.asarray(weights, np.float64), posinf=0.0), 0.0)
    largest = weights.max(axis=-1, keepdims=True)
    weights = np.where(largest > 0, weights / np.where(largest > 0, largest, 1.0), 1.0)
    return weights / weights.sum(axis=-1, keepdims=True)
