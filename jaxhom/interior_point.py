"""A feasible primal-dual interior-point method for batches of the small LPs (9), for tight brackets on a CPU.

`pdhg.homomorphism_lp` states the program, min e subject to |K f| <= e over row-stochastic maps f. With slacks
s+ = e - K f and s- = e + K f, multipliers y+, y-, z and lambda, the central path is

    K^T (y+ - y-) - z - E^T lambda = 0,   sum(y+ + y-) = 1,   E f = 1,   y s = mu,   z f = mu,

E summing the rows of f. A strictly feasible start always exists (uniform rows, e above |K f|, uniform y), so every
iterate is feasible and certifies its own bracket. Each step is Mehrotra's predictor and corrector (1992): one Cholesky
factorisation of the normal matrix K^T (D+ + D-) K + Z / F, whose size is that of f and which is put together from
contractions of the two models, never from K. A step that is not finite is refused, and the lane stops where it is.
"""

import chex
import jax
import jax.numpy as jnp

from jaxhom.pdhg.homomorphism_lp import HomomorphismProblem, plain_adjoint, plain_forward

_TO_BOUNDARY = 0.99


@chex.dataclass(frozen=True)
class InteriorPointState:
    """Iterates and best bounds of B lanes, lanes first.

    Attributes:
      f: [B, n, m]. e: [B]. plus, minus: y+ and y-, [B, n, A, m]. z: [B, n, m].
      lower, upper: [B], best bounds. steps: int32 [B]. alive: bool [B], False once a step was refused.
    """

    f: jax.Array
    e: jax.Array
    plus: jax.Array
    minus: jax.Array
    z: jax.Array
    lower: jax.Array
    upper: jax.Array
    steps: jax.Array
    alive: jax.Array


def solve(problem: HomomorphismProblem, *, tolerance, threshold=None, max_iterations: int = 60) -> InteriorPointState:
    """Iterates until every lane has a bracket of the tolerance, has decided the threshold, or cannot go on."""
    models = (jnp.moveaxis(problem.source, -1, 0), jnp.moveaxis(problem.target, -1, 0))
    rows, columns = (jnp.moveaxis(mask, -1, 0) for mask in problem.masks((len(problem.source), len(problem.target))))
    real = jnp.broadcast_to(rows & columns, (models[0].shape[0], problem.source.shape[0], problem.target.shape[0]))
    free = real.at[:, 0].set(False) if problem.anchored else real

    def is_done(state):
        done = (state.upper - state.lower <= tolerance) | ~state.alive
        if threshold is not None:
            done |= (state.lower > threshold) | (state.upper <= threshold + tolerance)
        return done | (state.steps >= max_iterations)

    def advance(state):
        active = ~is_done(state)
        moved = jax.vmap(_step)(*models, real, free, state)
        moved = _bound(problem, moved)
        state = jax.tree.map(lambda new, old: _where(active, new, old), moved, state)
        return state.replace(steps=state.steps + active)

    start = _bound(problem, jax.vmap(_start, in_axes=(0, 0, 0, 0, 0))(*models, real, free, _first_map(problem)))
    return jax.lax.while_loop(lambda state: jnp.any(~is_done(state)), advance, start)


def _first_map(problem: HomomorphismProblem) -> jax.Array:
    return jnp.moveaxis(problem.start()[0], -1, 0)


def _where(mask, new, old):
    return jnp.where(mask.reshape(-1, *(1,) * (new.ndim - 1)), new, old)


def _bound(problem: HomomorphismProblem, state: InteriorPointState) -> InteriorPointState:
    """Keeps the better of the bounds so far and those of the present f and y."""
    f, y = jnp.moveaxis(state.f, 0, -1), jnp.moveaxis(state.plus - state.minus, 0, -1)
    lower, upper = problem.bounds(f, y, problem.forward(f), problem.adjoint(y))
    return state.replace(lower=jnp.maximum(state.lower, lower), upper=jnp.minimum(state.upper, upper))


