"""The program that plans: modified policy iteration, policy iteration for what it left, and the plan with its residual.

Everything has its batch last: rewards [S, A, B], values [S, B].
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from jaxhom.models.mdp import MDP, expected_next_value
from jaxhom.planning.chain_solver import solve_chain
from jaxhom.planning.modified_policy_iteration import iterate_values, rounding_of_spans
from jaxhom.planning.plan import Plan, greedy_policy
from jaxhom.status import Status

if TYPE_CHECKING:
    from jaxtyping import Array, Bool, Float, Int

_MAX_IMPROVEMENTS = 100  # of policy iteration inside a program; it takes 3 to 10
_VISIBLE = 0.01  # of the values: where rounding may have made more than that, float32 has no answer


@functools.partial(jax.jit, static_argnames=("max_iterations", "is_quick", "is_patient", "report"))
def plan_in_program(
    mdp: MDP,
    reward: Float[Array, "S A B"],
    value: Float[Array, "S B"],
    tolerance: Float[Array, " B"],
    *,
    max_iterations: int,
    is_quick: bool,
    is_patient: bool = False,
    report: Callable[[Array, Array], None] | None = None,
) -> tuple[Plan, Bool[Array, " B"]]:
    """Plans for B rewards, from given values on; `is_patient` and `report` are those of `iterate_values`.

    Returns:
      The plan, with its batch first, and whether its residual leaves open which action is the best somewhere. With
      `is_quick` slow lanes come back STALLED, for the caller to bring to the end.
    """
    lane = 0 if reward.shape[-1] == 1 else slice(None)  # gathers of single numbers, not of rows of one
    value, iterations, is_slow = iterate_values(
        mdp, reward[..., lane], value[..., lane], tolerance[lane], max_iterations, is_patient, report
    )
    value, iterations, is_slow = value.reshape(len(reward), -1), iterations.reshape(-1), is_slow.reshape(-1)
    settled = jnp.zeros(is_slow.shape, bool)
    if not is_quick:
        value, steps, settled = _improve_by_solving(mdp, reward, value, is_slow, max_iterations - iterations)
        iterations += steps
    value, action_value, residual = _centred(mdp, reward, value)
    # A span that rounding alone could make counts as none, as in the iteration.
    is_solved = (residual <= jnp.maximum(tolerance, rounding_of_spans(value))) | settled
    limited = jnp.where(iterations >= max_iterations, Status.ITERATION_LIMIT, Status.STALLED)
    rounding = _rounding(mdp, action_value)
    loss = action_value.max(axis=1, keepdims=True) - action_value
    is_open = ((loss > rounding) & (loss <= 2.0 * residual / (1.0 - mdp.discount))).any(axis=(0, 1))
    # A loss in every step adds up: it may not become a visible part of the value.
    little = (1.0 - mdp.discount) * jnp.finfo(value.dtype).eps ** 0.5 * jnp.abs(action_value.max(axis=1, keepdims=True))
    tie_tolerance = jnp.maximum(4.0 * residual, jnp.minimum(rounding, little))
    if value.dtype != jnp.float64:
        size = jnp.abs(value).max(axis=0)
        hidden = hidden_share(mdp, value.dtype)
        residual += hidden * size
        is_solved &= hidden <= _VISIBLE * (1.0 - mdp.discount)
    plan = Plan(
        policy=greedy_policy(jnp.moveaxis(action_value, -1, 0), jnp.moveaxis(tie_tolerance, -1, 0)),
        value=value.T,
        action_value=jnp.moveaxis(action_value, -1, 0),
        iterations=iterations,
        residual=residual,
        status=jnp.where(is_solved, Status.SOLVED, limited).astype(jnp.int32),
    )
    return plan, is_open


def _centred(mdp: MDP, reward, value) -> tuple[Float[Array, "S B"], Float[Array, "S A B"], Float[Array, " B"]]:
    """Values, action values and Bellman residuals, shifted by the constant that halves what is left of the span."""
    action_value = reward + mdp.discount * expected_next_value(mdp, value)
    difference = action_value.max(axis=1) - value
    low, high = difference.min(axis=0), difference.max(axis=0)
    shift = 0.5 * (low + high) / (1.0 - mdp.discount)
    value, action_value = value + shift, action_value + mdp.discount * shift
    return value, action_value, jnp.abs(action_value.max(axis=1) - value).max(axis=0)


def _improve_by_solving(
    mdp: MDP, reward, value, is_slow, limit
) -> tuple[Float[Array, "S B"], Int[Array, " B"], Bool[Array, " B"]]:
    """Policy iteration of the slow lanes: values, steps, and which have ended with the best policy."""
    num_actions = reward.shape[1]

    def backup(value):
        return reward + mdp.discount * expected_next_value(mdp, value)

    def chosen(array, action):
        return jnp.take_along_axis(array, action[:, None], axis=1)[:, 0]

    def keep_going(state):
        return state[-1].any()

    def improve(state):
        value, action, steps, settled, active = state
        policy = jax.nn.one_hot(action, num_actions, axis=1, dtype=value.dtype)
        solved = solve_chain(mdp, policy, chosen(reward, action), transpose=False)
        action_value = backup(solved)
        now = chosen(action_value, action)
        # What is wrong with the solution may not look like a better action.
        noise = 2.0 * jnp.abs(now - solved).max(axis=0) + _rounding(mdp, action_value)[:, 0]
        is_better = action_value.max(axis=1) - now > noise
        is_good = active & jnp.isfinite(solved).all(axis=0)
        value = jnp.where(is_good, solved, value)
        action = jnp.where(is_good & is_better, action_value.argmax(axis=1), action)
        settled |= is_good & ~is_better.any(axis=0)
        steps += active
        return value, action, steps, settled, is_good & ~settled & (steps < jnp.minimum(limit, _MAX_IMPROVEMENTS))

    start = (value, backup(value).argmax(axis=1), jnp.zeros(is_slow.shape, jnp.int32), jnp.zeros(is_slow.shape, bool))
    value, _, steps, settled, _ = jax.lax.while_loop(keep_going, improve, (*start, is_slow))
    return value, steps, settled


def hidden_share(mdp: MDP, dtype) -> Float[Array, ""]:
    """The share of the values by which a backup in this type may be off without seeing it.

    Rows sum to 1 up to a rounding, and their products with the values are rounded. Discounted sums make that
    1 / (1 - discount) times as much.
    """
    total = mdp.probability.sum(axis=-1)
    return jnp.where(total > 0.5, jnp.abs(total - 1.0), 0.0).max() + 0.5 * jnp.finfo(dtype).eps


def _rounding(mdp: MDP, action_value: Float[Array, "S A B"]) -> Float[Array, "S 1 B"]:
    """Differences between good actions that rounding can make, from the values in that state alone."""
    terms = min(mdp.probability.shape[-1], 28)
    return (8.0 + 2.0 * terms) * jnp.finfo(action_value.dtype).eps * jnp.abs(action_value.max(axis=1, keepdims=True))
