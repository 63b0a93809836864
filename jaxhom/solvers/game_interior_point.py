"""Zero-sum matrix games by a primal-dual interior-point method, made to be stopped early.

    value = min_{w in simplex} max_{q in simplex} <w, M q>,   M [K, m].

As two linear programs that are each other's dual, with slacks s and d that are positive inside:

    max v,  M q - v = s,  sum q = 1,       min t,  t - M^T w = d,  sum w = 1,       w s = q d = mu.

Both sides stay feasible, so any iterate bounds the value on both sides: min_i (M q)_i <= value <= max_j (M^T w)_j. An
iterate that is stopped while these are still apart lies in the middle of the strategies that are about as good, and
not at a vertex. For column generation that is worth far more than the exact solution: the weights no longer jump
(Gondzio, Gonzalez-Brevis and Munari 2013, "New developments in the primal-dual column generation technique").

Each step is Mehrotra's predictor and corrector (1992). Its normal matrix has a row per strategy of one player: of the
one who has fewer.

One text serves both arrays of JAX, in programs, and of NumPy: single games are solved on the host long before a program
is compiled.
"""

from __future__ import annotations

from types import ModuleType
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom.solvers.arrays import fori_loop, module_of, while_loop
from jaxhom.solvers.inverse_factor import inverse_factor
from jaxhom.solvers.predictor_corrector import longest_step, mehrotra_target
from jaxhom.status import Record

if TYPE_CHECKING:
    from jaxtyping import Array, ArrayLike, Bool, Float, Int

_MAX_STEPS = 60  # what is still open then, rounding keeps open; the bounds hold wherever it stops
_TO_BOUNDARY = 0.99  # of the way: points stay positive
_LONGEST = 100.0  # of a predictor that nothing stops: a number, not infinity
_LEAST_CENTRING = 0.02  # of the mean product: a target that all but vanishes leaves the next step no room
_START = 0.1  # slack beyond the worst outcome, as a share of the largest payoff
_WARM_START = 0.1  # ... and of a former solution's gap; the share of uniform strategies mixed into it, too


class GameSolution(Record):
    """Strategies and what they prove.

    Attributes:
      w: [K], probabilities of the minimising player. q: [m], of the maximising one; 0 where no strategy is.
      lower, upper: scalars, min_i (M q)_i and max_j (M^T w)_j: the game's value lies between.
      steps: int32 scalar.
    """

    w: Float[Array, " K"]
    q: Float[Array, " m"]
    lower: Float[Array, ""]
    upper: Float[Array, ""]
    steps: Int[Array, ""]


def solve_game(
    payoff: Float[Array, "K m"],
    is_column: Bool[Array, " m"],
    *,
    tolerance: Float[ArrayLike, ""],
    share: Float[ArrayLike, ""] = 0.0,
    bound: Float[ArrayLike, ""] | None = None,
    start: tuple[Float[ArrayLike, " K"], Float[ArrayLike, " m"]] | None = None,
) -> GameSolution:
    """Solves one game; works under `jit` and, for many games, `vmap`, or in NumPy. No derivatives.

    Args:
      payoff: M [K, m]; where it is NumPy's, everything is, and float64.
      is_column: bool [m], which columns exist; at least one.
      tolerance: scalar, upper - lower that is close enough.
      share, bound: an upper bound on the value of a larger game, of which this one has some of the columns: it is
        also enough when upper - lower <= share * (bound - lower).
      start: w [K] and q [m], strategies of a similar game, to begin near them; zeros to begin in the middle.

    Returns:
      The solution; its bounds hold, and are computed from w and q, whatever made the iteration stop.
    """
    with np.errstate(all="ignore"):  # what rounding makes of a step is looked at when it is done
        return _solve(module_of(payoff), payoff, is_column, tolerance, share, bound, start)


