"""Optimal policies for one reward or a batch of rewards over the same model.

Modified policy iteration (Puterman 1994, section 6.5): sweeps V <- max_a (r + gamma T V), and between two of them a
block of cheaper ones under the actions that were chosen. It ends by MacQueen's bounds (section 6.6.2): with
b = T V - V, the optimal value lies between T V + gamma / (1 - gamma) min b and T V + gamma / (1 - gamma) max b. The
iteration stops when the span max b - min b is small, which on a model that mixes is far earlier than |b|, and the value
is then shifted by the constant that halves what is left, so the Bellman residual that is returned is half the span.

Ties are broken towards the lowest action: of the actions whose value is within `tie_tolerance` of the best, the
first is taken, so rounding does not decide.
"""

import functools
from collections.abc import Callable

import chex
import jax
import jax.numpy as jnp

from jaxhom import checks
from jaxhom.inputs import as_model
from jaxhom.mdp import MDP, expected_next_value, expected_next_values
from jaxhom.planning_sensitivity import with_derivatives
from jaxhom.policy_chain import action_chains, saves_gathers

_BLOCK = 16  # sweeps per look at the bounds
_STALL = 16.0  # a span of this many roundings of the largest value is taken for converged


@chex.dataclass(frozen=True)
class Plan:
    """An optimal policy and what certifies it; with a batch of B rewards every field gains a leading axis [B].

    Under `jax.grad` and `jax.jvp` value and action_value have derivatives (`jaxhom.planning_sensitivity`); the rest is
    constant.

    Attributes:
      policy: [S, A], deterministic (one-hot).
      value: [S], within residual / (1 - discount) of the optimal value.
      action_value: [S, A], r + gamma T value.
      iterations: int32 scalar, sweeps until the lane stopped.
      residual: scalar, max_s |max_a action_value(s, a) - value(s)|, the Bellman residual.
    """

    policy: jax.Array
    value: jax.Array
    action_value: jax.Array
    iterations: jax.Array
    residual: jax.Array

    def upper_bound(self, mdp: MDP) -> jax.Array:
        """An upper bound on the optimal value at every state, [S] or [B, S], from the residual.

        Widened by what rounding can hide from the residual: the sum over N successors, and a few operations.
        """
        rounding = (mdp.probability.shape[-1] + 8) * jnp.finfo(self.value.dtype).eps
        hidden = rounding * jnp.abs(self.action_value).max(axis=(-2, -1))
        bound = (self.residual + hidden) / (1.0 - mdp.discount)
        return self.value + bound[..., None]


def optimal_policy(
    mdp: MDP,
    reward: jax.Array,
    *,
    initial_value: jax.Array | None = None,
    tolerance: float | None = None,
    max_iterations: int = 100_000,
) -> Plan:
    """Finds an optimal deterministic policy for each reward.

    Args:
      mdp: the model.
      reward: [S, A] or [S] for one reward; [B, S, A] or [B, S] for a batch. A two-dimensional reward of shape
        (S, A) is one reward.
      initial_value: [S] or [B, S], where to start (a former `Plan.value`); zero if None.
      tolerance: Bellman residual to reach; default 1e-10 (1e-5 in float32) times the largest |reward|.
      max_iterations: sweeps after which to stop all the same; the residual tells.

    Returns:
      A `Plan`. The loss of its policy against the optimum is at most 2 residual / (1 - discount), up to the
      tie tolerance.

    Raises:
      ValueError: if a shape does not fit.

    Source: Puterman 1994, section 6.6; the expert of Boularias and Chaib-draa 2010, section VI.
    """
    mdp = as_model(mdp)
    reward, is_batch = _reward_batch(mdp, jnp.asarray(reward, mdp.dtype))
    if initial_value is None:
        initial_value = jnp.zeros((reward.shape[0], mdp.num_states), mdp.dtype)
    initial_value = jnp.asarray(initial_value, mdp.dtype)
    if initial_value.shape == (mdp.num_states,):
        initial_value = jnp.broadcast_to(initial_value, (reward.shape[0], mdp.num_states))
    good = initial_value.shape == (reward.shape[0], mdp.num_states)
    checks.require_shape("initial_value", initial_value, f"(..., {mdp.num_states})", good)
    scale = jnp.abs(reward).max(axis=(1, 2))
    if tolerance is None:
        tolerance = (1e-10 if mdp.dtype == jnp.float64 else 1e-5) * scale
    tolerance = jnp.broadcast_to(jnp.asarray(tolerance, mdp.dtype), scale.shape)
    inputs = jax.lax.stop_gradient((mdp, jnp.moveaxis(reward, 0, -1), initial_value.T, tolerance))
    plan = with_derivatives(mdp, reward, _plan(*inputs, max_iterations=max_iterations))
    return plan if is_batch else jax.tree.map(lambda leaf: leaf[0], plan)


def greedy_policy(action_value: jax.Array, tie_tolerance: jax.Array | float = 0.0) -> jax.Array:
    """One-hot policy of the first action within `tie_tolerance` of the best, [..., S, A] -> [..., S, A]."""
    best = action_value.max(axis=-1, keepdims=True)
    first = jnp.argmax(action_value >= best - tie_tolerance, axis=-1)
    return jax.nn.one_hot(first, action_value.shape[-1], dtype=action_value.dtype)


