"""Occupancy measures, feature expectations and policy values by jitted linear solves.

With P_pi(s, s') = sum_a pi(s, a) T(s, a, s'), the state occupancy mu and the value V of a reward r are the
solutions of a linear system and of its transpose:

    (I - gamma P_pi)^T mu = alpha,   x(s, a) = mu(s) pi(s, a)        (the flow, Boularias and Chaib-draa eq. 3)
    (I - gamma P_pi)   V  = r_pi,    r_pi(s) = sum_a pi(s, a) r(s, a)

Small models are solved by dense LU. Larger ones by BiCGSTAB on the products with P_pi (see `policy_chain`), followed,
where Krylov stops short, by plain sweeps x <- b + gamma P x, which always contract. The residual is checked at the end:
a solution that misses the tolerance (a policy that holds NaN, say) comes back as NaN, never as a wrong number.
Derivatives are implicit (one more solve with the transpose), whatever the method.

Policies are [S, A] or a batch [B, S, A]; inside, the batch is the last axis.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from jaxhom.inputs import as_model, check_policy, check_reward, require_policy_shape
from jaxhom.mdp import MDP, expected_next_values, push_forward, state_transition
from jaxhom.policy_chain import policy_chain

_MAX_LU_STATES = 64  # from here on sweeps of the successor layout are faster
_MAX_LU_STATES_DENSE = 256  # ... and products with the dense tensor
_MAX_KRYLOV_STEPS = 1000
_CACHED_NUMBERS = 3000  # states times lanes of a batch


def occupancy(mdp: MDP, policy: jax.Array) -> jax.Array:
    """Discounted state-action occupancy x(s, a) = E sum_t gamma^t 1[s_t = s, a_t = a].

    Args:
      mdp: the model.
      policy: [S, A] or [B, S, A], rows sum to 1.

    Returns:
      [S, A] or [B, S, A]; each sums to 1 / (1 - discount).

    Raises:
      ValueError: if `policy` has another shape.

    Source: Boularias and Chaib-draa 2010, section II and eqs. (3)-(4).
    """
    mdp = as_model(mdp)
    policy = check_policy(mdp, policy)
    if policy.ndim == 3:
        return jnp.moveaxis(_occupancy(mdp, jnp.moveaxis(policy, 0, -1)), -1, 0)
    return _occupancy(mdp, policy)


def feature_expectations(mdp: MDP, policy: jax.Array) -> jax.Array:
    """Discounted feature expectations V_i(pi) = sum_{s, a} x_pi(s, a) phi_i(s, a).

    Args:
      mdp: the model, with K features.
      policy: [S, A] or [B, S, A], rows sum to 1.

    Returns:
      [K] or [B, K]; divide by 1 / (1 - discount) for a weighted average per step.

    Raises:
      ValueError: if `policy` has another shape.

    Source: Boularias and Chaib-draa 2010, section II.
    """
    mdp = as_model(mdp)
    return jnp.einsum("...sa,sak->...k", occupancy(mdp, policy), mdp.features)


def policy_value(mdp: MDP, policy: jax.Array, reward: jax.Array) -> jax.Array:
    """State values V(s) = E[sum_t gamma^t r(s_t, a_t) | s_0 = s] of a policy.

    Args:
      mdp: the model.
      policy: [S, A] or [B, S, A], rows sum to 1.
      reward: [S, A], or [B, S, A] beside a batch of policies.

    Returns:
      [S] or [B, S].

    Raises:
      ValueError: if the shapes do not fit.

    Source: Boularias and Chaib-draa 2010, section II.
    """
    mdp = as_model(mdp)
    policy = require_policy_shape(mdp, policy)
    reward = check_reward(mdp, reward, policy.shape)
    policy = check_policy(mdp, policy)
    reward_under_policy = (policy * reward).sum(axis=-1)
    if policy.ndim == 3:
        batch_last = jnp.moveaxis(policy, 0, -1)
        return _solve_values(mdp, batch_last, reward_under_policy.T).T
    return _solve_values(mdp, policy, reward_under_policy)


@jax.jit
def _occupancy(mdp: MDP, policy: jax.Array) -> jax.Array:
    """`occupancy` with the batch, if any, last: [S, A] or [S, A, B]."""
    initial = jnp.broadcast_to(mdp.initial[(...,) + (None,) * (policy.ndim - 2)], policy.shape[:1] + policy.shape[2:])
    state_occupancy = _solve_flow(mdp, policy, initial)
    # Rounding can leave -1e-17 where nothing goes; lifted without touching the derivative.
    lifted = jnp.maximum(state_occupancy, 0.0)
    state_occupancy += jax.lax.stop_gradient(lifted - state_occupancy)
    return state_occupancy[:, None] * policy


def rough_state_occupancy(mdp: MDP, policy: jax.Array, residual: jax.Array) -> jax.Array:
    """State occupancies mu [S, B] of policies [S, A, B], up to a residual of the flow: for inner loops, under `jit`.

    Args:
      mdp: the model.
      policy: [S, A, B], rows sum to 1.
      residual: scalar or [B], the 2-norm of (I - gamma P_pi)^T mu - alpha that is small enough. Expectations of a
        feature within [-1, 1] are then off by at most sqrt(S) residual / (1 - gamma).

    Returns:
      mu [S, B]; NaN on lanes that missed the residual. Not to be differentiated.
    """
    initial = jnp.broadcast_to(mdp.initial[:, None], (mdp.num_states, policy.shape[2]))
    if is_solved_by_lu(mdp):
        return _solve_by_lu(mdp, policy, initial, transpose=True)
    forward, _ = _products(mdp, policy)
    return _solve_by_krylov(mdp.discount, forward, initial, residual)


def _solve_flow(mdp: MDP, policy: jax.Array, source: jax.Array) -> jax.Array:
    """Solves (I - gamma P_pi)^T mu = source; [S] or, batch last, [S, B]."""
    if is_solved_by_lu(mdp):
        return _solve_by_lu(mdp, policy, source, transpose=True)

    def solve(policy, source):
        forward, backward = _products(mdp, policy)
        return _solve_implicitly(mdp.discount, forward, backward, source)

    return _some_lanes_at_a_time(solve, policy, source)


@jax.jit
def _solve_values(mdp: MDP, policy: jax.Array, source: jax.Array) -> jax.Array:
    """Solves (I - gamma P_pi) V = source; [S] or, batch last, [S, B]."""
    if is_solved_by_lu(mdp):
        return _solve_by_lu(mdp, policy, source, transpose=False)

    def solve(policy, source):
        forward, backward = _products(mdp, policy)
        return _solve_implicitly(mdp.discount, backward, forward, source)

    return _some_lanes_at_a_time(solve, policy, source)


def _some_lanes_at_a_time(solve: Callable, policy: jax.Array, source: jax.Array) -> jax.Array:
    """`solve(policy, source)`, for policies [S, A, B] in batches that a CPU's cache can hold.

    Every lane brings weights on all edges, so that products of wide batches would wait for memory.
    """
    num_states, lanes = len(source), policy.shape[2] if policy.ndim == 3 else 1
    width = max(1, _CACHED_NUMBERS // num_states)
    if lanes <= width or jax.default_backend() != "cpu":
        return solve(policy, source)
    batches = -(-lanes // width)
    width = -(-lanes // batches)

    def split(array):
        padding = [(0, 0)] * (array.ndim - 1) + [(0, batches * width - lanes)]
        padded = jnp.pad(array, padding, mode="edge")
        return jnp.moveaxis(padded.reshape(*array.shape[:-1], batches, width), -2, 0)

    solved = jax.lax.map(lambda batch: solve(*batch), (split(policy), split(source)))
    return jnp.moveaxis(solved, 0, 1).reshape(num_states, -1)[:, :lanes]


def is_solved_by_lu(mdp: MDP) -> bool:
    """Whether LAPACK solves for this model's occupancies. Programs that call it must not run at the same time."""
    return mdp.num_states <= (_MAX_LU_STATES_DENSE if mdp.is_dense else _MAX_LU_STATES)


