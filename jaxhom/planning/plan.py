"""An optimal policy and what certifies it: what planning returns."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from jaxhom.models.mdp import MDP
from jaxhom.status import Record

if TYPE_CHECKING:
    from jaxtyping import Array, Float, Int


class Plan(Record):
    """An optimal policy and what certifies it; with a batch of B rewards every field gains a leading axis [B].

    Under `jax.grad` and `jax.jvp` value and action_value have derivatives (`jaxhom.planning.sensitivity`); the rest is
    constant.

    Attributes:
      policy: [S, A], deterministic (one-hot).
      value: [S], within residual / (1 - discount) of the optimal value.
      action_value: [S, A], r + gamma T value; -inf where an action is not allowed.
      iterations: int32 scalar, sweeps until the lane stopped, and policies of policy iteration.
      residual: scalar, max_s |max_a action_value(s, a) - value(s)|, the Bellman residual; from float32 sweeps with
        what rounding can hide from it.
      status: int32 scalar, a `jaxhom.Status`, concrete or under `jit` and `vmap`. SOLVED: the residual is within the
        tolerance, or no action is better than the policy's. ITERATION_LIMIT: `max_iterations` came first. STALLED:
        rounding came first, or a program met a model that only the host can solve. The bounds hold whatever it is.
    """

    policy: Float[Array, "*B S A"]
    value: Float[Array, "*B S"]
    action_value: Float[Array, "*B S A"]
    iterations: Int[Array, "*B"]
    residual: Float[Array, "*B"]
    status: Int[Array, "*B"]

    def upper_bound(self, mdp: MDP) -> Float[Array, "*B S"]:
        """An upper bound on the optimal value at every state, from the residual; works under `jit` and `vmap`.

        Widened by what rounding can hide from the residual: the sum over N successors, and a few operations.
        """
        rounding = (mdp.probability.shape[-1] + 8) * jnp.finfo(self.value.dtype).eps
        hidden = rounding * (jnp.abs(self.value).max(axis=-1) + self.residual)
        bound = (self.residual + hidden) / (1.0 - mdp.discount)
        return self.value + bound[..., None]


def greedy_policy(
    action_value: Float[Array, "*B S A"], tie_tolerance: Float[Array, "*B S 1"] | float = 0.0
) -> Float[Array, "*B S A"]:
    """One-hot policy of the first action within `tie_tolerance` of the best; works under `jit` and `vmap`."""
    best = action_value.max(axis=-1, keepdims=True)
    first = jnp.argmax(action_value >= best - tie_tolerance, axis=-1)
    return jax.nn.one_hot(first, action_value.shape[-1], dtype=action_value.dtype)
