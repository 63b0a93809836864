"""A primal-dual interior-point method for a batch of linear programs over the occupancies of one model, in one program.

    max f   subject to   F x = initial,   Phi^T x - slack + b f = right,   x, slack >= 0,   f free,

with F and Phi as `band_system` has them; z = (x, slack). The rules are those of `sparse_interior_point`, which does the
same on the host for one program at a time: Mehrotra's predictor and corrector, then Gondzio's correctors as long as
they lengthen the step, lane by lane. Lanes come first. A lane that is done stays as it is while others go on; the best
iterate of each is kept.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from jaxhom.solvers.band_system import BandSystem, Factor
from jaxhom.solvers.normal_equations import ACCURATE, REFINEMENTS
from jaxhom.solvers.predictor_corrector import (
    EVEN,
    LONGER,
    MOST_CORRECTORS,
    PATIENCE,
    TO_BOUNDARY,
    WORTH_IT,
    longest_step,
    mehrotra_target,
    towards_centre,
)
from jaxhom.status import Record

if TYPE_CHECKING:
    from jaxtyping import Array, Bool, Float, Int


class Lanes(Record):
    """What is asked.

    Attributes:
      right: [L, K]. tolerance: [L], of `Iterate.error`. limit: int [L], steps at most.
    """

    right: Float[Array, "L K"]
    tolerance: Float[Array, " L"]
    limit: Int[Array, " L"]


class Point(Record):
    """Variables and multipliers, or changes of them.

    Attributes:
      z, s: [L, P + K]. y: [L, n], of the flow. w: [L, K], of the other rows. f: [L].
    """

    z: Float[Array, "L P+K"]
    s: Float[Array, "L P+K"]
    y: Float[Array, "L n"]
    w: Float[Array, "L K"]
    f: Float[Array, " L"]


class Residuals(Record):
    """What the equations lack: those of the flow [L, n], of the features [L, K], of s [L, P + K] and of f [L]."""

    flow: Float[Array, "L n"]
    features: Float[Array, "L K"]
    dual: Float[Array, "L P+K"]
    free: Float[Array, " L"]


class Iterate(Record):
    """Where the lanes are.

    Attributes:
      point, residuals: now. best: the point with the least error so far, at step `best_at` [L].
      error: [L], of the best one, in units of the objective. steps: int [L], taken.
      is_lost: [L], whether rounding has made a matrix indefinite.
    """

    point: Point
    residuals: Residuals
    best: Point
    error: Float[Array, " L"]
    best_at: Int[Array, " L"]
    steps: Int[Array, " L"]
    is_lost: Bool[Array, " L"]


def begin(system: BandSystem, initial: Float[Array, " n"], lanes: Lanes, point: Point) -> Iterate:
    """The lanes at a point with z, s > 0."""
    none = jnp.zeros(len(point.f), jnp.int32)
    residuals = _residuals(system, initial, lanes, point)
    error = _error(residuals, point)
    lost = ~jnp.isfinite(error)
    return Iterate(point=point, residuals=residuals, best=point, error=error, best_at=none, steps=none, is_lost=lost)


def is_finished(lanes: Lanes, state: Iterate) -> Bool[Array, " L"]:
    """Solved, or at an end."""
    stuck = state.is_lost | (state.steps - state.best_at >= PATIENCE)
    return (state.error <= lanes.tolerance) | stuck | (state.steps >= lanes.limit)


def run(
    system: BandSystem,
    initial: Float[Array, " n"],
    lanes: Lanes,
    state: Iterate,
    used: Int[Array, ""],
    share: float,
) -> tuple[Iterate, Bool[Array, " L"]]:
    """Steps until `share` of the first `used` lanes are finished; and which are."""

    def keep_going(state):
        done = is_finished(lanes, state) & (jnp.arange(len(state.steps)) < used)
        return done.sum() < share * used

    def advance(state):
        done = is_finished(lanes, state)
        new = _advance(system, initial, lanes, state, ~done)
        return _selected(done, state, new)

    state = jax.lax.while_loop(keep_going, advance, state)
    return state, is_finished(lanes, state)


def _selected(chosen: Bool[Array, " L"], one, other):
    """Lane by lane one or the other."""

    def select(one, other):
        return jnp.where(chosen.reshape(-1, *(1,) * (one.ndim - 1)), one, other)

    return jax.tree.map(select, one, other)


def _advance(system: BandSystem, initial, lanes: Lanes, state: Iterate, is_open) -> Iterate:
    """One step, and what it is worth."""
    point = _step(system, state, is_open)
    residuals = _residuals(system, initial, lanes, point)
    error, steps = _error(residuals, point), state.steps + 1
    better = error < state.error
    best = _selected(better, (point, error, steps), (state.best, state.error, state.best_at))
    return Iterate(
        point=point,
        residuals=residuals,
        best=best[0],
        error=best[1],
        best_at=best[2],
        steps=steps,
        is_lost=~jnp.isfinite(error),
    )


def _residuals(system: BandSystem, initial, lanes: Lanes, point: Point) -> Residuals:
    flow, features = system.products(point.z)
    return Residuals(
        flow=initial - flow,
        features=lanes.right - features - point.f[:, None] * system.free_column,
        dual=-system.transposed(point.y, point.w) - point.s,
        free=-1.0 - point.w @ system.free_column,
    )


def _error(residuals: Residuals, point: Point) -> Float[Array, " L"]:
    """The largest of z . s and of the residuals with what stands beside them: their first-order effects."""
    primal = _dot(abs(residuals.flow), abs(point.y)) + _dot(abs(residuals.features), abs(point.w))
    dual, free = _dot(abs(residuals.dual), abs(point.z)), abs(residuals.free * point.f)
    return jnp.stack([_dot(point.z, point.s), primal, dual, free]).max(axis=0)


def _dot(one, other):
    return (one * other).sum(axis=1)


def _step(system: BandSystem, state: Iterate, is_open: Bool[Array, " L"]) -> Point:
    """A predictor, a corrector, and further correctors as long as they lengthen the step; all by one loop."""
    point, residuals = state.point, state.residuals
    z, s = point.z, point.s
    factor = system.factor(z / s)
    product = _dot(z, s)
    mean = product / z.shape[1]

    def keep_going(carry):
        turn, active = carry[0], carry[-1]
        return (turn < 2) | ((turn < 2 + MOST_CORRECTORS) & active.any())

    def correct(carry):
        turn, change, along, across, target, active = carry
        is_predictor, is_further = turn == 0, turn >= 2
        aimed = _aimed(point, change, along, across, target[:, None])
        mehrotra = jnp.where(is_predictor, 0.0, target[:, None] - change.z * change.s) - z * s
        share = jnp.where(is_further, 0.0, 1.0)
        wanted = jax.tree.map(lambda residual: share * residual, residuals)
        new = _direction(system, factor, point, wanted, jnp.where(is_further, aimed, mehrotra), active)
        new = jax.tree.map(lambda old, new: jnp.where(is_further, old, 0.0) + new, change, new)
        new_along, new_across = _length(z, new.z), _length(s, new.s)
        is_longer = active & (new_along + new_across >= along + across + WORTH_IT)
        taken = jnp.where(is_further, is_longer, True)
        change, along, across = _selected(taken, (new, new_along, new_across), (change, along, across))
        left = _dot(z + along[:, None] * change.z, s + across[:, None] * change.s) / product
        target = jnp.where(is_predictor, mehrotra_target(mean, left, most=jnp.inf), target)
        return turn + 1, change, along, across, target, active & (taken | ~is_further)

    none = jnp.zeros_like(mean)
    start = (0, jax.tree.map(jnp.zeros_like, point), none, none, none, is_open)
    _, change, along, across, _, _ = jax.lax.while_loop(keep_going, correct, start)
    along, across = (_length(*pair, TO_BOUNDARY)[:, None] for pair in ((z, change.z), (s, change.s)))
    return Point(
        z=z + along * change.z,
        s=s + across * change.s,
        y=point.y + across * change.y,
        w=point.w + across * change.w,
        f=point.f + along[:, 0] * change.f,
    )


def _aimed(point: Point, change: Point, along, across, target):
    """Gondzio: what products lack, after a longer step, to be near the target."""
    along, across = (jnp.minimum(1.0, length + LONGER)[:, None] for length in (along, across))
    return towards_centre((point.z + along * change.z) * (point.s + across * change.s), target, EVEN)


def _length(value, change, to_boundary: float = 1.0):
    """`longest_step` of each lane."""
    return jax.vmap(lambda value, change: longest_step((value, change), to_boundary=to_boundary))(value, change)


def _direction(system: BandSystem, factor: Factor, point: Point, residuals: Residuals, products, is_open) -> Point:
    """What adds `products` to z s and takes the residuals away, to first order."""
    z, s = point.z, point.s
    flow, features = system.products((products - z * residuals.dual) / s)
    right = (residuals.flow - flow, residuals.features - features, residuals.free)
    y, w, f = _refined(system, factor, z / s, right, is_open)
    ds = residuals.dual - system.transposed(y, w)
    return Point(z=(products - z * ds) / s, s=ds, y=y, w=w, f=f)


def _refined(system: BandSystem, factor: Factor, d, right, is_open):
    """The solution with iterative refinement: as d spreads, the factorisation alone loses digits."""
    accurate = ACCURATE * _largest(right)

    def keep_going(carry):
        turn, _, missing = carry
        return (turn == 0) | ((turn <= REFINEMENTS) & (is_open & (_largest(missing) > accurate)).any())

    def refine(carry):
        turn, found, missing = carry
        more = system.solve(factor, *missing)
        needed = (turn == 0) | (_largest(missing) > accurate)
        y, w, f = _selected(needed, jax.tree.map(jnp.add, found, more), found)
        flow, features = system.products(d * system.transposed(y, w))
        left = right[0] - flow, right[1] - features - f[:, None] * system.free_column
        return turn + 1, (y, w, f), (*left, right[2] - w @ system.free_column)

    return jax.lax.while_loop(keep_going, refine, (0, jax.tree.map(jnp.zeros_like, right), right))[1]


def _largest(right):
    flow, features, free = right
    return jnp.maximum(jnp.maximum(abs(flow).max(axis=1), abs(features).max(axis=1)), abs(free))
