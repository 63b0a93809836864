"""Soft optimal policies: values whose maximum over actions is softened by a temperature.

With tau the temperature and H the entropy of a distribution in nats, the soft optimal policy maximises
E sum_t gamma^t (r(s_t, a_t) + tau H(pi(. | s_t))), and is the fixed point of

    Q = r + gamma T V,    V(s) = tau log sum_a exp(Q(s, a) / tau),    pi(a | s) = exp((Q(s, a) - V(s)) / tau).

It is what maximum causal entropy assumes of an expert (Ziebart, Bagnell and Dey 2010). Value iteration gets there with
the discount; Newton's method on the same equation, which is policy iteration with the soft maximum, in a handful of
linear solves: V <- (I - gamma P_pi)^-1 (r_pi + tau H(pi)), pi the soft policy of the V before. As the soft maximum is
convex, it cannot overshoot: from the second on the values only rise.

On the host in float64 (`host_chains`) where that is quicker than compiling, in one program otherwise, batch last.
"""

from __future__ import annotations

import functools
from types import ModuleType
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom import checks
from jaxhom.models.inputs import as_model
from jaxhom.models.mdp import MDP, expected_next_value
from jaxhom.planning.chain_solver import solve_chain
from jaxhom.planning.host_chains import HostChain, HostModel, host_model
from jaxhom.planning.occupancy import policy_value
from jaxhom.planning.optimal import empty_plan, first_values, reward_batch
from jaxhom.planning.plan import Plan
from jaxhom.planning.plan_program import hidden_share
from jaxhom.status import Status

if TYPE_CHECKING:
    from jaxtyping import ArrayLike, Float

_LEAST_DIGITS = {np.dtype(np.float64): 1e-10, np.dtype(np.float32): 1e-5}  # default residual, in sizes of the rewards
_ROUNDINGS = 32.0  # of the values, in a residual: below that no step gets on
_ROUGH = 1e-3  # share of a step that may be off: the next one sees to it
_FEW_LANES = 4  # that the host does sooner than a program compiles, whatever the model
_PATIENCE = 10  # steps without a smaller residual, which should be a square of the last one
_SLOW = 0.2  # of the last residual: where more is left, the factors at hand belong to a policy too far away


def soft_optimal_policy(
    mdp: MDP,
    reward: Float[ArrayLike, "*B S A"] | Float[ArrayLike, "*B S"],
    *,
    temperature: float | Float[ArrayLike, ""] = 1.0,
    initial_value: Float[ArrayLike, "*B S"] | None = None,
    tolerance: float | None = None,
    max_iterations: int = 1000,
) -> Plan:
    """Finds the policy of largest discounted reward plus temperature times entropy, for each reward.

    Works under `jit`, `vmap` and `grad`: policy, value and action values have derivatives of any order in reward,
    temperature and all numbers of the model.

    Args:
      mdp: the model.
      reward: [S, A], [S], [B, S, A] or [B, S, 1], as in `optimal_policy`; -inf forbids an action.
      temperature: tau > 0, in units of reward: what one nat of entropy is worth. Towards 0 the policy becomes optimal.
      initial_value: [S] or [B, S], where to start (a former `Plan.value`); zero if None.
      tolerance: residual to reach; default 1e-10 (1e-5 in float32) times the largest |reward| plus temperature.
      max_iterations: policies after which to stop all the same; it takes 5 to 15.

    Returns:
      A `Plan` whose policy is random: exp((action_value - value) / temperature). `residual` is
      max_s |tau log sum_a exp(action_value / tau) - value|, and `value` within residual / (1 - discount) of the soft
      optimum; a soft value is the best reward plus tau times the entropies, so not a bound on rewards alone.

    Raises:
      ValueError: as `optimal_policy`; if `temperature` or `tolerance` is not one positive number.

    Example:
      >>> from jaxhom import MDP
      >>> stay_or_go = MDP.from_dense([[[1.0, 0.0], [0.0, 1.0]], [[0.0, 1.0], [0.0, 1.0]]], discount=0.5)
      >>> plan = soft_optimal_policy(stay_or_go, [[1.0, 0.0], [0.0, 0.0]])
      >>> print(plan.policy.round(2)[0], f"{plan.value[1]:.3f}")  # state 1 is worth log(2) / (1 - 0.5)
      [0.82 0.18] 1.386

    Source: Ziebart, Bagnell and Dey 2010; for Newton's method Puterman 1994, section 6.4.
    """
    mdp = as_model(mdp)
    reward, is_batch = reward_batch(mdp, reward)
    checks.require_positive("temperature", temperature)
    if not checks.is_traced(temperature):
        temperature = checks.require_number("temperature", temperature)
    xp = checks.arrays_of(mdp, reward, initial_value, temperature)
    value = first_values(xp, mdp, initial_value, len(reward))
    max_iterations = checks.require_count("max_iterations", max_iterations)
    share = _LEAST_DIGITS.get(np.dtype(mdp.dtype), 1e-5)
    if tolerance is not None:
        checks.refuse_traced(tolerance=tolerance)
        tolerance = checks.require_number("tolerance", tolerance)
        checks.require_positive("tolerance", tolerance)
    goal = _Goal(tolerance, share, max_iterations)
    if xp is np:
        plan = _plan_at_hand(mdp, reward, value, temperature, goal)
    else:
        plan = _plan_in_program(mdp, reward, value, jnp.asarray(temperature, mdp.dtype), goal=goal)
    if not is_batch:
        plan = jax.tree.map(lambda leaf: leaf[0], plan)
    return jax.tree.map(checks.to_device, plan)


