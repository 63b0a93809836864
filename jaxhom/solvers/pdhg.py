"""Reflected restarted Halpern PDHG for batches of saddle-point problems

    min_{x in X} max_{y in Y}  <y, K x> + <c, x> - <b, y>

(Lu and Yang 2024, "Restarted Halpern PDHG for linear programming"; the method of the solver cuPDLPx.) One step of
plain PDHG is the operator T,

    x' = proj_X(x - tau K^T y),   y' = proj_Y(y + sigma K (2 x' - x)),   tau = eta / omega,   sigma = eta omega,

with eta below 1 / |K|. The iteration reflects and pulls back to an anchor z0,

    z_{k+1} = (k + 1) / (k + 2) (2 T(z_k) - z_k) + 1 / (k + 2) z0,

and starts again from where it is when the fixed-point residual |z - T(z)| has fallen enough since the anchor was
set. The primal weight omega is then moved towards the ratio of the distances travelled.

A problem is a pytree with the methods of `Problem`. Every array has the lanes of the batch on its last axis, and
every lane has its own anchor, weight, restarts and bounds. Answers are certificates: any feasible x gives an upper
bound, any feasible y a lower one, and the best of each are kept with the points that prove them.

A problem in arrays of NumPy is solved on the host, one lane at a time.
"""

from typing import Protocol

import chex
import jax
import numpy as np

from jaxhom.solvers.arrays import fori_loop, module_of
from jaxhom.solvers.lane_queue import Solver, is_settled, run_lanes
from jaxhom.solvers.projections import reduce_leading

_SUFFICIENT_DECAY = 0.2  # restart at once
_NECESSARY_DECAY = 0.8  # restart when the residual has begun to rise
_ARTIFICIAL_FRACTION = 0.36  # restart when the round is this fraction of all steps
_MAX_WEIGHT_CHANGE = 8.0  # per restart
_MAX_WEIGHT = 1e4  # beyond, rounding decides the smaller of the two steps
STEPS_PER_CHECK = 16  # a look at the bounds costs about one iteration


class Problem(Protocol):
    """What the engine needs to know. Arrays carry the lanes last."""

    def start(self) -> tuple[jax.Array, jax.Array]:
        """A primal and a dual point."""

    def forward(self, primal: jax.Array) -> jax.Array:
        """K x."""

    def adjoint(self, dual: jax.Array) -> jax.Array:
        """K^T y."""

    def project_primal(self, point: jax.Array, step: jax.Array) -> jax.Array:
        """argmin over X of |x - point|^2 / (2 step) + <c, x>; `step` is [lanes]."""

    def project_dual(self, point: jax.Array, step: jax.Array) -> jax.Array:
        """argmin over Y of |y - point|^2 / (2 step) + <b, y>; `step` is [lanes]."""

    def bounds(self, primal, dual, forward, adjoint) -> tuple[jax.Array, jax.Array]:
        """Lower and upper bounds [lanes] on the value, from feasible points and their products."""

    def norm_bound(self) -> jax.Array:
        """An upper bound [lanes] on |K|_2."""


@chex.dataclass(frozen=True)
class PDHGState:
    """State of a batch of lanes; every leaf has the lanes last.

    Attributes:
      primal, dual: the iterate z.
      anchor_primal, anchor_dual: z0.
      weight: omega. eta: tau omega = sigma / omega.
      round_steps: steps since the anchor was set. steps: all steps.
      first_residual, last_residual: |z - T(z)| after the anchor was set, and at the last check.
      lower, upper: best bounds so far. best_primal, best_dual: the points that prove them.
    """

    primal: jax.Array
    dual: jax.Array
    anchor_primal: jax.Array
    anchor_dual: jax.Array
    weight: jax.Array
    eta: jax.Array
    round_steps: jax.Array
    steps: jax.Array
    first_residual: jax.Array
    last_residual: jax.Array
    lower: jax.Array
    upper: jax.Array
    best_primal: jax.Array
    best_dual: jax.Array


