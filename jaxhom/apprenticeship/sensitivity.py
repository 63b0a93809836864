"""Derivatives of LPAL's best margin by the envelope theorem.

The best margin is the value of a saddle point (Boularias and Chaib-draa 2010, eqs. 2-4, and its dual),

    v* = max_{x >= 0}  min_{w in simplex, V}  L,
    L  = w . (Phi^T x - Vhat) + V . (alpha - (E - gamma T)^T x),

with x the occupancy of the best policy, w the weights that prove the bound and V the optimal values of the reward
Phi w. There a small move of x, w and V has no effect to first order, so the derivative of v* is that of L with the
three held constant (Danskin 1967; Milgrom and Segal 2002):

    d v* = w . (dPhi^T x - dVhat) + V . (dalpha + (dgamma T + gamma dT)^T x).

Nothing of how the point was found is differentiated: the cost is one planning problem. Where the saddle point is not
unique v* has a kink, and what comes out is the derivative of one of its pieces: in Vhat, in which v* is concave, a
supergradient. Second derivatives would need those of x, w and V, and are refused.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

import jax
import jax.numpy as jnp

from jaxhom.apprenticeship.solution import LPALSolution
from jaxhom.models.mdp import MDP, push_forward
from jaxhom.planning.optimal import optimal_policy
from jaxhom.solvers.first_order import first_order_only

if TYPE_CHECKING:
    from jaxtyping import Array, Float

Tree = TypeVar("Tree")


def without_tangents(tree: Tree) -> Tree:
    """The arrays of a pytree as they are under `jax.grad` or `jax.jvp`; under jit and vmap they stay traced."""

    def strip(leaf):
        if not isinstance(leaf, jax.core.Tracer):
            return leaf
        if jnp.issubdtype(leaf.dtype, jnp.inexact):
            return jax.lax.stop_gradient(leaf)
        return jnp.abs(leaf)  # integers, here indices, have no tangent to carry on

    return jax.tree.map(strip, tree)


def with_derivatives(solution: LPALSolution, mdp: MDP, expectations: Float[Array, "B K"]) -> LPALSolution:
    """The solution with a margin and a bound that JAX can differentiate once, forward or in reverse.

    Args:
      solution: of a batch, every field with a leading axis [B]; constants.
      mdp: the model, whose probability, initial, features and discount may be under differentiation.
      expectations: [B, K], likewise.

    Returns:
      The solution; margin and margin_bound [B] both have the derivative of the best margin.
    """
    constants = (solution.occupancy, solution.weights)
    margin, margin_bound = _margins(mdp, expectations, solution.margin, solution.margin_bound, constants)
    return solution.replace(margin=margin, margin_bound=margin_bound)


@jax.custom_jvp
def _margins(mdp, expectations, margin, margin_bound, constants):
    del mdp, expectations, constants
    return margin, margin_bound


@_margins.defjvp
def _(primals, tangents):
    mdp, expectations, *_, (occupancy, weights) = primals
    message = "lpal's margin has first derivatives only: the policy and the weights carry none"
    reward = jnp.einsum("sak,bk->bsa", mdp.features, weights)
    saddle = (occupancy, weights, optimal_policy(without_tangents(mdp), without_tangents(reward)).value)
    saddle = first_order_only(saddle, (mdp, expectations), message)
    change = jax.jvp(lambda *inputs: _lagrangian(*inputs, *saddle), primals[:2], tangents[:2])[1]
    return _margins(*primals), (change, change)


@jax.jit
def _lagrangian(mdp: MDP, expectations, x, weights, value) -> jax.Array:
    """L [B] at expectations [B, K], occupancy x [B, S, A], weights [B, K] and value [B, S]."""
    excess = jnp.einsum("bsa,sak->bk", x, mdp.features) - expectations
    arrivals = mdp.initial + mdp.discount * push_forward(mdp, jnp.moveaxis(x, 0, -1)).T
    return (weights * excess).sum(axis=-1) + (value * (arrivals - x.sum(axis=-1))).sum(axis=-1)
