"""A feasible primal-dual interior-point method for batches of the small LPs (9), for tight brackets on a CPU.

`homomorphism_lp` states the program, min e subject to |K f| <= e over row-stochastic maps f. With slacks
s+ = e - K f and s- = e + K f, multipliers y+, y-, z and lambda, the central path is

    K^T (y+ - y-) - z - E^T lambda = 0,   sum(y+ + y-) = 1,   E f = 1,   y s = mu,   z f = mu,

E summing the rows of f. A strictly feasible start always exists (uniform rows, e above |K f|, uniform y), so every
iterate is feasible and certifies its own bracket. Each step is Mehrotra's predictor and corrector (1992), followed by
centrality correctors after Gondzio (1996), which cost a solve each where the factorisation costs twenty and save every
fifth step. A step that is not finite is refused, and the lane stops where it is.
"""

import chex
import jax
import jax.numpy as jnp

from jaxhom.programs import host_jit
from jaxhom.similarity.homomorphism_lp import HomomorphismProblem
from jaxhom.similarity.newton import factorise
from jaxhom.solvers.lane_queue import Solver, is_settled, run_lanes
from jaxhom.solvers.predictor_corrector import EVEN, towards_centre

MAX_ITERATIONS = 60  # ten are usual
_TO_BOUNDARY = 0.99  # of the way: points stay positive
_CORRECTORS = 2  # after Mehrotra's, at most