def init(problem: Problem, start: tuple[jax.Array, jax.Array] | None = None) -> PDHGState:
    """State at the problem's start, or at the given primal and dual points (a warm start)."""
    primal, dual = problem.start() if start is None else start
    numpy = module_of(primal)
    eta = 0.99 / numpy.maximum(_operator_norm(problem, primal), numpy.finfo(primal.dtype).tiny)
    lanes, dtype = primal.shape[-1], primal.dtype
    zeros, count = numpy.zeros(lanes, dtype), numpy.zeros(lanes, numpy.int32)
    infinity = numpy.full(lanes, numpy.inf, dtype)
    return PDHGState(
        primal=primal,
        dual=dual,
        anchor_primal=primal,
        anchor_dual=dual,
        weight=zeros + 1.0,
        eta=eta,
        round_steps=count,
        steps=count,
        first_residual=infinity,
        last_residual=infinity,
        lower=-infinity,
        upper=infinity,
        best_primal=primal,
        best_dual=dual,
    )


def step(problem: Problem, state: PDHGState) -> PDHGState:
    """Sixteen iterations, one look at the bounds, and a restart of the lanes that earned one."""
    numpy = module_of(state.primal)

    def advance(k, carry):
        primal, dual, first_residual, _, _, _ = carry
        moved = state.replace(primal=primal, dual=dual)
        primal, dual, residual, mapped_primal, mapped_dual = _iterate(problem, moved, k)
        starts_round = (state.round_steps == 0) & (k == 0)
        first_residual = numpy.where(starts_round, residual, first_residual)
        return primal, dual, first_residual, residual, mapped_primal, mapped_dual

    start = (state.primal, state.dual, state.first_residual, state.last_residual)
    primal, dual, first_residual, residual, mapped_primal, mapped_dual = fori_loop(
        numpy, STEPS_PER_CHECK, advance, (*start, state.primal, state.dual)
    )
    state = state.replace(
        primal=primal,
        dual=dual,
        round_steps=state.round_steps + STEPS_PER_CHECK,
        steps=state.steps + STEPS_PER_CHECK,
        first_residual=first_residual,
    )
    state = _update_bounds(problem, state, mapped_primal, mapped_dual)
    return _restart(state, residual, mapped_primal, mapped_dual)


def is_finished(state: PDHGState, tolerance, threshold, max_iterations) -> jax.Array:
    """[lanes]: settled, or out of iterations, or without a step length because the problem is not finite."""
    is_lost = (state.steps >= max_iterations) | module_of(state.eta).isnan(state.eta)
    return is_settled(state.lower, state.upper, tolerance, threshold) | is_lost


SOLVER = Solver(init, step, is_finished)


def solve(problem: Problem, state: PDHGState, *, tolerance, max_iterations: int = 100_000) -> PDHGState:
    """Steps from a state until every lane's gap is within the tolerance or it is out of iterations.

    Args:
      problem: the problem; in arrays of NumPy of one lane.
      state: from `init` or a former call.
      tolerance: scalar or [lanes], the gap to reach.
      max_iterations: per lane.

    Returns:
      The state where every lane ended, from which a further call goes on.
    """
    if module_of(state.primal) is np:
        while not is_finished(state, tolerance, np.nan, max_iterations).all():
            state = step(problem, state)
        return state
    return run_lanes(SOLVER, problem, state, tolerance=tolerance, max_iterations=max_iterations)[0]


def _iterate(problem: Problem, state: PDHGState, k):
    """One reflected Halpern step, the k-th since the state was stored; returns z_{k+1}, |z - T(z)|, T(z)."""
    tau, sigma = state.eta / state.weight, state.eta * state.weight
    adjoint = problem.adjoint(state.dual)
    mapped_primal = problem.project_primal(state.primal - tau * adjoint, tau)
    forward = problem.forward(2.0 * mapped_primal - state.primal)
    mapped_dual = problem.project_dual(state.dual + sigma * forward, sigma)
    moved_primal, moved_dual = mapped_primal - state.primal, mapped_dual - state.dual
    # |dz|^2 in the norm in which T is firmly non-expansive, without its cross term: an upper estimate up to 2.
    residual = _square_norm(moved_primal) / tau + _square_norm(moved_dual) / sigma
    pull = 1.0 / (state.round_steps + k + 2.0)
    pull = pull.astype(state.eta.dtype)
    primal = (1.0 - pull) * (mapped_primal + moved_primal) + pull * state.anchor_primal
    dual = (1.0 - pull) * (mapped_dual + moved_dual) + pull * state.anchor_dual
    return primal, dual, module_of(residual).sqrt(residual), mapped_primal, mapped_dual


