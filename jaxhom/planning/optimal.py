"""Optimal policies for one reward or a batch of rewards over the same model.

Modified policy iteration (Puterman 1994, section 6.5): sweeps V <- max_a (r + gamma T V), and between two of them a
block of cheaper ones under the actions that were chosen. It ends by MacQueen's bounds (section 6.6.2): with
b = T V - V, the optimal value lies between T V + gamma / (1 - gamma) min b and T V + gamma / (1 - gamma) max b. The
iteration stops when the span max b - min b is small, which on a model that mixes is far earlier than |b|, and the value
is then shifted by the constant that halves what is left, so the Bellman residual that is returned is half the span.

Where the span hardly shrinks (two recurrent classes and a discount near 1) sweeps would go on for ever. Policy
iteration with linear solves takes over (section 6.4): on the host where arrays are concrete (`policy_iteration`),
inside the program otherwise. On the host it also decides where the default tolerance leaves open which action is best,
and does everything where it is the quickest.

Ties are broken towards the lowest action: of the actions whose value is within rounding of the best the first is taken,
so rounding does not decide. An action that is not allowed has the value -inf.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom import checks
from jaxhom.models.inputs import as_model, check_reward_values
from jaxhom.models.mdp import MDP, expected_next_value, uniform_policy
from jaxhom.models.padded_rows import MAX_UNROLLED_ACTIONS
from jaxhom.planning import policy_iteration
from jaxhom.planning.chain_solver import solve_chain
from jaxhom.planning.host_chains import host_model, is_at_hand
from jaxhom.planning.sensitivity import with_derivatives
from jaxhom.status import Record, Status

_BLOCK = 16  # sweeps per look at the bounds
_STALL = 16.0  # a span of this many roundings of the largest value is taken for converged
_LOOK_BACK = 8  # blocks after which a span that has not fallen to `_SLOW` of what it was counts as slow
_SLOW = 0.5
_MAX_IMPROVEMENTS = 100  # of policy iteration inside a program
_POLISHED_STATES = 20_000
_VISIBLE = 0.01  # of the values: where rounding may have made more than that, float32 has no answer


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
      status: int32 scalar, a `jaxhom.Status`: SOLVED where the residual is within the tolerance or no action is better
        than the policy's. The bounds hold whatever it is.
    """

    policy: jax.Array
    value: jax.Array
    action_value: jax.Array
    iterations: jax.Array
    residual: jax.Array
    status: jax.Array

    def upper_bound(self, mdp: MDP) -> jax.Array:
        """An upper bound on the optimal value at every state, [S] or [B, S], from the residual.

        Widened by what rounding can hide from the residual: the sum over N successors, and a few operations.
        """
        rounding = (mdp.probability.shape[-1] + 8) * jnp.finfo(self.value.dtype).eps
        hidden = rounding * (jnp.abs(self.value).max(axis=-1) + self.residual)
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
      reward: [S, A] or [S] for one reward; [B, S, A] or [B, S] for a batch, [B, S, 1] where [B, S] could be taken for a
        transposed [S, A]. A two-dimensional reward of shape (S, A) is one reward. -inf forbids an action; what the
        model does not allow is not looked at.
      initial_value: [S] or [B, S], where to start (a former `Plan.value`); zero if None.
      tolerance: Bellman residual to reach; default 1e-10 (1e-5 in float32) times the largest |max_a reward|. With the
        default, concrete arrays of up to 20,000 states whose graph is narrow (grids, roads) get the exact policy: where
        the tolerance leaves open which action is best, policy iteration decides.
      max_iterations: sweeps (and policies, in policy iteration) after which to stop all the same; the status tells.

    Returns:
      A `Plan`. The loss of its policy against the optimum is at most 2 residual / (1 - discount), up to the
      rounding within which actions count as tied. Works under jit, vmap and grad; concrete arrays are solved to the
      end at any discount, programs on models of more than 1,024 states may end STALLED where the discount is near 1.

    Raises:
      ValueError: if a shape does not fit, a concrete reward is NaN or +inf, or forbids every action of a state.

    Source: Puterman 1994, sections 6.4 to 6.6; the expert of Boularias and Chaib-draa 2010, section VI.
    """
    mdp = as_model(mdp)
    reward, is_batch = _reward_batch(mdp, reward)
    if initial_value is None:
        initial_value = jnp.zeros((reward.shape[0], mdp.num_states), mdp.dtype)
    initial_value = checks.to_device(initial_value, mdp.dtype)
    if initial_value.shape == (mdp.num_states,):
        initial_value = jnp.broadcast_to(initial_value, (reward.shape[0], mdp.num_states))
    good = initial_value.shape == (reward.shape[0], mdp.num_states)
    checks.require_shape("initial_value", initial_value, f"(..., {mdp.num_states})", good)
    max_iterations = checks.require_count("max_iterations", max_iterations, least=0)
    is_default = tolerance is None
    if not is_default:
        checks.require_positive("tolerance", tolerance, or_zero=True)
    else:
        tolerance = (1e-10 if mdp.dtype == jnp.float64 else 1e-5) * _scale(reward)
    tolerance = jnp.broadcast_to(checks.to_device(tolerance, mdp.dtype), reward.shape[:1])
    inputs = jax.lax.stop_gradient((mdp, jnp.moveaxis(reward, 0, -1), initial_value.T, tolerance))
    if is_at_hand(inputs):
        plan = _plan_at_hand(*inputs, max_iterations=max_iterations, is_polished=is_default)
    else:
        plan = _plan(*inputs, max_iterations=max_iterations, is_quick=False)[0]
    plan = with_derivatives(mdp, reward, plan)
    return plan if is_batch else jax.tree.map(lambda leaf: leaf[0], plan)


def greedy_policy(action_value: jax.Array, tie_tolerance: jax.Array | float = 0.0) -> jax.Array:
    """One-hot policy of the first action within `tie_tolerance` of the best, [..., S, A] -> [..., S, A]."""
    best = action_value.max(axis=-1, keepdims=True)
    first = jnp.argmax(action_value >= best - tie_tolerance, axis=-1)
    return jax.nn.one_hot(first, action_value.shape[-1], dtype=action_value.dtype)


def _reward_batch(mdp: MDP, reward) -> tuple[jax.Array, bool]:
    """Brings the accepted shapes of a reward to [B, S, A], -inf where an action is not allowed; checks the values."""
    states, actions = mdp.num_states, mdp.num_actions
    if not checks.is_traced(reward):
        reward = checks.as_host_array("reward", reward)
    shape = reward.shape
    is_pair, is_state = shape[-2:] == (states, actions), shape[-1:] == (states,)
    if shape == (actions, states) and not is_pair:
        raise ValueError(
            f"reward has shape {shape}: transpose it if it is [A, S]; a batch of A rewards of states is [B, S, 1]"
        )
    expected = f"({states}, {actions}), ({states},), (B, {states}, {actions}) or (B, {states})"
    is_wide = len(shape) == 3 and shape[1:] == (states, 1)
    good = (is_pair and len(shape) in (2, 3)) or (is_state and len(shape) in (1, 2)) or is_wide
    checks.require_shape("reward", reward, expected, good)
    is_batch = len(shape) == 3 or (len(shape) == 2 and not is_pair)
    reward = check_reward_values(mdp, reward, forbidden=-jnp.inf, may_forbid=True)
    if not is_pair:
        reward = jnp.broadcast_to(reward if is_wide else reward[..., None], (*shape[: len(shape) - is_wide], actions))
        if mdp.restricts_actions:
            reward = jnp.where(mdp.allowed, reward, -jnp.inf)
    reward = reward if is_batch else reward[None]
    if not checks.is_traced(reward):
        has_action = np.isfinite(np.asarray(reward)).any(axis=-1)
        if not has_action.all():
            lane, state = np.argwhere(~has_action)[0]
            where = f"[{lane}, {state}]" if is_batch else f"[{state}]"
            raise ValueError(f"reward{where} is -inf for every action: a state needs one that is allowed")
    return reward, is_batch


def _scale(reward: jax.Array) -> jax.Array:
    """[B]: the largest |max_a r|; what is never chosen, such as a penalty of -1e6, does not count."""
    best = jnp.abs(reward.max(axis=2)).max(axis=1)
    every = jnp.where(jnp.isfinite(reward), jnp.abs(reward), 0.0).max(axis=(1, 2))
    return jnp.where(best > 0, best, every)


def _plan_at_hand(mdp: MDP, reward, value, tolerance, *, max_iterations: int, is_polished: bool) -> Plan:
    """The plan for concrete arrays, batch last: by sweeps on the device, policy iteration on the host, or both."""
    model, host_reward = host_model(mdp), np.asarray(reward, np.float64)
    lanes = reward.shape[-1]
    if is_polished and max_iterations > 0 and model.plans_sooner(lanes):
        expected = [model.expected_next_value(lane) for lane in np.asarray(value.T)]
        start = host_reward + model.discount * np.stack(expected, axis=-1)
        return _improve_on_host(model, host_reward, _empty_plan(mdp, lanes), start, np.arange(lanes), max_iterations)
    plan, is_open = _plan(mdp, reward, value, tolerance, max_iterations=max_iterations, is_quick=True)
    is_slow, is_open = np.asarray(plan.status) == Status.STALLED, np.asarray(is_open)
    if not (is_slow.any() or (is_polished and is_open.any())):
        return plan
    if is_slow.any() and not model.is_solvable:
        return _plan(mdp, reward, value, tolerance, max_iterations=max_iterations, is_quick=False)[0]
    may_polish = is_polished and model.is_narrow and mdp.num_states <= _POLISHED_STATES
    left = np.flatnonzero(is_slow | (is_open & may_polish))
    start = np.moveaxis(np.asarray(plan.action_value), 0, -1)
    return _improve_on_host(model, host_reward, plan, start, left, max_iterations)


def _empty_plan(mdp: MDP, lanes: int) -> Plan:
    """A plan of `lanes` rewards of which nothing is known."""
    pairs = (lanes, *mdp.allowed.shape)
    zeros, count = np.zeros(pairs, mdp.dtype), np.zeros(lanes, np.int32)
    return Plan(
        policy=np.asarray(jnp.broadcast_to(uniform_policy(mdp), pairs)),
        value=zeros[..., 0],
        action_value=zeros,
        iterations=count,
        residual=np.full(lanes, np.inf, mdp.dtype),
        status=np.full(lanes, Status.STALLED, np.int32),
    )


def _improve_on_host(model, reward: np.ndarray, plan: Plan, start: np.ndarray, lanes, max_iterations: int) -> Plan:
    """The plan, with the given lanes brought to the end by policy iteration.

    Args:
      reward: [S, A, B], float64. start: [S, A, B], of which the best actions are where to begin.
      lanes: numbers of lanes.
    """
    dtype = plan.value.dtype
    fields = {name: np.array(getattr(plan, name)) for name in ("policy", "value", "action_value", "residual")}
    iterations, status = np.array(plan.iterations), np.array(plan.status)
    for lane in lanes:
        left = max_iterations - int(iterations[lane])
        begin = start[..., lane].argmax(axis=1)
        found = policy_iteration.iterate(model, reward[..., lane], begin, float(jnp.finfo(dtype).eps), left)
        if found is None:
            continue
        fields["policy"][lane] = np.eye(model.num_actions)[found.actions]
        fields["value"][lane], fields["action_value"][lane] = found.value, found.action_value
        stored = np.abs(fields["action_value"][lane].max(axis=1) - fields["value"][lane]).max()
        fields["residual"][lane] = max(found.residual, stored)
        iterations[lane] += found.iterations
        limited = Status.ITERATION_LIMIT if found.iterations >= left else Status.STALLED
        status[lane] = Status.SOLVED if found.is_settled else limited
    arrays = {name: checks.to_device(array, dtype) for name, array in fields.items()}
    return plan.replace(**arrays, iterations=checks.to_device(iterations), status=checks.to_device(status))


@functools.partial(jax.jit, static_argnames=("max_iterations", "is_quick"))
def _plan(mdp, reward, value, tolerance, *, max_iterations, is_quick) -> tuple[Plan, jax.Array]:
    """Batch-last modified policy iteration: reward [S, A, B], value [S, B], tolerance [B].

    Returns the plan, and bool [B]: whether its residual leaves open which action is the best somewhere. With `is_quick`
    slow lanes come back STALLED, for the caller to bring to the end.
    """
    lane = 0 if reward.shape[-1] == 1 else slice(None)  # gathers of single numbers, not of rows of one
    value, iterations, is_slow = _iterate(mdp, reward[..., lane], value[..., lane], tolerance[lane], max_iterations)
    value, iterations, is_slow = value.reshape(len(reward), -1), iterations.reshape(-1), is_slow.reshape(-1)
    settled = jnp.zeros(is_slow.shape, bool)
    if not is_quick:
        value, steps, settled = _improve_by_solving(mdp, reward, value, is_slow, max_iterations - iterations)
        iterations += steps
    action_value = reward + mdp.discount * expected_next_value(mdp, value)
    difference = action_value.max(axis=1) - value
    low, high = difference.min(axis=0), difference.max(axis=0)
    shift = 0.5 * (low + high) / (1.0 - mdp.discount)
    value, action_value = value + shift, action_value + mdp.discount * shift
    residual = jnp.abs(action_value.max(axis=1) - value).max(axis=0)
    # A span that rounding alone could make counts as none, as in the iteration.
    floor = _STALL * jnp.finfo(value.dtype).eps * jnp.abs(value).max(axis=0)
    is_solved = (residual <= jnp.maximum(tolerance, floor)) | settled
    limited = jnp.where(iterations >= max_iterations, Status.ITERATION_LIMIT, Status.STALLED)
    rounding = _rounding(mdp, action_value)
    loss = action_value.max(axis=1, keepdims=True) - action_value
    is_open = ((loss > rounding) & (loss <= 2.0 * residual / (1.0 - mdp.discount))).any(axis=(0, 1))
    # A loss in every step adds up: it may not become a visible part of the value.
    little = (1.0 - mdp.discount) * jnp.finfo(value.dtype).eps ** 0.5 * jnp.abs(action_value.max(axis=1, keepdims=True))
    tie_tolerance = jnp.maximum(4.0 * residual, jnp.minimum(rounding, little))
    if value.dtype != jnp.float64:
        size = jnp.abs(value).max(axis=0)
        hidden = _hidden_share(mdp, value.dtype)
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


def _improve_by_solving(mdp: MDP, reward, value, is_slow, limit) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Policy iteration of the slow lanes [B]: values [S, B], steps [B], and which have ended with the best policy."""
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