def _start(source, target, real, free, f) -> InteriorPointState:
    """Uniform f and y, e well above |K f|, and z = 1 on the free entries: strictly feasible."""
    is_row = _constraints(real, source.shape[1])
    y = is_row.astype(f.dtype) / (2.0 * is_row.sum())
    zero = jnp.zeros((), f.dtype)
    return InteriorPointState(
        f=f,
        e=1.5 * jnp.abs(plain_forward(source, target, f)).max() + 0.1,
        plus=y,
        minus=y,
        z=jnp.where(free, 1.0 / is_row.sum(), 0.0),
        lower=zero,
        upper=zero + jnp.inf,
        steps=jnp.zeros((), jnp.int32),
        alive=jnp.asarray(True),
    )


def _constraints(real: jax.Array, num_actions: int) -> jax.Array:
    """bool [n, A, m]: the entries of K f that exist."""
    n, m = real.shape
    return jnp.broadcast_to(real[:, None], (n, num_actions, m))


def _step(source, target, real, free, state: InteriorPointState) -> InteriorPointState:
    """One predictor-corrector step of one lane."""
    is_row = _constraints(real, source.shape[1])
    f, e, plus, minus, z = state.f, state.e, state.plus, state.minus, state.z
    product = plain_forward(source, target, f)
    s_plus = jnp.where(is_row, e - product, 1.0)
    s_minus = jnp.where(is_row, e + product, 1.0)
    safe_f = jnp.where(free, f, 1.0)
    mu = ((plus * s_plus + minus * s_minus).sum() + (z * safe_f).sum()) / (2 * is_row.sum() + free.sum())
    direction = _newton(source, target, is_row, free, plus / s_plus, minus / s_minus, z / safe_f)

    def solve(t_plus, t_minus, t_f):
        """Moves towards y s = t, z f = t."""
        df, de, q_plus, q_minus, q_z = direction(t_plus / s_plus, t_minus / s_minus, t_f / safe_f)
        change = plain_forward(source, target, df)
        ds_plus, ds_minus = jnp.where(is_row, de - change, 0.0), jnp.where(is_row, de + change, 0.0)
        return (df, de, ds_plus, ds_minus), (q_plus - plus, q_minus - minus, q_z - z)

    def reach(primal, dual):
        df, _, ds_plus, ds_minus = primal
        primal_step = _longest([(s_plus, ds_plus), (s_minus, ds_minus), (safe_f, df)])
        return primal_step, _longest(list(zip((plus, minus, z), dual, strict=True)))

    zero_y, zero_f = jnp.zeros_like(plus), jnp.zeros_like(f)
    primal, dual = solve(zero_y, zero_y, zero_f)
    step_p, step_d = reach(primal, dual)
    df, _, ds_plus, ds_minus = primal
    left = ((plus + step_d * dual[0]) * (s_plus + step_p * ds_plus)).sum() - (plus * s_plus * ~is_row).sum()
    left += ((minus + step_d * dual[1]) * (s_minus + step_p * ds_minus)).sum()
    left += ((z + step_d * dual[2]) * (safe_f + step_p * df)).sum()
    ahead = left / (2 * is_row.sum() + free.sum())
    target_mu = mu * jnp.clip(ahead / mu, 0.0, 1.0) ** 3
    t_plus = jnp.where(is_row, target_mu - ds_plus * dual[0], 0.0)
    t_minus = jnp.where(is_row, target_mu - ds_minus * dual[1], 0.0)
    t_f = jnp.where(free, target_mu - df * dual[2], 0.0)
    primal, dual = solve(t_plus, t_minus, t_f)
    step_p, step_d = (jnp.minimum(1.0, _TO_BOUNDARY * step) for step in reach(primal, dual))
    moved = state.replace(
        f=f + step_p * primal[0],
        e=e + step_p * primal[1],
        plus=plus + step_d * dual[0],
        minus=minus + step_d * dual[1],
        z=z + step_d * dual[2],
    )
    values = (moved.f, moved.e, moved.plus, moved.minus, moved.z)
    is_finite = jnp.all(jnp.stack([jnp.isfinite(value).all() for value in values]))
    kept = jax.tree.map(lambda new, old: jnp.where(is_finite, new, old), moved, state)
    return kept.replace(alive=state.alive & is_finite)


