"""What all LPAL methods return, and the two sides of its certificate.

Any policy bounds v* from below by its margin min_i V_i(pi) - Vhat_i, one linear solve. Any w in the simplex bounds it
from above by max_pi w . V(pi) - w . Vhat, one planning problem. Neither relies on how pi or w were found. Methods look
at both as they go, in the model's type; what is returned is computed in float64 (`exact`) and rounded
outwards.
"""

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxhom.apprenticeship.exact import Exact, exact_rows, rounded_down
from jaxhom.apprenticeship.presolve import Reduction
from jaxhom.models.mdp import MDP
from jaxhom.planning.occupancy import NO_OCCUPANCY, occupancy, policy_from_occupancy
from jaxhom.planning.optimal import Plan, optimal_policy
from jaxhom.status import Status

NEAR_ONE = 0.998  # a discount above which linear systems are better solved on the host
_EPS = np.finfo(np.float64).eps


@chex.dataclass(frozen=True)
class LPALSolution:
    """A policy with its margin and a bound on the best margin; a batch adds a leading axis [B] to every field.

    Attributes:
      policy: [S, A], rows sum to 1.
      occupancy: [S, A], of that policy; sums to 1 / (1 - discount).
      margin: scalar, min_i V_i(policy) - expectations_i, the true margin of the returned policy, rounded down.
      margin_bound: scalar, no policy's margin is larger; rounded up.
      weights: [K], the reward weights that prove `margin_bound`: non-negative, sum 1.
      iterations: int32 scalar: columns, interior-point steps or PDHG iterations.
      status: int32 scalar, a `jaxhom.Status`.
    """

    policy: jax.Array
    occupancy: jax.Array
    margin: jax.Array
    margin_bound: jax.Array
    weights: jax.Array
    iterations: jax.Array
    status: jax.Array


@chex.dataclass(frozen=True)
class Found:
    """What a method proposes for its lanes, in NumPy; nothing of it certified.

    Attributes:
      x: [B, S, A], an occupancy up to scale and rounding, whose policy (eq. 5) is meant.
      weights: [B, K], about in the simplex.
      iterations: int [B]. stopped: [B], the status of a lane whose gap turns out to be open.
      value: [B, S], guesses of the optimal values for the weights, in the method's units; or None.
      actions: [B, S], guesses of the optimal actions, or None.
      negligible: as in `policy_from_occupancy`, of x.
    """

    x: np.ndarray
    weights: np.ndarray
    iterations: np.ndarray
    stopped: np.ndarray
    value: np.ndarray | None = None
    actions: np.ndarray | None = None
    negligible: float = NO_OCCUPANCY

    def lane(self, number: int) -> "Found":
        """One lane."""
        names = ("x", "weights", "iterations", "stopped", "value", "actions")
        parts = {name: None if (leaf := getattr(self, name)) is None else leaf[number] for name in names}
        return self.replace(**parts)