class _Goal(NamedTuple):
    """When to stop: at a residual, or at a share of the rewards' size; or after a number of policies."""

    tolerance: float | None
    share: float
    max_iterations: int

    def residual(self, xp: ModuleType, reward, temperature):
        """[B], for rewards [B, S, A]."""
        size = xp.where(xp.isfinite(reward), xp.abs(reward), 0.0).max(axis=(1, 2)) + temperature
        return self.share * size if self.tolerance is None else xp.full(len(reward), self.tolerance, reward.dtype)

    def status(self, xp: ModuleType, residual, tolerance, rounding, iterations):
        """A `Status` per lane; nobody who gives no tolerance asks for more than rounding allows."""
        is_solved = residual <= (xp.maximum(tolerance, rounding) if self.tolerance is None else tolerance)
        limited = xp.where(iterations >= self.max_iterations, Status.ITERATION_LIMIT, Status.STALLED)
        return xp.where(is_solved, Status.SOLVED, limited).astype(np.int32)


def _rounding(value, dtype, axis=None):
    """What rounding in a type can leave of a residual."""
    return _ROUNDINGS * jnp.finfo(dtype).eps * abs(value).max(axis=axis)


def soft_policy(xp: ModuleType, action_value, temperature):
    """The soft policy of action values, softened along axis 1; and its soft maxima. In NumPy, or differentiable."""
    best = action_value.max(axis=1, keepdims=True)
    if xp is jnp:
        best = jax.lax.stop_gradient(best)
    is_possible = xp.isfinite(action_value)  # 0 times infinity is no derivative
    weights = xp.where(is_possible, xp.exp(xp.where(is_possible, action_value - best, 0.0) / temperature), 0.0)
    total = weights.sum(axis=1, keepdims=True)
    return weights / total, (best + temperature * xp.log(total))[:, 0]


def soft_reward(xp: ModuleType, policy, reward, temperature):
    """r_pi + tau H(pi), along axis 1; where an action is forbidden, its policy is 0 and counts for nothing."""
    happens = policy > 0
    kept = xp.where(happens, reward, 0.0) - temperature * xp.log(xp.where(happens, policy, 1.0))
    return (policy * kept).sum(axis=1)


def _plan_at_hand(mdp: MDP, reward: Float[np.ndarray, "B S A"], value, temperature: float, goal: _Goal) -> Plan:
    """The plan of concrete arrays: the host first where it is quick, and last for what the program could not do."""
    model = host_model(mdp)
    if len(reward) <= _FEW_LANES or (model.iterates_slowly and model.is_soon_factorised):
        plan = jax.tree.map(np.array, empty_plan(mdp, len(reward)))
        left = np.arange(len(reward))
    else:
        plan = _plan_in_program(mdp, reward, value, np.asarray(temperature, mdp.dtype), goal=goal)
        plan = jax.tree.map(np.array, plan)
        left = np.flatnonzero(plan.status == Status.STALLED) if model.is_solvable else ()
    tolerance = goal.residual(np, reward.astype(np.float64), temperature)
    for lane in left:
        found = soft_values_on_host(
            model, reward[lane].astype(np.float64), value[lane], temperature, tolerance[lane], goal.max_iterations
        )
        plan.policy[lane], plan.value[lane], plan.action_value[lane] = found[:3]
        rounded = np.where(reward[lane] == -np.inf, 0.0, found.action_value)
        hidden = np.abs(found.value - plan.value[lane]).max() + np.abs(rounded - rounded.astype(mdp.dtype)).max()
        plan.iterations[lane], plan.residual[lane] = found.iterations, found.residual + hidden
        rounding = _rounding(found.value, mdp.dtype)
        plan.status[lane] = goal.status(np, plan.residual[lane], tolerance[lane], rounding, found.iterations)
    return plan


class HostSoftValues(NamedTuple):
    """What `soft_values_on_host` returns, in float64: policy [S, A], value [S], action_value [S, A]."""

    policy: Float[np.ndarray, "S A"]
    value: Float[np.ndarray, " S"]
    action_value: Float[np.ndarray, "S A"]
    iterations: int
    residual: float