def _longest(pairs) -> jax.Array:
    """Largest step in [0, 1 / _TO_BOUNDARY] that keeps every value + step * change non-negative."""

    def limit(value, change):
        shrinks = change < 0
        return jnp.where(shrinks, -value / jnp.where(shrinks, change, -1.0), jnp.inf).min()

    limits = [limit(value, change) for value, change in pairs]
    return jnp.minimum(jnp.stack(limits).min(), 1.0 / _TO_BOUNDARY)


def _newton(source, target, is_row, free, d_plus, d_minus, d_f):
    """Factorises the Newton system of one lane; returns the map from y s and z f targets to the directions."""
    n, m = free.shape
    d_plus, d_minus = jnp.where(is_row, d_plus, 0.0), jnp.where(is_row, d_minus, 0.0)
    flat_free = free.ravel()
    normal = _normal_matrix(source, target, d_plus + d_minus) + jnp.diag(jnp.where(free, d_f, 1.0).ravel())
    normal = jnp.where(flat_free[:, None] & flat_free, normal, jnp.eye(n * m, dtype=normal.dtype))
    normal = jnp.where(jnp.eye(n * m, dtype=bool) & ~flat_free, 1.0, normal)
    factor = jnp.linalg.cholesky(normal)
    row_of = jnp.repeat(jnp.eye(n, dtype=normal.dtype), m, axis=0) * flat_free[:, None]  # E^T, [nm, n]
    coupling = jnp.where(flat_free, plain_adjoint(source, target, d_plus - d_minus).ravel(), 0.0)
    has_row = free.any(axis=1)

    def solve_normal(right):
        return jax.scipy.linalg.cho_solve((factor, True), right)

    columns = jnp.concatenate([row_of, coupling[:, None]], axis=1)  # [nm, n + 1]
    inverse = solve_normal(columns)
    border = columns.T @ inverse
    border = border.at[n, n].add(-(d_plus + d_minus).sum())
    keep = jnp.append(has_row, True)
    border = jnp.where(keep[:, None] & keep, border, jnp.eye(n + 1, dtype=border.dtype))

    def direction(r_plus, r_minus, r_f):
        """Targets divided by s+, s- and f; returns df, de and the new y+, y-, z."""
        r_plus, r_minus = jnp.where(is_row, r_plus, 0.0), jnp.where(is_row, r_minus, 0.0)
        pull = jnp.where(free, r_f - plain_adjoint(source, target, r_plus - r_minus), 0.0).ravel()
        base = solve_normal(pull)
        right = -(columns.T @ base)
        right = right.at[n].add(1.0 - (r_plus + r_minus).sum())
        multipliers = jnp.linalg.solve(border, jnp.where(keep, right, 0.0))
        df = (base + inverse @ multipliers).reshape(n, m)
        de = multipliers[n]
        change = plain_forward(source, target, df)
        new_plus = jnp.where(is_row, r_plus - d_plus * (de - change), 0.0)
        new_minus = jnp.where(is_row, r_minus - d_minus * (de + change), 0.0)
        return df, de, new_plus, new_minus, jnp.where(free, r_f - d_f * df, 0.0)

    return direction


def _normal_matrix(source, target, weight) -> jax.Array:
    """K^T diag(weight) K, [nm, nm], from contractions of the two models."""
    n, m = source.shape[0], target.shape[0]
    same_column = jnp.einsum("iak,iaj,iap->kjp", weight, source, source)
    same_row = jnp.einsum("jak,lak,qak->jlq", weight, target, target)
    # Row (i, a, k) meets f(j, k) with T(i,a,j) and f(i, q) with -T'(q,a,k).
    cross = jnp.einsum("iak,iaj,qak->jkiq", weight, source, target)
    matrix = jnp.einsum("kjp,kq->jkpq", same_column, jnp.eye(m, dtype=weight.dtype))
    matrix += jnp.einsum("jlq,jp->jlpq", same_row, jnp.eye(n, dtype=weight.dtype))
    matrix -= cross + jnp.transpose(cross, (2, 3, 0, 1))
    return matrix.reshape(n * m, n * m)
