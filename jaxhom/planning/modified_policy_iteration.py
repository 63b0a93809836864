"""Modified policy iteration (Puterman 1994, section 6.5), batch last, until MacQueen's bounds settle it.

Sweeps V <- max_a (r + gamma T V), and between two of them a block of cheaper ones under the actions that were chosen.
With b = T V - V the optimal value lies between T V + gamma / (1 - gamma) min b and T V + gamma / (1 - gamma) max b
(section 6.6.2): the iteration stops when the span max b - min b is small, which on a model that mixes is far earlier
than |b|. Where the span hardly shrinks (two recurrent classes and a discount near 1) it gives up: `is_slow`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from jaxhom.models.mdp import MDP, expected_next_value
from jaxhom.models.padded_rows import MAX_UNROLLED_ACTIONS

if TYPE_CHECKING:
    from jaxtyping import Array, Bool, Float, Int

_BLOCK = 16  # sweeps per look at the bounds: a look costs two more sweeps over all actions, a block at most so many
_LONG_BLOCK = 64  # on 10^6 states a look takes 80 ms, and a sweep with chosen actions 11
_STALL = 16.0  # roundings of the largest value up to which a span counts as none: a sum of a few terms makes them
_LOOK_BACK = 8  # blocks after which a span that has not fallen to `_SLOW` of what it was counts as slow
_SLOW = 0.5  # at this rate a tolerance of 1e-10 takes thousands of sweeps, where policies with solves take about ten


def iterate_values(
    mdp: MDP,
    reward: Float[Array, "S A *B"],
    value: Float[Array, "S *B"],
    tolerance: Float[Array, "*B"],
    max_iterations: int,
    is_patient: bool = False,
    report: Callable[[Array, Array], None] | None = None,
) -> tuple[Float[Array, "S *B"], Int[Array, "*B"], Bool[Array, "*B"]]:
    """Sweeps until half the span of the change is within the tolerance, or hardly shrinks, on every lane.

    A sweep over all actions, whose change gives the bounds, then a block of sweeps with the actions that it chose.

    Args:
      is_patient: never give up, and look at the bounds less often: for models so large that nothing else is quicker.
        News of a reward takes as many sweeps as steps to get around; until then the span hardly shrinks.
      report: is called on the host after every block with the residual that is left and the tolerance.

    Returns:
      Values, sweeps, and whether the span hardly shrinks: `is_slow`.
    """
    improve, best_action, follow, evaluate = _sweeps(mdp, reward)
    most = _LONG_BLOCK if is_patient else _BLOCK

    def is_active(residual, is_slow, count):
        return (residual > tolerance) & ~is_slow & (count < max_iterations)

    def block(state):
        value, residual, is_slow, former, iterations, count, blocks = state
        active = is_active(residual, is_slow, count)
        # A loop of one pass, which XLA does not know: what a loop returns is computed once. Otherwise every use of
        # the sweep's result would sweep again.
        once = jnp.minimum(1, max_iterations - count)
        improved = jax.lax.fori_loop(0, once, lambda _, v: improve(v), value)
        change = improved - value
        low, high = change.min(axis=0), change.max(axis=0)
        # A span that rounding alone could make counts as zero: sweeping on would never reduce it.
        span = jnp.where(high - low > rounding_of_spans(improved), high - low, 0.0)
        residual = jnp.where(active, 0.5 * span, residual)
        # A constant offset has no effect on the span; taking it out at once keeps the values at their scale.
        centred = improved + mdp.discount / (1.0 - mdp.discount) * 0.5 * (low + high)
        looks_back = (blocks % _LOOK_BACK == _LOOK_BACK - 1) & (not is_patient)
        is_slow |= active & looks_back & (residual > tolerance) & (residual > _SLOW * former)
        former = jnp.where(looks_back, residual, former)
        goes_on = is_active(residual, is_slow, count + 1)
        length = jnp.where(jnp.any(goes_on), jnp.minimum(most, max_iterations - count) - 1, 0)
        if report is not None:
            jax.debug.callback(report, residual, tolerance)
        action = jax.lax.fori_loop(0, once, lambda *_: best_action(value, improved), jnp.zeros(value.shape, jnp.int32))
        policy = follow(action)
        evaluated = jax.lax.fori_loop(0, length, lambda _, v: evaluate(policy, v), centred)
        value = jnp.where(active, jnp.where(goes_on, evaluated, centred), value)
        iterations += jnp.where(active, 1 + jnp.where(goes_on, length, 0), 0)
        return value, residual, is_slow, former, iterations, count + 1 + length, blocks + 1

    lanes = reward.shape[2:]
    infinity, zero = jnp.full(lanes, jnp.inf, reward.dtype), jnp.zeros((), jnp.int32)
    start = (value, infinity, jnp.zeros(lanes, bool), infinity, jnp.zeros(lanes, jnp.int32), zero, zero)
    keep_going = lambda state: jnp.any(is_active(state[1], state[2], state[5]))  # noqa: E731
    value, _, is_slow, _, iterations, _, _ = jax.lax.while_loop(keep_going, block, start)
    return value, iterations, is_slow


def rounding_of_spans(value: Float[Array, "S *B"]) -> Float[Array, "*B"]:
    """The span of a change of the values that rounding alone could make."""
    return _STALL * jnp.finfo(value.dtype).eps * jnp.abs(value).max(axis=0)


def _sweeps(mdp: MDP, reward: Float[Array, "S A *B"]) -> tuple[Callable, ...]:
    """What the iteration is made of, for rewards [S, A] or, batch last, [S, A, B].

    improve: value -> its backup by the best actions.
    best_action: value, its backup -> the first of these actions, int32.
    follow: actions -> their policy, as `evaluate` takes it.
    evaluate: policy, value -> the backup under the policy.

    A policy is what its sweep adds up: rewards [S], and weights [U, S] on the edges of the graph. In batches, where
    every lane would have weights of its own, memory is the limit: the sweep over all actions, whose weights all lanes
    share, is as fast, and does better. So it is where actions lead to different states,
    and where some states have many more successors than most.
    """
    rewards = jax.lax.optimization_barrier(jnp.moveaxis(reward, 1, 0))  # each action's in one piece
    is_wide = mdp.num_actions > MAX_UNROLLED_ACTIONS  # what is written out for every action would compile for minutes
    chains = None if is_wide else mdp.dynamics.action_chains()
    expected = (chains or mdp.dynamics).expected_next_values

    def backups(value):
        return [r + mdp.discount * v for r, v in zip(rewards, expected(value), strict=True)]

    def improve(value):
        if is_wide:
            return (reward + mdp.discount * expected_next_value(mdp, value)).max(axis=1)
        return functools.reduce(jnp.maximum, backups(value))

    if chains is None or reward.ndim == 3 or chains.wide_row.size:
        return improve, lambda _, best: jnp.zeros(best.shape, jnp.int32), lambda _: None, lambda _, v: improve(v)

    def best_action(value, improved):
        numbered = reversed(list(enumerate(backups(value))))
        action = jnp.zeros(improved.shape, jnp.int32)
        return functools.reduce(lambda action, new: jnp.where(new[1] >= improved, new[0], action), numbered, action)

    def follow(action):
        def choose(options):
            return functools.reduce(lambda old, new: jnp.where(action == new[0], new[1], old), enumerate(options), 0.0)

        return choose(rewards), mdp.discount * choose(chains.weight)

    def evaluate(policy, value):
        r, weight = policy
        return r + sum(w * value[states] for w, states in zip(weight, chains.successor, strict=True))

    return improve, best_action, follow, evaluate