@chex.dataclass(frozen=True)
class InteriorPointState:
    """Iterates and best bounds, lanes last.

    Attributes:
      f: [n, m, lanes]. e: [lanes]. plus, minus: y+ and y-, [n, A, m + L, lanes]. z: [n, m, lanes].
      lower, upper: [lanes], best bounds. steps: int32 [lanes]. alive: bool [lanes], False once a step was refused.
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


def init(problem: HomomorphismProblem) -> InteriorPointState:
    """Uniform f and y, e well above |K f|, and z constant on the free entries: strictly feasible."""
    real, free = _masks(problem)
    f = problem.start()[0]
    is_row = _constraints(problem, real)
    weight = 1.0 / is_row.sum(axis=(0, 1, 2))
    lanes = f.shape[-1]
    start = InteriorPointState(
        f=f,
        e=1.5 * jnp.abs(problem.forward(f)).max(axis=(0, 1, 2)) + 0.1,
        plus=jnp.where(is_row, 0.5 * weight, 0.0),
        minus=jnp.where(is_row, 0.5 * weight, 0.0),
        z=jnp.where(free, weight, 0.0),
        lower=jnp.zeros(lanes, f.dtype),
        upper=jnp.full(lanes, jnp.inf, f.dtype),
        steps=jnp.zeros(lanes, jnp.int32),
        alive=jnp.ones(lanes, bool),
    )
    return _update_bounds(problem, start)


def step(problem: HomomorphismProblem, state: InteriorPointState) -> InteriorPointState:
    """One step of every lane."""
    real, free = _masks(problem)
    is_row = _constraints(problem, real)
    masks = (is_row, is_row, free)
    product = problem.forward(state.f)
    # The three products y s. Where an entry does not exist, 1 stands in for its s and 0 for its y.
    slacks = (state.e - product, state.e + product, state.f)
    primal = tuple(jnp.where(mask, s, 1.0) for mask, s in zip(masks, slacks, strict=True))
    dual = (state.plus, state.minus, state.z)
    count = _total(mask.astype(state.e.dtype) for mask in masks)
    direction = factorise(problem, is_row, free, *(y / s for y, s in zip(dual, primal, strict=True)))

    def aim(goals):
        """The Newton move towards y s = goal for the three products, and how far it can be followed."""
        df, change, de, *new_dual = direction(*(goal / s for goal, s in zip(goals, primal, strict=True)))
        d_primal = (jnp.where(is_row, de - change, 0.0), jnp.where(is_row, de + change, 0.0), df)
        d_dual = tuple(new - old for new, old in zip(new_dual, dual, strict=True))
        return (d_primal, d_dual, de), (_longest(primal, d_primal), _longest(dual, d_dual))

    def products(move, steps):
        moved = zip(primal, dual, *move[:2], strict=True)
        return tuple((s + steps[0] * ds) * (y + steps[1] * dy) for s, y, ds, dy in moved)

    def pursue(k, best):
        """The k-th move: predictor, corrector, or a corrector that is kept if it is the longer step."""
        goals, move, steps, mu = best
        ahead = _total(products(move, steps)) / count
        mu = jnp.where(k == 1, mu * jnp.clip(ahead / mu, 0.0, 1.0) ** 3, mu)
        second_order = (ds * dy for ds, dy in zip(*move[:2], strict=True))
        corrected = (mu - term for term in second_order)
        trial = products(move, tuple(jnp.minimum(1.0, 1.5 * length + 0.1) for length in steps))
        centred = (goal + towards_centre(value, mu, EVEN) for goal, value in zip(goals, trial, strict=True))
        goals = tuple(
            jnp.where(mask & (k > 0), jnp.where(k == 1, one, other), 0.0)
            for mask, one, other in zip(masks, corrected, centred, strict=True)
        )
        other = (goals, *aim(goals), mu)
        is_kept = (k <= 1) | (sum(other[2]) > sum(steps))
        return jax.tree.map(lambda new, old: jnp.where(is_kept, new, old), other, best)

    mu = _total(y * s for y, s in zip(dual, primal, strict=True)) / count
    nothing = tuple(jnp.zeros_like(y) for y in dual)
    start = (nothing, (nothing, nothing, jnp.zeros_like(mu)), (jnp.zeros_like(mu),) * 2, mu)
    # In one loop, so that the solve is compiled once.
    _, move, steps, _ = jax.lax.fori_loop(0, 2 + _CORRECTORS, pursue, start)
    moved = _follow(state, move, tuple(jnp.minimum(1.0, _TO_BOUNDARY * length) for length in steps))
    return _update_bounds(problem, moved).replace(steps=state.steps + 1)


def is_finished(state: InteriorPointState, tolerance, threshold, max_iterations) -> jax.Array:
    """bool [lanes]: settled, or the lane cannot go on."""
    is_lost = ~state.alive | (state.steps >= max_iterations)
    return is_settled(state.lower, state.upper, tolerance, threshold) | is_lost


SOLVER = Solver(init, step, is_finished, host_jit)


def solve(problem: HomomorphismProblem, *, tolerance, max_iterations: int = MAX_ITERATIONS) -> InteriorPointState:
    """Steps until every lane has a bracket of the tolerance or cannot go on."""
    return run_lanes(SOLVER, problem, init(problem), tolerance=tolerance, max_iterations=max_iterations)[0]


def _masks(problem: HomomorphismProblem) -> tuple[jax.Array, jax.Array]:
    """bool [n, m, lanes]: which entries of f are real, and which of them are free."""
    rows, columns = problem.masks((len(problem.source), len(problem.target)))
    real = rows & columns
    return real, real.at[0].set(False) if problem.anchored else real


def _constraints(problem: HomomorphismProblem, real: jax.Array) -> jax.Array:
    """bool [n, A, m + L, lanes]: the entries of K f that exist."""
    n, m, lanes = real.shape
    is_row = jnp.broadcast_to(real[:, None], (n, problem.source.shape[1], m, lanes))
    labels = jnp.broadcast_to(real[:, None, :1], (*is_row.shape[:2], problem.num_labels, lanes))  # column 0 is real
    return jnp.concatenate([is_row, labels], axis=2)


def _update_bounds(problem: HomomorphismProblem, state: InteriorPointState) -> InteriorPointState:
    """Keeps the better of the bounds so far and those of the present f and y."""
    y = state.plus - state.minus
    lower, upper = problem.bounds(state.f, y, problem.forward(state.f), problem.adjoint(y))
    return state.replace(lower=jnp.maximum(state.lower, lower), upper=jnp.minimum(state.upper, upper))


def _follow(state: InteriorPointState, move, steps) -> InteriorPointState:
    """The state after a step, or the old one, no longer alive, if that is not finite."""
    (_, _, df), (d_plus, d_minus, dz), de = move
    moved = state.replace(
        f=state.f + steps[0] * df,
        e=state.e + steps[0] * de,
        plus=state.plus + steps[1] * d_plus,
        minus=state.minus + steps[1] * d_minus,
        z=state.z + steps[1] * dz,
    )
    values = (moved.f, moved.e, moved.plus, moved.minus, moved.z)
    is_finite = jnp.stack([jnp.isfinite(value).all(axis=tuple(range(value.ndim - 1))) for value in values]).all(axis=0)
    kept = jax.tree.map(lambda new, old: jnp.where(is_finite, new, old), moved, state)
    return kept.replace(alive=state.alive & is_finite)


def _total(arrays) -> jax.Array:
    """Sums of all entries, per lane."""
    return sum(array.sum(axis=tuple(range(array.ndim - 1))) for array in arrays)


def _longest(values, changes) -> jax.Array:
    """Largest steps [lanes] in [0, 1 / _TO_BOUNDARY] that keep every value + step * change non-negative."""
    shrinking = [
        jnp.where(change < 0, -change / value, 0.0).max(axis=tuple(range(value.ndim - 1)))
        for value, change in zip(values, changes, strict=True)
    ]
    return 1.0 / jnp.maximum(jnp.stack(shrinking).max(axis=0), _TO_BOUNDARY)
