"""Derivatives of optimal values by the envelope theorem.

V* is the largest value of any policy. Where one policy attains it, a small change of reward or model leaves that policy
optimal, so the derivative of V* is that of its value, with the policy held constant:

    (I - gamma P_pi) dV* = dr_pi + (dgamma P_pi + gamma dP_pi) V*,    Q* = r + gamma T V*.

This is one linear solve, in either mode, and nothing of how the policy was found is differentiated. Higher derivatives
are those of the same value. At ties V* has a kink, and what comes out is the derivative of the policy that was chosen:
in the reward, in which V* is convex, a subgradient.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from jaxhom.models.mdp import MDP, expected_next_value
from jaxhom.planning.occupancy import policy_value
from jaxhom.planning.plan import Plan

if TYPE_CHECKING:
    from jaxtyping import Array, Float


def with_derivatives(mdp: MDP, reward: Float[Array, "*B S A"], plan: Plan) -> Plan:
    """The plan with values that JAX can differentiate by model and reward; the policy is a constant.

    Works under jit, vmap and grad, and costs nothing where nothing is differentiated.

    Args:
      mdp: the model.
      reward: [S, A] or [B, S, A].
      plan: the plan for them, made from `jax.lax.stop_gradient` of model and reward.

    Returns:
      The plan; its `value` and `action_value` have derivatives.

    Source: Milgrom and Segal 2002; for the linear system Puterman 1994, section 6.1.
    """
    constants = jax.lax.stop_gradient(plan)
    value, action_value = _values(mdp, reward, constants.policy, constants.value, constants.action_value)
    return constants.replace(value=value, action_value=action_value)


@jax.custom_jvp
def _values(mdp, reward, policy, value, action_value):
    del mdp, reward, policy
    return value, action_value


@_values.defjvp
def _(primals, tangents):
    policy = primals[2]

    def of_policy(mdp, reward):
        value = policy_value(mdp, policy, jnp.where(jnp.isfinite(reward), reward, 0.0))  # not 0 times -inf
        expected = expected_next_value(mdp, value.T)  # batch last
        return value, reward + mdp.discount * (expected if value.ndim == 1 else jnp.moveaxis(expected, -1, 0))

    return _values(*primals), jax.jvp(of_policy, primals[:2], tangents[:2])[1]
