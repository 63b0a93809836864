"""Linear systems of a policy's chain, in JAX: for programs, for batches, and for models whose graph fills up.

With P_pi(s, s') = sum_a pi(s, a) T(s, a, s') these are x = b + gamma P_pi x (values) and its transpose (flows). Small
models are solved by dense LU. Larger ones by BiCGSTAB on the products with P_pi (`Dynamics.chain`), followed, where
Krylov stops short, by some plain sweeps x <- b + gamma P x, which always contract.

Both can fail where the discount is near 1: Krylov on graphs that mix slowly, and LU in the digits that float32 has. So
every solution is checked, by its residual and by the error that the residual allows. What fails is computed anew
by doubling (Puterman 1994, section 6.4, on series of this kind),

    x_0 = b,   x_{k+1} = x_k + gamma^(2^k) P_k x_k,   P_{k+1} = P_k P_k,

up to a thousand states: products of non-negative numbers alone, with the rows of P_k brought to sum 1 in every step, so
that nothing cancels whatever the discount. A larger model's solution that fails comes back as NaN, never as a wrong
number. Derivatives are implicit (one more solve with the transpose), whatever the method.

The batch, if any, is the last axis; a lane is one problem of the batch.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from jaxhom.models.mdp import MDP, state_transition

if TYPE_CHECKING:
    from jaxtyping import Array, Bool, Float

_MAX_LU_STATES = 64  # from here on sweeps of the successor layout are faster
_MAX_LU_STATES_DENSE = 256  # ... and products with the dense tensor
_MAX_KRYLOV_STEPS = 1000  # chains that mix take tens; what is left goes to sweeps, and then to doubling or the host
_MAX_SWEEPS = 4000  # the error falls by gamma with each: to nothing at a discount of 0.99, where 0.99^4000 is 4e-18
_MAX_DOUBLING_STATES = 1024  # a product of two S x S matrices takes S^3 operations, and there are dozens of them
_QUICK_STEPS = 200  # of Krylov and sweeps, where something better stands behind
_CACHED_NUMBERS = 3000  # states times lanes of a batch, of which each brings weights on all edges


def solve_chain(
    mdp: MDP,
    policy: Float[Array, "S A *B"],
    source: Float[Array, "S *B"],
    *,
    transpose: bool,
    is_quick: bool = False,
) -> Float[Array, "S *B"]:
    """Solves (I - gamma P_pi) x = source, or its transpose; for use under `jit`, differentiable.

    Args:
      mdp: the model.
      policy: [S, A] or [S, A, B], rows sum to 1.
      source: [S] or [S, B].
      transpose: for flows.
      is_quick: give up early, for callers that can solve otherwise what comes back as NaN.

    Returns:
      x, as `source`; NaN on lanes without a solution that the checks accept.
    """

    def solve(policy, source):
        chain = mdp.dynamics.chain(policy)
        forward, backward = chain.push_forward, chain.expected_next_value
        product, transposed = (forward, backward) if transpose else (backward, forward)

        def solver(product, transpose):
            return lambda _, b: _solve(mdp, policy, product, b, transpose, is_quick, by_lu=is_solved_by_lu(mdp))

        return jax.lax.custom_linear_solve(
            lambda x: x - mdp.discount * product(x),
            source,
            solve=solver(product, transpose),
            transpose_solve=solver(transposed, not transpose),
        )

    return solve(policy, source) if is_solved_by_lu(mdp) else _some_lanes_at_a_time(solve, policy, source)


def rough_state_occupancy(
    mdp: MDP, policy: Float[Array, "S A B"], residual: Float[Array, "*B"], *, is_quick: bool = False
) -> Float[Array, "S B"]:
    """State occupancies mu [S, B] of policies [S, A, B], up to a residual of the flow: for inner loops, under `jit`.

    Args:
      mdp: the model.
      policy: [S, A, B], rows sum to 1.
      residual: scalar or [B], the 2-norm of (I - gamma P_pi)^T mu - alpha that is small enough. Expectations of a
        feature within [-1, 1] are then off by at most sqrt(S) residual / (1 - gamma).
      is_quick: by iterations alone, and give up early.

    Returns:
      mu [S, B]; NaN on lanes that missed the residual. Not to be differentiated.
    """
    initial = jnp.broadcast_to(mdp.initial[:, None], (mdp.num_states, policy.shape[2]))
    forward = mdp.dynamics.chain(policy).push_forward
    return _solve(mdp, policy, forward, initial, True, is_quick, residual, by_lu=is_solved_by_lu(mdp) and not is_quick)


def is_solved_by_lu(mdp: MDP) -> bool:
    """Whether LAPACK solves for this model's occupancies. Programs that call it must not run at the same time."""
    return mdp.num_states <= (_MAX_LU_STATES_DENSE if mdp.is_dense else _MAX_LU_STATES)


