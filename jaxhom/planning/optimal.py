"""Optimal policies for one reward or a batch of rewards over the same model.

A program does it by `modified_policy_iteration`. Where that hardly gets on (two recurrent classes and a discount near
1), policy iteration with linear solves takes over (Puterman 1994, section 6.4): on the host where arrays are concrete
(`policy_iteration`), inside the program otherwise (`plan_program`). On the host it also decides where the default
tolerance leaves open which action is best, and does everything where it is the quickest.

Ties are broken towards the lowest action: of the actions whose value is within rounding of the best the first is taken,
so rounding does not decide. An action that is not allowed has the value -inf.
"""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom import checks
from jaxhom.models.inputs import as_model, check_reward_values
from jaxhom.models.mdp import MDP, uniform_policy
from jaxhom.planning import policy_iteration
from jaxhom.planning.host_chains import HostModel, host_model
from jaxhom.planning.plan import Plan
from jaxhom.planning.plan_program import plan_in_program
from jaxhom.planning.progress import progress_of_sweeps
from jaxhom.planning.sensitivity import with_derivatives
from jaxhom.status import Status

if TYPE_CHECKING:
    from jaxtyping import Array, ArrayLike, Float, Int

# States from which on factors take longer than the sweeps that a discount needs at most, for ten digits 23,000 at 0.999
# and 2,300 at 0.99, where 100,000 states (grid316 of results/speed_planning.csv) took 2.9 s by policy iteration.
_SWEPT = ((200_000, 0.999), (50_000, 0.99))
_POLISHED_STATES = 20_000  # up to which ties are settled by policy iteration: its factors grow faster than sweeps do


def optimal_policy(
    mdp: MDP,
    reward: Float[ArrayLike, "*B S A"] | Float[ArrayLike, "*B S"],
    *,
    initial_value: Float[ArrayLike, "*B S"] | None = None,
    tolerance: float | Float[ArrayLike, " B"] | None = None,
    max_iterations: int = 100_000,
    progress: bool = False,
) -> Plan:
    """Finds an optimal deterministic policy for each reward.

    Works under `jit`, `vmap` and `grad` (see `Plan`). Concrete arrays are solved to the end at any discount; programs
    on models of more than 1,024 states may end STALLED where the discount is near 1.

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
      progress: show how far sweeps are, of concrete arrays.

    Returns:
      A `Plan`. The loss of its policy against the optimum is at most 2 residual / (1 - discount), up to the
      rounding within which actions count as tied.

    Raises:
      ValueError: if a shape does not fit, a concrete reward is NaN or +inf, or forbids every action of a state; if
        `initial_value` is not finite, or a tolerance negative.

    Example:
      >>> from jaxhom import MDP
      >>> stay_or_go = MDP.from_dense([[[1.0, 0.0], [0.0, 1.0]], [[0.0, 1.0], [0.0, 1.0]]], discount=0.5)
      >>> plan = optimal_policy(stay_or_go, [[1.0, 0.0], [3.0, 3.0]])
      >>> plan.policy.argmax(axis=1).tolist(), plan.value.round(6).tolist(), Status(int(plan.status)).name
      ([1, 0], [3.0, 6.0], 'SOLVED')

    Source: Puterman 1994, sections 6.4 to 6.6; the expert of Boularias and Chaib-draa 2010, section VI.
    """
    mdp = as_model(mdp)
    reward, is_batch = reward_batch(mdp, reward)
    xp = checks.arrays_of(mdp, reward, initial_value, tolerance)
    value = first_values(xp, mdp, initial_value, len(reward))
    max_iterations = checks.require_count("max_iterations", max_iterations, least=0)
    is_default = tolerance is None
    if not is_default:
        checks.require_positive("tolerance", tolerance, or_zero=True)
    else:
        tolerance = (1e-10 if mdp.dtype == jnp.float64 else 1e-5) * _scale(xp, reward)
    lanes = reward.shape[:1]
    checks.require_shape("tolerance", tolerance, f"() or {lanes}", np.shape(tolerance) in ((), lanes))
    tolerance = xp.broadcast_to(xp.asarray(tolerance, mdp.dtype), lanes)
    inputs = (mdp, xp.moveaxis(reward, 0, -1), value.T, tolerance)
    if xp is np:
        with progress_of_sweeps(progress) as report:
            options = {"max_iterations": max_iterations, "is_polished": is_default, "report": report}
            plan = _plan_at_hand(*inputs, **options)
    else:
        plan = plan_in_program(*jax.lax.stop_gradient(inputs), max_iterations=max_iterations, is_quick=False)[0]
        plan = with_derivatives(mdp, reward, plan)
    if not is_batch:
        plan = jax.tree.map(lambda leaf: leaf[0], plan)
    return jax.tree.map(checks.to_device, plan)