class Certifier:
    """Makes solutions of what methods find.

    Args:
      mdp: the model, as the caller gave it.
      expectations: [B, K], float64, as the caller gave them.
      tolerance: [B].
      reduction: what methods solve for instead.
      unit: what the methods' features and margins are in.
    """

    def __init__(self, mdp: MDP, expectations: np.ndarray, tolerance: np.ndarray, reduction: Reduction, unit: float):
        self.exact = Exact(mdp)
        self._variants = [exact for exact in (self.exact, self.exact.as_stored()) if exact]
        # The initial distribution likewise, as it is stored and as it should be: all expectations are linear in it.
        self._masses = np.array([1.0, 1.0 / self.exact.initial.sum()])
        self._mdp, self._expectations, self._tolerance = mdp, expectations, tolerance
        self._reduction, self._unit = reduction, unit
        is_rough = mdp.dtype != jnp.float64 or float(mdp.discount) > NEAR_ONE
        self._by_host_alone = self.exact.model.is_narrow or (is_rough and self.exact.is_direct)

    def __call__(self, found: Found, lanes=None) -> LPALSolution:
        """The solutions of the given lanes, or of all; NumPy arrays with a leading axis."""
        lanes = range(len(self._expectations)) if lanes is None else lanes
        solutions = [self._certify(lane, found.lane(k)) for k, lane in enumerate(lanes)]
        return jax.tree.map(lambda *leaves: np.stack(leaves), *solutions)

    def _certify(self, lane: int, found: Found) -> LPALSolution:
        dtype, tolerance = np.dtype(self._mdp.dtype), self._tolerance[lane]
        weights = self._reduction.weights(lane, simplex_point(found.weights)).astype(dtype)
        bound, actions = self._bound(lane, weights, found)
        policy = self._policy(found, actions)
        mu, margin = self._margin(lane, policy)
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
            status=np.int32(Status.SOLVED if is_closed else found.stopped),
        )

    def _policy(self, found: Found, actions: np.ndarray) -> np.ndarray:
        """Eq. (5); where nothing happens, the best actions for the weights."""
        x = np.where(self.exact.allowed, np.nan_to_num(found.x, posinf=0.0, neginf=0.0), 0.0)
        best = np.eye(x.shape[1])[actions]
        return exact_rows(policy_from_occupancy(self._mdp, x, best, found.negligible), self._mdp.dtype)

    def _margin(self, lane: int, policy: np.ndarray) -> tuple[np.ndarray, float]:
        """The occupancy of the states, and what the policy's margin is at least."""
        guess = None
        if not self._by_host_alone:
            guess = np.asarray(occupancy(self._mdp, policy), np.float64).sum(axis=1)
        mu, margin, asked = None, np.inf, self._expectations[lane]
        for exact in self._variants:
            found, expected, error = exact.expectations(policy.astype(np.float64), guess, self._tolerance[lane])
            error = error + 2.0 * _EPS * (np.abs(expected) + np.abs(asked))
            mu, guess = found if mu is None else mu, found
            margin = min(margin, float((self._masses[:, None] * expected - asked - error).min()))
        return mu, margin

    def _bound(self, lane: int, weights: np.ndarray, found: Found) -> tuple[float, np.ndarray]:
        """No policy's margin is larger; and the best actions [S] for the weights."""
        weights = weights.astype(np.float64)
        weights /= weights.sum()
        value = None if found.value is None else found.value.astype(np.float64) * self._unit
        best, actions = -np.inf, found.actions
        for exact in self._variants:
            bound, value, actions = exact.plan(weights, value, actions, self._tolerance[lane])
            best = max(best, *(self._masses * bound))
        target = weights * self._expectations[lane]
        rounding = (len(weights) + 4) * _EPS * (np.abs(target).sum() + abs(best))
        return float(best - target.sum() + rounding), actions


def simplex_point(weights: np.ndarray) -> np.ndarray:
    """Non-negative weights with sum 1; uniform ones where there is nothing to go by."""
    weights = np.maximum(np.nan_to_num(np.asarray(weights, np.float64), posinf=0.0), 0.0)
    largest = weights.max(axis=-1, keepdims=True)
    weights = np.where(largest > 0, weights / np.where(largest > 0, largest, 1.0), 1.0)
    return weights / weights.sum(axis=-1, keepdims=True)


@chex.dataclass(frozen=True)
class UpperBound:
    """The best bound so far, per lane: margin_bound [B], weights [B, K] and their optimal policy [B, S, A]."""

    margin_bound: jax.Array
    weights: jax.Array
    policy: jax.Array


def bound_by_planning(mdp: MDP, expectations, weights, value, tolerance) -> tuple[UpperBound, Plan]:
    """The bound of weights [B, K]: the value of planning for them, its own error added.

    Args:
      mdp: the model; its features may be [S, 1, K].
      expectations: [B, K].
      weights: [B, K], in the simplex.
      value: [B, S], a start for planning.
      tolerance: gap that the caller is after; planning is a tenth as loose.
    """
    # In float32 a projection can leave a sum that is off by 1e-4, and the bound with it; or nothing at all.
    total = weights.sum(axis=-1, keepdims=True)
    weights = jnp.where(total > 0, weights / jnp.where(total > 0, total, 1.0), 1.0 / weights.shape[-1])
    reward = jnp.einsum("sak,bk->bsa", mdp.features, weights)
    reward = jnp.broadcast_to(reward, (len(weights), mdp.num_states, mdp.num_actions))
    residual = 0.1 * tolerance * (1.0 - mdp.discount)
    plan = optimal_policy(mdp, reward, initial_value=value, tolerance=residual)
    best, target = plan.upper_bound(mdp) @ mdp.initial, weights * expectations
    bound = best - target.sum(axis=-1)
    # Values are sums of 1 / (1 - gamma) rewards; the sums over K, that of the weights among them, have K terms.
    terms = mdp.num_features + 8.0
    size = 8.0 * jnp.abs(reward).max(axis=(1, 2)) / (1.0 - mdp.discount)
    size += terms * (jnp.abs(target).sum(axis=-1) + jnp.abs(bound))
    bound += jnp.finfo(mdp.dtype).eps * size
    return UpperBound(margin_bound=bound, weights=weights, policy=plan.policy), plan


def better_bound(one: UpperBound, other: UpperBound) -> UpperBound:
    """Lane by lane the smaller of two bounds."""
    take = other.margin_bound < one.margin_bound

    def choose(old, new):
        return jnp.where(take.reshape(-1, *(1,) * (old.ndim - 1)), new, old)

    return jax.tree.map(choose, one, other)