def _some_lanes_at_a_time(
    solve: Callable, policy: Float[Array, "S A *B"], source: Float[Array, "S *B"]
) -> Float[Array, "S *B"]:
    """`solve(policy, source)`, for batches of policies in parts that a CPU's cache can hold.

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


def _solve(
    mdp: MDP, policy, product: Callable, b, transpose: bool, is_quick: bool, residual=0.0, *, by_lu: bool
) -> Float[Array, "S *B"]:
    """Solves x = b + discount * product(x), product being that of the policy's chain or of its transpose."""
    if by_lu:
        x = _solve_by_lu(mdp, policy, b, transpose)
    else:
        steps = _QUICK_STEPS if is_quick else _MAX_KRYLOV_STEPS
        x = _bicgstab(lambda v: v - mdp.discount * product(v), b, residual, steps)
        sweeps = _QUICK_STEPS if is_quick else _MAX_SWEEPS
        x = _sweep_until(lambda v: b + mdp.discount * product(v), x, b, residual, sweeps)
    is_good = _is_accurate(mdp, product, x, b, transpose, residual)
    if is_quick or mdp.num_states > _MAX_DOUBLING_STATES:
        return jnp.where(is_good, x, jnp.nan)
    return _mend_by_doubling(mdp, policy, x, b, is_good, transpose)


def _solve_by_lu(mdp: MDP, policy: Float[Array, "S A *B"], source, transpose: bool) -> Float[Array, "S *B"]:
    def solve(policy, source):
        system = jnp.eye(mdp.num_states, dtype=mdp.dtype)
        system -= mdp.discount * state_transition(mdp, policy)
        return jnp.linalg.solve(system.T if transpose else system, source)

    if policy.ndim == 3:
        return jax.vmap(solve, in_axes=-1, out_axes=-1)(policy, source)
    return solve(policy, source)


def _norm(x: Float[Array, "S *B"]) -> Float[Array, "*B"]:
    return jnp.sqrt((x * x).sum(axis=0))


def _goal(x: Float[Array, "S *B"], b: Float[Array, "S *B"], residual) -> Float[Array, "*B"]:
    """Residual to reach per lane, in the 2-norm: at the least a small multiple of what rounding in x and b leaves."""
    return jnp.maximum(residual, 16.0 * jnp.finfo(b.dtype).eps * (_norm(x) + _norm(b)))


def _is_accurate(mdp: MDP, product: Callable, x, b, transpose: bool, residual) -> Bool[Array, "*B"]:
    """Lane by lane: the residual is small, and so is the error that it allows.

    |(I - gamma P)^-1| is 1 / (1 - gamma) in the norm of maxima for values, and in that of sums for their transpose.
    Where a rough residual was asked for, it is what counts.
    """
    missing = b + mdp.discount * product(x) - x
    norm = (lambda v: jnp.abs(v).sum(axis=0)) if transpose else (lambda v: jnp.abs(v).max(axis=0))
    share = 1e-7 if x.dtype == jnp.float64 else (1e-4 if mdp.num_states <= _MAX_DOUBLING_STATES else 1e-3)
    allowed = share * (1.0 - mdp.discount) * jnp.maximum(norm(x), norm(b))
    is_small = _norm(missing) <= 10.0 * _goal(x, b, residual)
    return is_small & ((norm(missing) <= allowed) | (_norm(missing) <= residual))


def _mend_by_doubling(mdp: MDP, policy, x, b, is_good, transpose: bool) -> Float[Array, "S *B"]:
    """x, with the lanes that are not good computed anew."""

    def mend(policy, x, b, is_good):
        shape = (mdp.num_states,) * 2
        chain = jax.lax.cond(
            is_good, lambda: jnp.zeros(shape, mdp.dtype), lambda: state_transition(mdp, policy).astype(mdp.dtype)
        )
        log_discount = jnp.log1p(-(1.0 - mdp.discount))  # no digit of 1 - gamma is lost
        eps = jnp.finfo(mdp.dtype).eps

        def keep_going(state):
            return state[2] * log_discount > jnp.log(0.25 * eps)

        def double(state):
            chain, x, times = state
            moved = x @ chain if transpose else chain @ x
            chain = chain @ chain
            total = chain.sum(axis=1, keepdims=True)
            chain = jnp.where(jnp.abs(total - 1.0) < 1e-2, chain / total, chain)
            return chain, x + jnp.exp(times * log_discount) * moved, 2.0 * times

        times = jnp.where(is_good, jnp.inf, 1.0).astype(mdp.dtype)  # gamma^inf = 0: nothing is left to do
        doubled = jax.lax.while_loop(keep_going, double, (chain, b, times))[1]
        return jnp.where(is_good, x, doubled)

    if policy.ndim == 2:
        return mend(policy, x, b, is_good)
    lanes = (jnp.moveaxis(policy, -1, 0), x.T, b.T, is_good)
    return jax.lax.map(lambda lane: mend(*lane), lanes).T


def _bicgstab(
    system: Callable, b: Float[Array, "S *B"], goal: Float[Array, "*B"] | float, max_steps: int
) -> Float[Array, "S *B"]:
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
        return jnp.any(state[4]) & (state[-1] < max_steps)

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


def _sweep_until(
    sweep: Callable, x: Float[Array, "S *B"], b: Float[Array, "S *B"], residual, max_sweeps: int
) -> Float[Array, "S *B"]:
    """Applies the contraction `sweep` until its change is small enough on every lane, or for so many times."""

    def keep_going(state):
        x, swept, count = state
        return jnp.any(_norm(swept - x) > _goal(x, b, residual)) & (count < max_sweeps)

    def step(state):
        _, swept, count = state
        return swept, sweep(swept), count + 1

    start = (x, sweep(x), jnp.zeros((), jnp.int32))
    return jax.lax.while_loop(keep_going, step, start)[1]