def _products(mdp: MDP, policy: jax.Array) -> tuple[Callable, Callable]:
    """The products with P_pi^T and P_pi."""
    if not mdp.is_dense:
        if policy.ndim == 3 and policy.shape[2] == 1:  # gathers of single numbers, not of rows of one
            return tuple(_on_one_lane(product) for product in _products(mdp, policy[..., 0]))
        chain = policy_chain(mdp.edges, mdp.probability, policy)
        return chain.push_forward, chain.expected_next_value
    if policy.ndim == 2:
        transition = state_transition(mdp, policy)
        return lambda mu: mu @ transition, lambda value: transition @ value

    # One matrix for all lanes: its product is worth more than the A times fewer numbers of a matrix per lane.
    def forward(mu):
        return push_forward(mdp, mu[:, None] * policy)

    def backward(value):
        return sum(policy[:, a] * v for a, v in enumerate(expected_next_values(mdp, value)))

    return forward, backward


def _on_one_lane(product: Callable) -> Callable:
    return lambda x: product(x[:, 0])[:, None]


def _solve_by_lu(mdp: MDP, policy: jax.Array, source: jax.Array, transpose: bool) -> jax.Array:
    def solve(policy, source):
        system = jnp.eye(mdp.num_states, dtype=mdp.dtype)
        system -= mdp.discount * state_transition(mdp, policy)
        return jnp.linalg.solve(system.T if transpose else system, source)

    if policy.ndim == 3:
        return jax.vmap(solve, in_axes=-1, out_axes=-1)(policy, source)
    return solve(policy, source)


