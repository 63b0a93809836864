"""What all LPAL methods return, and the two sides of its certificate.

Any policy bounds v* from below by its margin min_i V_i(pi) - Vhat_i, one linear solve. Any w in the simplex bounds it
from above by max_pi w . V(pi) - w . Vhat, one planning problem. Neither relies on how pi or w were found.
"""

import chex
import jax
import jax.numpy as jnp

from jaxhom.mdp import MDP
from jaxhom.occupancy import occupancy
from jaxhom.pdhg import Status
from jaxhom.planning import Plan, optimal_policy

NO_OCCUPANCY = 1e-9  # share of all discounted time below which eq. (5) is 0 / 0, for x that solvers leave near 0


@chex.dataclass(frozen=True)
class LPALSolution:
    """A policy with its margin and a bound on the best margin; a batch adds a leading axis [B] to every field.

    Attributes:
      policy: [S, A], rows sum to 1.
      occupancy: [S, A], of that policy; sums to 1 / (1 - discount).
      margin: scalar, min_i V_i(policy) - expectations_i, the true margin of the returned policy.
      margin_bound: scalar, no policy's margin is larger.
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
    # In float32 a projection can leave a sum that is off by 1e-4, and the bound with it.
    weights = weights / weights.sum(axis=-1, keepdims=True)
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


def policy_from_occupancy(mdp: MDP, x: jax.Array, fallback: jax.Array, negligible: float = NO_OCCUPANCY) -> jax.Array:
    """pi(s, a) = x(s, a) / sum_a' x(s, a') (eq. 5), [B, S, A]; `fallback` where the state's share is negligible."""
    x = jnp.maximum(x, 0.0)
    total = x.sum(axis=-1, keepdims=True)
    occurs = total > negligible / (1.0 - mdp.discount)
    return jnp.where(occurs, x / jnp.where(occurs, total, 1.0), fallback)


@jax.jit
def certify(mdp, expectations, x, bound, tolerance, iterations, *, stopped, negligible=NO_OCCUPANCY) -> LPALSolution:
    """The solution whose policy is read off the occupancy x [B, S, A]; `stopped` (or [B]) is that of an open gap."""
    policy = policy_from_occupancy(mdp, x, bound.policy, negligible)
    true_occupancy = occupancy(mdp, policy)
    expected = jnp.einsum("bsa,sak->bk", true_occupancy, mdp.features)
    margin = (expected - expectations).min(axis=-1)
    is_closed = bound.margin_bound - margin <= tolerance
    return LPALSolution(
        policy=policy,
        occupancy=true_occupancy,
        margin=margin,
        margin_bound=bound.margin_bound,
        weights=bound.weights,
        iterations=jnp.broadcast_to(jnp.asarray(iterations, jnp.int32), margin.shape),
        status=jnp.where(is_closed, Status.SOLVED, stopped).astype(jnp.int32),
    )