def _update_bounds(problem: Problem, state: PDHGState, primal, dual) -> PDHGState:
    lower, upper = problem.bounds(primal, dual, problem.forward(primal), problem.adjoint(dual))
    better_lower, better_upper = lower > state.lower, upper < state.upper
    numpy = module_of(primal)
    return state.replace(
        lower=numpy.where(better_lower, lower, state.lower),
        upper=numpy.where(better_upper, upper, state.upper),
        best_primal=numpy.where(better_upper, primal, state.best_primal),
        best_dual=numpy.where(better_lower, dual, state.best_dual),
    )


def _restart(state: PDHGState, residual, primal, dual) -> PDHGState:
    """Moves the anchor of the lanes whose residual has fallen enough, or whose round has become long."""
    numpy, first = module_of(primal), state.first_residual
    is_due = (
        (residual <= _SUFFICIENT_DECAY * first)
        | ((residual <= _NECESSARY_DECAY * first) & (residual > state.last_residual))
        | (state.round_steps >= _ARTIFICIAL_FRACTION * state.steps)
    )
    moved_primal = numpy.sqrt(_square_norm(primal - state.anchor_primal))
    moved_dual = numpy.sqrt(_square_norm(dual - state.anchor_dual))
    tiny = numpy.finfo(moved_primal.dtype).tiny
    change = numpy.sqrt(numpy.maximum(moved_dual, tiny) / numpy.maximum(moved_primal, tiny) / state.weight)
    # Bounded: where one side has arrived and no longer moves, the weight still turns to the other.
    change = numpy.clip(change, 1.0 / _MAX_WEIGHT_CHANGE, _MAX_WEIGHT_CHANGE)
    weight = numpy.clip(state.weight * change, 1.0 / _MAX_WEIGHT, _MAX_WEIGHT)

    def choose(new, old):
        return numpy.where(is_due, new, old)

    return state.replace(
        primal=choose(primal, state.primal),
        dual=choose(dual, state.dual),
        anchor_primal=choose(primal, state.anchor_primal),
        anchor_dual=choose(dual, state.anchor_dual),
        weight=choose(weight, state.weight),
        round_steps=choose(0, state.round_steps),
        last_residual=choose(numpy.inf, residual),
    )


def _square_norm(array: jax.Array) -> jax.Array:
    """Sum of squares per lane."""
    return reduce_leading(array * array, tuple(range(array.ndim - 1)))


def _operator_norm(problem: Problem, like: jax.Array) -> jax.Array:
    """|K|_2 per lane: a power iteration with a margin, where that is below the problem's own bound."""
    numpy, entries = module_of(like), like.size // like.shape[-1]
    # A fixed vector with no symmetry to be orthogonal to anything by accident.
    start = 1.0 + 0.5 * numpy.sin(numpy.arange(entries, dtype=like.dtype) ** 2)
    start = numpy.broadcast_to(start.reshape((*like.shape[:-1], 1)), like.shape)

    def power(_, carry):
        vector, _ = carry
        product = problem.adjoint(problem.forward(vector))
        square = numpy.sqrt(_square_norm(product))
        return product / numpy.maximum(square, numpy.finfo(like.dtype).tiny), square

    start = start / numpy.sqrt(_square_norm(start))
    _, square = fori_loop(numpy, 20, power, (start, numpy.zeros(like.shape[-1], like.dtype)))
    return numpy.minimum(1.1 * numpy.sqrt(square), problem.norm_bound())