def _solve_implicitly(discount, product: Callable, transposed: Callable, source) -> jax.Array:
    """Solves x = source + discount * product(x), differentiable through `custom_linear_solve`."""

    def solver(operator):
        return lambda _, b: _solve_by_krylov(discount, operator, b)

    return jax.lax.custom_linear_solve(
        lambda x: x - discount * product(x),
        source,
        solve=solver(product),
        transpose_solve=solver(transposed),
    )


def _solve_by_krylov(discount, product: Callable, b: jax.Array, residual: jax.Array | float = 0.0) -> jax.Array:
    """Solves x = b + discount * product(x) to the 2-norm `residual` per lane, or as far as rounding allows."""
    x = _bicgstab(lambda v: v - discount * product(v), b, residual)
    return _sweep_until(lambda v: b + discount * product(v), x, b, discount, residual)


def _norm(x: jax.Array) -> jax.Array:
    return jnp.sqrt((x * x).sum(axis=0))


def _goal(x: jax.Array, b: jax.Array, residual) -> jax.Array:
    """Residual to reach per lane, in the 2-norm: at the least a small multiple of what rounding in x and b leaves."""
    return jnp.maximum(residual, 16.0 * jnp.finfo(b.dtype).eps * (_norm(x) + _norm(b)))


def _bicgstab(system: Callable, b: jax.Array, goal: jax.Array | float) -> jax.Array:
    """Batched BiCGSTAB (van der Vorst 1992) from 0; lanes are the trailing axis and stop one by one.

    A lane stops by steps of length 0, which costs nothing, where a choice between old and new arrays would. One that
    breaks down comes back as 0; the caller's sweeps take over from there.
    """
    floor = jnp.maximum(0.5 * goal, 4.0 * jnp.finfo(b.dtype).eps * _norm(b))

    def dot(u, v):
        return (u * v).sum(axis=0)

    def ratio(numerator, denominator, active):
        quotient = numerator / jnp.where(denominator != 0, denominator, 1.0)
        return jnp.where(active & (denominator != 0) & jnp.isfinite(quotient), quotient, 0.0)

    def keep_going(state):
        return jnp.any(state[4]) & (state[-1] < _MAX_KRYLOV_STEPS)

    def step(state):
        x, residual, direction, rho, active, _, count = state
        product = system(direction)
        alpha = ratio(rho, dot(shadow, product), active)
        half = residual - alpha * product
        half_product = system(half)
        omega = ratio(dot(half_product, half), dot(half_product, half_product), active)
        x = x + alpha * direction + omega * half
        residual = half - omega * half_product
        new_rho, size = dot(shadow, residual), _norm(residual)
        beta = ratio(new_rho, rho, active) * ratio(alpha, omega, active)
        direction = residual + beta * (direction - omega * product)
        return x, residual, direction, new_rho, active & (beta != 0) & (size > floor), size, count + 1

    # Any fixed dense vector will do. Not b: from a single start state it would see nothing of what moves on.
    shadow = 1.0 + jnp.sin(jnp.arange(len(b), dtype=b.dtype) ** 2)
    shadow = jnp.broadcast_to(shadow.reshape(-1, *(1,) * (b.ndim - 1)), b.shape)
    rho, size = dot(shadow, b), _norm(b)
    start = (jnp.zeros_like(b), b, b, rho, (rho != 0) & (size > floor), size, jnp.zeros((), jnp.int32))
    x, *_, last, _ = jax.lax.while_loop(keep_going, step, start)
    return jnp.where(last <= size, x, 0.0)


def _sweep_until(sweep: Callable, x: jax.Array, b: jax.Array, discount, residual) -> jax.Array:
    """Applies the contraction `sweep` until its change is small enough on every lane; NaN where it never is."""
    limit = jnp.log(jnp.finfo(x.dtype).eps) / jnp.log(discount) + 10

    def is_rough(x, swept, factor=1.0):
        return ~(_norm(swept - x) <= factor * _goal(x, b, residual))

    def keep_going(state):
        x, swept, count = state
        return jnp.any(is_rough(x, swept)) & (count < limit)

    def step(state):
        _, swept, count = state
        return swept, sweep(swept), count + 1

    start = (x, sweep(x), jnp.zeros((), jnp.int32))
    x, swept, _ = jax.lax.while_loop(keep_going, step, start)
    return jnp.where(is_rough(x, swept, factor=10.0), jnp.nan, swept)