def reward_batch(mdp: MDP, reward) -> tuple[Float[Array, "B S A"], bool]:
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
    reward = check_reward_values(mdp, reward, forbidden=-np.inf, may_forbid=True)
    xp = checks.arrays_of(reward, mdp.allowed)
    if not is_pair:
        reward = xp.broadcast_to(reward if is_wide else reward[..., None], (*shape[: len(shape) - is_wide], actions))
        if mdp.restricts_actions:
            reward = xp.where(xp.asarray(mdp.allowed), reward, -np.inf)
    reward = reward if is_batch else reward[None]
    if not checks.is_traced(reward):
        has_action = np.isfinite(np.asarray(reward)).any(axis=-1)
        if not has_action.all():
            lane, state = np.argwhere(~has_action)[0]
            where = f"[{lane}, {state}]" if is_batch else f"[{state}]"
            raise ValueError(f"reward{where} is -inf for every action: a state needs one that is allowed")
    return reward, is_batch


def first_values(xp: ModuleType, mdp: MDP, initial_value, lanes: int) -> Float[Array, "B S"]:
    """Brings the accepted shapes of `initial_value` to [B, S]; checks the values; zero if None."""
    if initial_value is None:
        initial_value = np.zeros(mdp.num_states)
    elif not checks.is_traced(initial_value):
        host = checks.as_host_array("initial_value", initial_value)
        initial_value = checks.require_floats_in(mdp.dtype, "initial_value", host)
    shape = (lanes, mdp.num_states)
    good = initial_value.shape in (shape, shape[1:])
    checks.require_shape("initial_value", initial_value, f"{shape[1:]} or {shape}", good)
    return xp.broadcast_to(xp.asarray(initial_value, mdp.dtype), shape)


def _scale(xp: ModuleType, reward: Float[Array, "B S A"]) -> Float[Array, " B"]:
    """The largest |max_a r|; what is never chosen, such as a penalty of -1e6, does not count."""
    best = xp.abs(reward.max(axis=2)).max(axis=1)
    every = xp.where(xp.isfinite(reward), xp.abs(reward), 0.0).max(axis=(1, 2))
    return xp.where(best > 0, best, every)


def _plan_at_hand(
    mdp: MDP, reward, value, tolerance, *, max_iterations: int, is_polished: bool, report: Callable | None
) -> Plan:
    """The plan for concrete arrays, batch last: by sweeps on the device, policy iteration on the host, or both."""
    if any(mdp.num_states > states and float(mdp.discount) <= discount for states, discount in _SWEPT):
        options = {"max_iterations": max_iterations, "is_quick": True, "is_patient": True, "report": report}
        return plan_in_program(mdp, reward, value, tolerance, **options)[0]
    model, host_reward = host_model(mdp), reward.astype(np.float64)
    lanes = reward.shape[-1]
    if is_polished and max_iterations > 0 and model.plans_sooner(lanes):
        expected = [model.expected_next_value(lane) for lane in value.T]
        start = host_reward + model.discount * np.stack(expected, axis=-1)
        return _improve_on_host(model, host_reward, empty_plan(mdp, lanes), start, np.arange(lanes), max_iterations)
    options = {"max_iterations": max_iterations, "report": report}
    plan, is_open = plan_in_program(mdp, reward, value, tolerance, is_quick=True, **options)
    is_slow, is_open = np.asarray(plan.status) == Status.STALLED, np.asarray(is_open)
    if not (is_slow.any() or (is_polished and is_open.any())):
        return plan
    if is_slow.any() and not model.is_solvable:
        return plan_in_program(mdp, reward, value, tolerance, is_quick=False, **options)[0]
    may_polish = is_polished and mdp.num_states <= _POLISHED_STATES and model.is_narrow
    left = np.flatnonzero(is_slow | (is_open & may_polish))
    start = np.moveaxis(np.asarray(plan.action_value), 0, -1)
    return _improve_on_host(model, host_reward, plan, start, left, max_iterations)


def empty_plan(mdp: MDP, lanes: int) -> Plan:
    """A plan of `lanes` rewards of which nothing is known."""
    pairs = (lanes, *mdp.allowed.shape)
    zeros, count = np.zeros(pairs, mdp.dtype), np.zeros(lanes, np.int32)
    return Plan(
        policy=np.broadcast_to(uniform_policy(mdp), pairs),
        value=zeros[..., 0],
        action_value=zeros,
        iterations=count,
        residual=np.full(lanes, np.inf, mdp.dtype),
        status=np.full(lanes, Status.STALLED, np.int32),
    )


def _improve_on_host(
    model: HostModel,
    reward: Float[np.ndarray, "S A B"],
    plan: Plan,
    start: Float[np.ndarray, "S A B"],
    lanes: Int[np.ndarray, " L"],
    max_iterations: int,
) -> Plan:
    """The plan, with the given lanes brought to the end by policy iteration.

    Args:
      reward: float64. start: of its best actions the first policy is made. lanes: which ones, by number.
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
    fields = {name: array.astype(dtype) for name, array in fields.items()}
    return plan.replace(**fields, iterations=iterations, status=status)
