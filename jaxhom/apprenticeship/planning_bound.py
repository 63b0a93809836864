"""The upper bound on LPAL's best margin that planning for some weights proves, as methods look at it while they go.

For any w in the simplex, v* <= max_pi w . V(pi) - w . Vhat. In the model's type, widened by what rounding can hide;
what is returned in the end is computed once more in float64 (`certificate`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax.numpy as jnp

from jaxhom.models.mdp import MDP
from jaxhom.planning.plan import Plan
from jaxhom.planning.plan_program import plan_in_program
from jaxhom.status import Record

if TYPE_CHECKING:
    from jaxtyping import Array, Float

_MAX_ITERATIONS = 100_000  # sweeps


class UpperBound(Record):
    """The best bound so far, per lane: margin_bound [B], weights [B, K] and their optimal policy [B, S, A]."""

    margin_bound: Float[Array, " B"]
    weights: Float[Array, "B K"]
    policy: Float[Array, "B S A"]


def bound_by_planning(
    mdp: MDP,
    expectations: Float[Array, "B K"],
    weights: Float[Array, "B K"],
    value: Float[Array, "B S"],
    tolerance: Float[Array, "*B"],
    *,
    is_quick: bool = False,
) -> tuple[UpperBound, Plan]:
    """The bound of weights [B, K]: the value of planning for them, its own error added.

    Args:
      mdp: the model; its features may be [S, 1, K].
      expectations: [B, K].
      weights: [B, K], in the simplex.
      value: [B, S], a start for planning.
      tolerance: gap that the caller is after; planning is a tenth as loose.
      is_quick: by sweeps alone, where they get on: the bound is looser where they do not.
    """
    # In float32 a projection can leave a sum that is off by 1e-4, and the bound with it; or nothing at all.
    total = weights.sum(axis=-1, keepdims=True)
    weights = jnp.where(total > 0, weights / jnp.where(total > 0, total, 1.0), 1.0 / weights.shape[-1])
    reward = jnp.einsum("sak,bk->bsa", mdp.features, weights)
    reward = jnp.broadcast_to(reward, (len(weights), mdp.num_states, mdp.num_actions))
    residual = 0.1 * tolerance * (1.0 - mdp.discount)
    if mdp.restricts_actions:
        reward = jnp.where(mdp.allowed, reward, -jnp.inf)
    arrays = (jnp.moveaxis(reward, 0, -1), value.T, jnp.broadcast_to(residual, len(weights)))
    plan = plan_in_program(mdp, *arrays, max_iterations=_MAX_ITERATIONS, is_quick=is_quick)[0]
    best, target = plan.upper_bound(mdp) @ mdp.initial, weights * expectations
    bound = best - target.sum(axis=-1)
    # Values are sums of 1 / (1 - gamma) rewards; the sums over K, that of the weights among them, have K terms.
    terms = mdp.num_features + 8.0
    size = 8.0 * jnp.where(mdp.allowed, jnp.abs(reward), 0.0).max(axis=(1, 2)) / (1.0 - mdp.discount)
    size += terms * (jnp.abs(target).sum(axis=-1) + jnp.abs(bound))
    bound += jnp.finfo(mdp.dtype).eps * size
    return UpperBound(margin_bound=bound, weights=weights, policy=plan.policy), plan