def soft_values_on_host(
    model: HostModel,
    reward: Float[np.ndarray, "S A"],
    value: Float[np.ndarray, " S"],
    temperature: float,
    tolerance: float,
    max_iterations: int,
    chain: HostChain | None = None,
) -> HostSoftValues:
    """Newton's method by sparse LU, until the residual is small enough, or as small as rounding lets it be.

    The factors of a policy nearby do as well while each step leaves little: `chain`, if given, is where to begin.
    """
    value, residuals = np.asarray(value, np.float64), []
    while True:
        action_value = reward + model.discount * model.expected_next_value(value)
        policy, soft = soft_policy(np, action_value, temperature)
        residuals.append(float(np.abs(soft - value).max()))
        is_stuck = len(residuals) > _PATIENCE and min(residuals[-_PATIENCE:]) >= min(residuals[:-_PATIENCE])
        is_close = residuals[-1] <= max(tolerance, _rounding(value, np.float64))
        if is_close or is_stuck or len(residuals) > max_iterations:
            return HostSoftValues(policy, value, action_value, len(residuals) - 1, residuals[-1])
        if chain is None or (len(residuals) > 1 and residuals[-1] > _SLOW * residuals[-2]):
            chain = model.chain(policy, may_iterate=True)
        step = chain.value(soft - value, error=_ROUGH)
        value = value + step if np.isfinite(step).all() else soft  # a sweep, where the factors are no good


@functools.partial(jax.jit, static_argnames="goal")
def _plan_in_program(mdp: MDP, reward, value, temperature, *, goal: _Goal) -> Plan:
    """The plan of rewards [B, S, A] from values [B, S] on; differentiable."""
    inputs = jax.lax.stop_gradient((mdp, reward, value, temperature))
    value, iterations, residual, status = _iterate(*inputs, goal)
    value = _soft_values(mdp, reward, temperature, value)
    action_value = reward + mdp.discount * jnp.moveaxis(expected_next_value(mdp, value.T), -1, 0)
    policy = jax.vmap(lambda q: soft_policy(jnp, q, temperature)[0])(action_value)
    return Plan(
        policy=policy,
        value=value,
        action_value=action_value,
        iterations=iterations,
        residual=residual,
        status=status,
    )


def _iterate(mdp: MDP, reward, value, temperature, goal: _Goal):
    """Values [B, S], policies tried [B], residuals [B] and statuses [B]; the batch is last inside."""
    tolerance = goal.residual(jnp, reward, temperature)
    batch_last = jnp.moveaxis(reward, 0, -1)

    def look(value):
        action_value = batch_last + mdp.discount * expected_next_value(mdp, value)
        policy, soft = soft_policy(jnp, action_value, temperature)
        return policy, soft, jnp.abs(soft - value).max(axis=0)

    def is_open(value, residual):
        return residual > jnp.maximum(tolerance, _rounding(value, mdp.dtype, axis=0))

    def keep_going(state):
        return state.is_active.any()

    def improve(state):
        policy, soft, _ = look(state.value)
        solved = solve_chain(mdp, policy, soft_reward(jnp, policy, batch_last, temperature), transpose=False)
        solved = jnp.where(jnp.isfinite(solved).all(axis=0), solved, soft)  # a sweep, where nothing better is known
        value = jnp.where(state.is_active, solved, state.value)
        residual = look(value)[-1]
        is_better = residual < state.best
        iterations = state.iterations + state.is_active
        since = jnp.where(is_better, 0, state.since + 1)
        goes_on = is_open(value, residual) & (iterations < goal.max_iterations) & (since < _PATIENCE)
        best = jnp.minimum(state.best, residual)
        return _Loop(value, iterations, best, since, state.is_active & goes_on)

    first, none = look(value.T)[-1], jnp.zeros(len(reward), jnp.int32)
    end = jax.lax.while_loop(keep_going, improve, _Loop(value.T, none, first, none, is_open(value.T, first)))
    rounding, residual = _rounding(end.value, mdp.dtype, axis=0), look(end.value)[-1]
    if mdp.dtype != jnp.float64:
        rounding = jnp.maximum(rounding, hidden_share(mdp, mdp.dtype) * jnp.abs(end.value).max(axis=0))
        residual += hidden_share(mdp, mdp.dtype) * jnp.abs(end.value).max(axis=0)
    status = goal.status(jnp, residual, tolerance, 2.0 * rounding, end.iterations)
    return end.value.T, end.iterations, residual, status


class _Loop(NamedTuple):
    """What the iteration carries: values [S, B], and per lane steps, the best residual, and steps since then."""

    value: jax.Array
    iterations: jax.Array
    best: jax.Array
    since: jax.Array
    is_active: jax.Array


@jax.custom_jvp
def _soft_values(mdp, reward, temperature, value):
    """`value` [B, S], with the derivatives of the soft optimum: those of its policy's value (envelope theorem)."""
    del mdp, reward, temperature
    return value


@_soft_values.defjvp
def _(primals, tangents):
    mdp, reward, temperature, _ = primals
    value = _soft_values(*primals)
    action_value = reward + mdp.discount * jnp.moveaxis(expected_next_value(mdp, value.T), -1, 0)
    policy = jax.vmap(lambda q: soft_policy(jnp, q, temperature)[0])(action_value)  # differentiable, for second orders

    def of_policy(mdp, reward, temperature):
        happens = policy > 0
        entropy = -jnp.log(jnp.where(happens, policy, 1.0))
        return policy_value(mdp, policy, jnp.where(happens & jnp.isfinite(reward), reward, 0.0) + temperature * entropy)

    return value, jax.jvp(of_policy, primals[:3], tangents[:3])[1]