def _solve(numpy: ModuleType, payoff, is_column, tolerance, share, bound, start) -> GameSolution:
    num_rows, num_columns = payoff.shape
    is_row = numpy.ones(num_rows, bool)
    payoff = numpy.where(is_column, payoff, 0.0)
    scale = numpy.maximum(numpy.abs(payoff).max(), numpy.finfo(payoff.dtype).tiny)
    payoff = payoff / scale
    bound = numpy.asarray(numpy.inf if bound is None else bound, payoff.dtype) / scale
    goal = (numpy.asarray(tolerance, payoff.dtype) / scale, numpy.asarray(share, payoff.dtype))

    def is_enough(lower, upper):
        return upper - lower <= numpy.maximum(goal[0], numpy.where(goal[1] > 0, goal[1] * (bound - lower), 0.0))

    start = (0.0, 0.0) if start is None else start
    w, q = (numpy.broadcast_to(numpy.asarray(s, payoff.dtype), n) for s, n in zip(start, payoff.shape, strict=True))
    if num_rows <= num_columns:
        (w, q), (lower, upper), steps = _iterate(payoff, is_row, is_column, (w, q), is_enough)
    else:  # the same game with the players' parts exchanged
        (q, w), (lower, upper), steps = _iterate(
            -payoff.T, is_column, is_row, (q, w), lambda lower, upper: is_enough(-upper, -lower)
        )
        lower, upper = -upper, -lower
    return GameSolution(w=w, q=q, lower=lower * scale, upper=upper * scale, steps=steps)


def _iterate(payoff, is_row, is_column, former, is_enough):
    """Strategies w and q that are good enough, or as good as rounding allows, and their bounds."""
    numpy = module_of(payoff)

    def keep_going(carry):
        _, _, bounds, moves, steps = carry
        return ~is_enough(*bounds) & moves & (steps < _MAX_STEPS)

    def advance(carry):
        point, best, best_bounds, _, steps = carry
        point, is_finite = _step(payoff, is_row, is_column, point)
        strategies = _strategies(point)
        bounds = _bounds(payoff, is_row, is_column, *strategies)
        better = is_finite & (_gap(bounds) < _gap(best_bounds))
        best, new_bounds = jax.tree.map(
            lambda new, old: numpy.where(better, new, old), (strategies, bounds), (best, best_bounds)
        )
        return point, best, new_bounds, is_finite & (_gap(bounds) < 2.0 * _gap(best_bounds)), steps + 1

    point = _start(payoff, is_row, is_column, former)
    best = _strategies(point)
    start = (point, best, _bounds(payoff, is_row, is_column, *best), numpy.array(True), numpy.zeros((), numpy.int32))
    _, best, bounds, _, steps = while_loop(numpy, keep_going, advance, start)
    return best, bounds, steps


def _start(payoff, is_row, is_column, former):
    """The former strategies, or uniform ones, pulled inside; room in both slacks: w, q, v, t."""
    # What a former game had and this one has not would stay in the sums for ever, and spoil the bounds.
    numpy = module_of(payoff)
    former = tuple(numpy.where(mask, old, 0.0) for mask, old in zip((is_row, is_column), former, strict=True))
    is_warm = (former[0].sum() > 0) & (former[1].sum() > 0)
    uniform = tuple(mask / mask.sum().astype(payoff.dtype) for mask in (is_row, is_column))
    warm = numpy.where(is_warm, 1.0 - _WARM_START, 0.0)
    w, q = (
        warm * old / numpy.where(is_warm, old.sum(), 1.0) + (1.0 - warm) * new
        for old, new in zip(former, uniform, strict=True)
    )
    lower, upper = _bounds(payoff, is_row, is_column, w, q)
    room = numpy.where(is_warm, _WARM_START * (upper - lower), _START)
    # Without any room, on a game that is solved already, the first step would divide by zero.
    room = numpy.maximum(room, 64.0 * numpy.finfo(payoff.dtype).eps)
    return w, q, lower - room, upper + room