def _reward_batch(mdp: MDP, reward: jax.Array) -> tuple[jax.Array, bool]:
    """Brings the accepted shapes of a reward to [B, S, A]."""
    states, actions = mdp.num_states, mdp.num_actions
    if reward.shape == (states, actions):
        return reward[None], False
    if reward.shape == (states,):
        return jnp.broadcast_to(reward[None, :, None], (1, states, actions)), False
    if reward.ndim == 3 and reward.shape[1:] == (states, actions):
        return reward, True
    expected = f"({states}, {actions}), ({states},), (B, {states}, {actions}) or (B, {states})"
    checks.require_shape("reward", reward, expected, reward.ndim == 2 and reward.shape[1] == states)
    return jnp.broadcast_to(reward[..., None], (len(reward), states, actions)), True


@functools.partial(jax.jit, static_argnames="max_iterations")
def _plan(mdp, reward, value, tolerance, *, max_iterations) -> Plan:
    """Batch-last modified policy iteration: reward [S, A, B], value [S, B], tolerance [B]."""
    lane = 0 if reward.shape[-1] == 1 else slice(None)  # gathers of single numbers, not of rows of one
    value, iterations = _iterate(mdp, reward[..., lane], value[..., lane], tolerance[lane], max_iterations)
    value = value.reshape(len(reward), -1)
    action_value = reward + mdp.discount * expected_next_value(mdp, value)
    difference = action_value.max(axis=1) - value
    low, high = difference.min(axis=0), difference.max(axis=0)
    shift = 0.5 * (low + high) / (1.0 - mdp.discount)
    value, action_value = value + shift, action_value + mdp.discount * shift
    residual = jnp.abs(action_value.max(axis=1) - value).max(axis=0)
    tie_tolerance = jnp.maximum(4.0 * residual, _tie_rounding(action_value))
    action_value = jnp.moveaxis(action_value, -1, 0)
    return Plan(
        policy=greedy_policy(action_value, tie_tolerance[:, None, None]),
        value=value.T,
        action_value=action_value,
        iterations=iterations.reshape(-1),
        residual=residual,
    )


def _iterate(mdp: MDP, reward, value, tolerance, max_iterations) -> tuple[jax.Array, jax.Array]:
    """Sweeps until half the span of the change is within the tolerance on every lane; value and sweeps per lane.

    Modified policy iteration (Puterman 1994, section 6.5): a sweep over all actions, whose change gives the bounds,
    then a block of sweeps with the actions that it chose.
    """
    improve, best_action, follow, evaluate = _sweeps(mdp, reward)

    def is_active(residual, count):
        return (residual > tolerance) & (count < max_iterations)

    def block(state):
        value, residual, iterations, count = state
        active = is_active(residual, count)
        # A loop of one pass, which XLA does not know: what a loop returns is computed once. Otherwise every use of
        # the sweep's result would sweep again.
        once = jnp.minimum(1, max_iterations - count)
        improved = jax.lax.fori_loop(0, once, lambda _, v: improve(v), value)
        change = improved - value
        low, high = change.min(axis=0), change.max(axis=0)
        # A span that rounding alone could make counts as zero: sweeping on would never reduce it.
        floor = _STALL * jnp.finfo(value.dtype).eps * jnp.abs(improved).max(axis=0)
        span = jnp.where(high - low > floor, high - low, 0.0)
        residual = jnp.where(active, 0.5 * span, residual)
        # A constant offset has no effect on the span; taking it out at once keeps the values at their scale.
        centred = improved + mdp.discount / (1.0 - mdp.discount) * 0.5 * (low + high)
        goes_on = is_active(residual, count + 1)
        length = jnp.where(jnp.any(goes_on), jnp.minimum(_BLOCK, max_iterations - count) - 1, 0)
        action = jax.lax.fori_loop(0, once, lambda *_: best_action(value, improved), jnp.zeros(value.shape, jnp.int32))
        policy = follow(action)
        evaluated = jax.lax.fori_loop(0, length, lambda _, v: evaluate(policy, v), centred)
        value = jnp.where(active, jnp.where(goes_on, evaluated, centred), value)
        return value, residual, iterations + jnp.where(active, 1 + jnp.where(goes_on, length, 0), 0), count + 1 + length

    lanes = reward.shape[2:]
    start = (value, jnp.full(lanes, jnp.inf, reward.dtype), jnp.zeros(lanes, jnp.int32), jnp.zeros((), jnp.int32))
    keep_going = lambda state: jnp.any(is_active(state[1], state[3]))  # noqa: E731
    value, _, iterations, _ = jax.lax.while_loop(keep_going, block, start)
    return value, iterations


def _sweeps(mdp: MDP, reward: jax.Array) -> tuple[Callable, ...]:
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
    if mdp.is_dense or not saves_gathers(mdp.edges, mdp.narrow_width):
        chains, expected = None, functools.partial(expected_next_values, mdp)
    else:
        chains = action_chains(mdp.edges, mdp.probability)
        expected = chains.expected_next_values

    def backups(value):
        return [r + mdp.discount * v for r, v in zip(rewards, expected(value), strict=True)]

    def improve(value):
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


def _tie_rounding(action_value: jax.Array) -> jax.Array:
    """Differences that rounding in values of this size can make, per lane."""
    return 64.0 * jnp.finfo(action_value.dtype).eps * jnp.abs(action_value).max(axis=(0, 1))
