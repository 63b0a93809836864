"""The two sides of LPAL's certificate, and the solutions that are made of them.

Any policy bounds v* from below by its margin min_i V_i(pi) - Vhat_i, one linear solve. Any w in the simplex bounds it
from above by max_pi w . V(pi) - w . Vhat, one planning problem. Neither relies on how pi or w were found. Both are
computed in float64 (`exact`), whatever the model's type, and rounded outwards.

What a method has found is nearly the occupancy of its policy, and its values those of planning: all lanes are first
judged by what these guesses prove, one product for each side. Only where that says too little is a chain factorised.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom.apprenticeship.exact import ENOUGH, NEAR_ONE, Exact, exact_rows
from jaxhom.apprenticeship.presolve import Reduction
from jaxhom.apprenticeship.solution import Found, LPALSolution
from jaxhom.models.mdp import MDP
from jaxhom.planning.occupancy import occupancy, policy_from_occupancy
from jaxhom.solvers.lane_queue import map_on_cores
from jaxhom.solvers.outward import rounded_down, rounded_up
from jaxhom.status import Status

if TYPE_CHECKING:
    from jaxtyping import Float, Int

_EPS = np.finfo(np.float64).eps
_DIGITS = 1e-4  # share of the tolerance by which a margin may be below the true one: guesses of columns are as good
_LARGEST = 2.0**500  # of x: sums over it stay finite
_NUMBERS_AT_A_TIME = 2**18  # of the policies of several lanes: they stay in a core's cache


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
        self,
        policy: Float[np.ndarray, "S A"],
        expectations: Float[np.ndarray, " K"],
        tolerance: float,
        guess: Float[np.ndarray, " S"] | None = None,
    ) -> tuple[Float[np.ndarray, " S"], float]:
        """The occupancy of the states, and what the policy's margin is at least; rows sum to exactly 1.

        `guess`: of the occupancy.
        """
        mu, margin = None, np.inf
        for found, expected, error in self._evaluated(policy, tolerance, guess):
            mu = found if mu is None else mu
            margin = min(margin, float(self._least(expected[None], error[None], expectations).min()))
        return mu, margin

    def expected(
        self, policy: Float[np.ndarray, "S A"], tolerance: float
    ) -> tuple[Float[np.ndarray, " K"], Float[np.ndarray, " K"]]:
        """What a policy's feature expectations are at least and at most; rows sum to exactly 1."""
        low, high = np.inf, -np.inf
        for _, expected, error in self._evaluated(policy, tolerance, None):
            totals = self._masses[:, None] * expected
            error = error + 2.0 * _EPS * np.abs(expected)
            low, high = np.minimum(low, totals.min(axis=0) - error), np.maximum(high, totals.max(axis=0) + error)
        return low, high

    def _evaluated(self, policy, tolerance, guess):
        """The states' occupancy, V [K] and its error [K] of every variant of the model."""
        if guess is None and not self._by_host_alone:
            guess = np.asarray(occupancy(self.mdp, policy), np.float64).sum(axis=1)
        for exact in self._variants:
            guess, expected, error = exact.expectations(policy.astype(np.float64), guess, tolerance)
            yield guess, expected, error

    def _least(self, expected, error, expectations):
        """V_k - Vhat_k at least, [B, K], of V [B, K] that are known up to an error."""
        error = error + 2.0 * _EPS * (np.abs(expected) + np.abs(expectations))
        return (self._masses[:, None, None] * expected).min(axis=0) - expectations - error

    def above(
        self,
        weights: Float[np.ndarray, " K"],
        expectations: Float[np.ndarray, " K"],
        value: Float[np.ndarray, " S"] | None,
        tolerance: float,
    ) -> tuple[float, Int[np.ndarray, " S"]]:
        """No policy's margin is larger; and the best actions for the weights. `value`: a guess of their values."""
        weights = weights.astype(np.float64)
        return self.advantage(weights / weights.sum(), expectations, value, tolerance)

    def advantage(
        self,
        weights: Float[np.ndarray, " K"],
        expectations: Float[np.ndarray, " K"],
        value: Float[np.ndarray, " S"] | None,
        tolerance: float,
    ) -> tuple[float, Int[np.ndarray, " S"]]:
        """No policy's w . (V - Vhat) is larger, whatever the signs of w; and the best actions for w."""
        best, actions = -np.inf, None
        for exact in self._variants:
            bound, value, actions = exact.plan(weights, value, actions, tolerance)
            best = max(best, *(self._masses * bound))
        return float(self._most(np.array([best]), weights[None], expectations)[0]), actions

    def _most(self, best, weights, expectations):
        """w . V(pi) - w . Vhat at most, [B], of what the best policies are worth at most."""
        target = weights * expectations
        rounding = (weights.shape[1] + 4) * _EPS * (np.abs(target).sum(axis=1) + np.abs(best))
        return best - target.sum(axis=1) + rounding

    def guessed_below(
        self, policy: Float[np.ndarray, "B S A"], expectations: Float[np.ndarray, "B K"], mu: Float[np.ndarray, "B S"]
    ) -> tuple[Float[np.ndarray, "B K"], Float[np.ndarray, " B"]]:
        """V_k(pi) - Vhat_k at least, as guesses of occupancies prove it, and by how much that may be too little."""
        policy = policy.astype(np.float64)
        parts = [exact.evaluate(policy, mu) for exact in self._variants]
        least = np.min([self._least(*part, expectations) for part in parts], axis=0)
        return least, np.max([error.max(axis=1) for _, error in parts], axis=0)

    def guessed_above(
        self, weights: Float[np.ndarray, "B K"], expectations: Float[np.ndarray, "B K"], value: Float[np.ndarray, "B S"]
    ) -> tuple[Float[np.ndarray, " B"], Float[np.ndarray, " B"], Int[np.ndarray, "B S"]]:
        """`above` as guesses of values prove it: the bounds, by how much they may be too much, and actions."""
        weights = weights.astype(np.float64)
        weights /= weights.sum(axis=1, keepdims=True)
        parts = [exact.bound(weights, value) for exact in self._variants]
        best = np.max([np.outer(self._masses, bound).max(axis=0) for bound, *_ in parts], axis=0)
        return self._most(best, weights, expectations), np.max([part[1] for part in parts], axis=0), parts[0][2]


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
        self._latest: dict[int, Found] = {}
        self._solutions: LPALSolution | None = None

    def certify(self, found: Found, lanes: Int[np.ndarray, " C"]) -> LPALSolution:
        """The solutions of the given lanes of the call, NumPy arrays with a leading axis [C].

        A lane for which nothing new was found since it was last certified keeps its solution.
        """
        news = [found.lane(k) for k in range(len(lanes))]
        known = [self._latest.get(int(lane)) for lane in lanes]
        fresh = [k for k, (new, old) in enumerate(zip(news, known, strict=True)) if old is None or not new.is_as(old)]
        self._latest.update((int(lanes[k]), news[k]) for k in fresh)
        width = max(1, _NUMBERS_AT_A_TIME // self._sides.exact.allowed.size)
        for first in range(0, len(fresh), width):
            some = np.array(fresh[first : first + width])
            self._keep(lanes[some], self._certify(lanes[some], found.part(some)))
        return jax.tree.map(lambda leaf: leaf[lanes], self._solutions)

    def _keep(self, lanes: Int[np.ndarray, " C"], solutions: LPALSolution) -> None:
        if self._solutions is None:
            total = len(self._expectations)
            self._solutions = jax.tree.map(lambda leaf: np.empty((total, *leaf.shape[1:]), leaf.dtype), solutions)
        for kept, new in zip(jax.tree.leaves(self._solutions), jax.tree.leaves(solutions), strict=True):
            kept[lanes] = new

    def _certify(self, lanes: Int[np.ndarray, " C"], found: Found) -> LPALSolution:
        sides, tolerance, asked = self._sides, self._tolerance[lanes], self._expectations[lanes]
        dtype = np.dtype(sides.mdp.dtype)
        weights = self._reduction.weights(lanes, simplex_point(found.weights)).astype(dtype)
        x = np.where(sides.exact.allowed, np.clip(np.nan_to_num(found.x, posinf=0.0), 0.0, _LARGEST), 0.0)
        guess = self._occupancy(x)
        with np.errstate(over="ignore"):
            value = np.zeros(guess.shape) if found.value is None else found.value * self._unit
        bound, excess, actions = sides.guessed_above(weights, asked, value)
        policy = self._policy(x, actions, found.negligible)
        least, lack = sides.guessed_below(policy, asked, guess)
        margin = least.min(axis=1)
        # Values are rough where hardly anything happens, and no matter there: what the policy is worth for the weights
        # is the least that their bound can be.
        excess = np.minimum(excess, bound - (weights * least).sum(axis=1))
        is_closed = _is_closed(margin, bound, tolerance, dtype)
        is_rough = ~(excess <= ENOUGH * tolerance) & ~is_closed
        for k in np.flatnonzero(is_rough):
            start = value[k] if found.value is not None else None
            bound[k], actions[k] = sides.above(weights[k], asked[k], start, tolerance[k])
        if is_rough.any():
            policy[is_rough] = self._policy(x[is_rough], actions[is_rough], found.negligible[is_rough])
        is_short = np.flatnonzero(is_rough | ~(lack <= _DIGITS * tolerance))

        def evaluate(k: int) -> tuple[Float[np.ndarray, " S"], float]:
            return sides.below(policy[k], asked[k], _DIGITS / ENOUGH * tolerance[k], guess[k])

        for k, (mu, least) in zip(is_short, map_on_cores(evaluate, is_short), strict=True):
            guess[k], margin[k] = mu, least
        low, high = _rounded(margin, bound, dtype)
        is_closed = _is_closed(margin, bound, tolerance, dtype)
        return LPALSolution(
            policy=policy,
            occupancy=(guess[..., None] * policy).astype(dtype),
            margin=low,
            margin_bound=high,
            weights=weights,
            iterations=found.iterations.astype(np.int32),
            decided_by=found.decided_by.astype(np.int32),
            status=np.where(is_closed, Status.SOLVED, found.stopped).astype(np.int32),
        )

    def _occupancy(self, x: Float[np.ndarray, "C S A"]) -> Float[np.ndarray, "C S"]:
        """A guess of the states' occupancy: that of x, all discounted time together."""
        exact, mu = self._sides.exact, x.sum(axis=2)
        total = mu.sum(axis=1, keepdims=True)
        share = np.where(total > 0, mu, exact.initial) / np.where(total > 0, total, exact.initial.sum())
        return share * exact.time[1]

    def _policy(self, x, actions, negligible) -> Float[np.ndarray, "C S A"]:
        """Eq. (5); where nothing happens, the best actions for the weights."""
        best = np.eye(x.shape[2])[actions]
        mdp = self._sides.mdp
        return exact_rows(policy_from_occupancy(mdp, x, best, negligible[:, None]), mdp.dtype)


def _rounded(margin: np.ndarray, bound: np.ndarray, dtype: np.dtype) -> tuple[np.ndarray, np.ndarray]:
    """Both sides [C], outwards. Bounds that rounding has made to cross are both uncertain."""
    return rounded_down(np.minimum(margin, bound), dtype), rounded_up(np.maximum(margin, bound), dtype)


def _is_closed(margin: np.ndarray, bound: np.ndarray, tolerance: np.ndarray, dtype: np.dtype) -> np.ndarray:
    low, high = _rounded(margin, bound, dtype)
    return high.astype(np.float64) - low.astype(np.float64) <= tolerance


def simplex_point(weights: Float[np.ndarray, "*B K"]) -> Float[np.ndarray, "*B K"]:
    """Non-negative weights with sum 1; uniform ones where there is nothing to go by."""
    weights = np.maximum(np.nan_to_num(np.asarray(weights, np.float64), posinf=0.0), 0.0)
    largest = weights.max(axis=-1, keepdims=True)
    weights = np.where(largest > 0, weights / np.where(largest > 0, largest, 1.0), 1.0)
    return weights / weights.sum(axis=-1, keepdims=True)