def _strategies(point):
    w, q, _, _ = point
    return w / w.sum(), q / q.sum()


def _bounds(payoff, is_row, is_column, w, q):
    return _least(payoff @ q, is_row), -_least(-(w @ payoff), is_column)


def _gap(bounds):
    return bounds[1] - bounds[0]


def _least(values, mask):
    numpy = module_of(values)
    return numpy.where(mask, values, numpy.inf).min()


def _step(payoff, is_row, is_column, point):
    """One step; the point as it was, and False, if rounding has made the step useless."""
    numpy = module_of(payoff)
    w, q, v, t = point
    # Entries that do not exist have strategy 0 and slack 1: they enter no sum.
    s, d = numpy.where(is_row, payoff @ q - v, 1.0), numpy.where(is_column, t - w @ payoff, 1.0)
    count = is_row.sum() + is_column.sum()
    ratio = q / d
    total = ratio.sum()
    centred = payoff - ((payoff @ ratio) / total)[:, None]
    normal = (centred * ratio) @ centred.T
    normal = normal + numpy.diag(numpy.where(is_row, s / numpy.where(is_row, w, 1.0), 1.0))
    factor = inverse_factor(normal) if numpy is jnp else _inverse_factor_on_host(normal)
    behind_one = factor.T @ (factor @ is_row.astype(payoff.dtype))

    def direction(goal_rows, goal_columns):
        """The Newton move towards w s = goal_rows, q d = goal_columns."""
        rows = numpy.where(is_row, (goal_rows - w * s) / numpy.where(is_row, w, 1.0), 0.0)
        columns = numpy.where(is_column, (goal_columns - q * d) / d, 0.0)
        behind = factor.T @ (factor @ (rows - centred @ columns))
        dv = -behind.sum() / behind_one.sum()
        dw = numpy.where(is_row, behind + dv * behind_one, 0.0)
        lifted = dw @ payoff
        dt = (ratio @ lifted + columns.sum()) / total
        dd = numpy.where(is_column, dt - lifted, 0.0)
        dq = columns - ratio * dd
        return dw, dq, numpy.where(is_row, payoff @ dq - dv, 0.0), dd, dv, dt

    mu = (w @ s + q @ d) / count

    def predict_and_correct(number, move):
        """First the predictor, from no move at all; then the corrector, from what the predictor would do."""
        dw, dq, ds, dd, _, _ = move
        length = longest_step((w, dw), (q, dq), (s, ds), (d, dd), most=_LONGEST)
        ahead = ((w + length * dw) @ (s + length * ds) + (q + length * dq) @ (d + length * dd)) / count
        goal = numpy.where(number == 0, 0.0, mehrotra_target(mu, ahead / mu, _LEAST_CENTRING))
        return direction(goal - dw * ds, goal - dq * dd)

    move = (0.0 * w, 0.0 * q, 0.0 * s, 0.0 * d, 0.0 * v, 0.0 * v)
    dw, dq, ds, dd, dv, dt = fori_loop(numpy, 2, predict_and_correct, move)
    length = longest_step((w, dw), (q, dq), (s, ds), (d, dd), to_boundary=_TO_BOUNDARY)
    moved = (w + length * dw, q + length * dq, v + length * dv, t + length * dt)
    is_finite = numpy.isfinite(length) & numpy.isfinite(moved[0].sum() + moved[1].sum() + moved[2] + moved[3])
    return jax.tree.map(lambda new, old: numpy.where(is_finite, new, old), moved, point), is_finite


def _inverse_factor_on_host(normal: np.ndarray) -> np.ndarray:
    """The inverse of the Cholesky factor; NaN where rounding leaves the matrix indefinite, as LAPACK does in JAX."""
    try:
        return np.linalg.inv(np.linalg.cholesky(normal))
    except np.linalg.LinAlgError:
        return np.full_like(normal, np.nan)