def _iterate(mdp: MDP, reward, value, tolerance, max_iterations) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Sweeps until half the span of the change is within the tolerance, or hardly shrinks, on every lane.

    Modified policy iteration (Puterman 1994, section 6.5): a sweep over all actions, whose change gives the bounds,
    then a block of sweeps with the actions that it chose. Returns value, sweeps and "hardly shrinks" per lane.
    """
    improve, best_action, follow, evaluate = _sweeps(mdp, reward)

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
        floor = _STALL * jnp.finfo(value.dtype).eps * jnp.abs(improved).max(axis=0)
        span = jnp.where(high - low > floor, high - low, 0.0)
        residual = jnp.where(active, 0.5 * span, residual)
        # A constant offset has no effect on the span; taking it out at once keeps the values at their scale.
        centred = improved + mdp.discount / (1.0 - mdp.discount) * 0.5 * (low + high)
        looks_back = blocks % _LOOK_BACK == _LOOK_BACK - 1
        is_slow |= active & looks_back & (residual > tolerance) & (residual > _SLOW * former)
        former = jnp.where(looks_back, residual, former)
        goes_on = is_active(residual, is_slow, count + 1)
        length = jnp.where(jnp.any(goes_on), jnp.minimum(_BLOCK, max_iterations - count) - 1, 0)
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


def _hidden_share(mdp: MDP, dtype) -> jax.Array:
    """The share of the values by which a backup in this type may be off without seeing it.

    Rows sum to 1 up to a rounding, and their products with the values are rounded. Discounted sums make that
    1 / (1 - discount) times as much.
    """
    total = mdp.probability.sum(axis=-1)
    return jnp.where(total > 0.5, jnp.abs(total - 1.0), 0.0).max() + 0.5 * jnp.finfo(dtype).eps


def _rounding(mdp: MDP, action_value: jax.Array) -> jax.Array:
    """[S, 1, B]: differences between good actions that rounding can make, from the values in that state alone."""
    terms = min(mdp.probability.shape[-1], 28)
    return (8.0 + 2.0 * terms) * jnp.finfo(action_value.dtype).eps * jnp.abs(action_value.max(axis=1, keepdims=True))
