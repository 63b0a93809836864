"""A primal-dual interior-point method for batches of linear programs over occupancies that differ in the right side.

    max f   subject to   A z + b f = right,   z >= 0,   f free,

one program per lane, A sparse and shared by all of them (`normal_system`). Each step costs one factorisation and some
solves: Mehrotra's predictor and corrector (1992), then correctors after Gondzio (1996), which pull the products z s
together that would otherwise end far apart: programs over occupancies stall without them.

A lane that is done stays as it is while others go on. Certificates are left to the caller, who knows how to make
feasible points of z and of the multipliers.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from jaxhom.solvers import normal_system
from jaxhom.solvers.normal_system import System
from jaxhom.status import Record, Status

if TYPE_CHECKING:
    from jaxtyping import Array, Bool, Float, Int

_TO_BOUNDARY = 0.995  # of the way: points stay positive
_PATIENCE = 30  # steps without a smaller error, after which rounding has won
_CORRECTORS = 3  # after Mehrotra's, at most
_LONGER = 0.3  # what a corrector aims to add to the step
_SOME = 0.03  # what it has to add to be kept
_EVEN = 0.1  # products between this share of the target and its inverse stay as they are
_RUNNING = -1  # a lane's status until it has one


class Problem(Record):
    """What differs from lane to lane.

    Attributes:
      right: [lanes, rows]. tolerance: [lanes], of `Lanes.error`. limit: int32 [lanes], steps at most.
    """

    right: Float[Array, "lanes rows"]
    tolerance: Float[Array, " lanes"]
    limit: Int[Array, " lanes"]


class Point(Record):
    """An iterate of each lane.

    Attributes:
      z: [lanes, m], positive. f: [lanes]. y: [lanes, rows], multipliers of the rows.
      s: [lanes, m], positive, -A^T y up to a residual.
    """

    z: Float[Array, "lanes m"]
    f: Float[Array, " lanes"]
    y: Float[Array, "lanes rows"]
    s: Float[Array, "lanes m"]

    def plus(self, change: Point, along=1.0, across=1.0) -> Point:
        """The point after a step: `along` for z and f, `across` for y and s."""
        return Point(
            z=self.z + _column(along) * change.z,
            f=self.f + along * change.f,
            y=self.y + _column(across) * change.y,
            s=self.s + _column(across) * change.s,
        )


class Lanes(Record):
    """Where the lanes are.

    Attributes:
      point: the newest iterates. best: those with the least error.
      error: [lanes], of the best: the largest of z . s and of what the residuals are worth in the objective.
      found: int32 [lanes], steps taken to the best. steps: int32 [lanes], steps taken.
      status: int32 [lanes], a `Status`, or -1 while the lane is under way.
    """

    point: Point
    best: Point
    error: Float[Array, " lanes"]
    found: Int[Array, " lanes"]
    steps: Int[Array, " lanes"]
    status: Int[Array, " lanes"]

    @property
    def is_done(self) -> Bool[Array, " lanes"]:
        """Which lanes have ended."""
        return self.status != _RUNNING


def init(system: System, problem: Problem, point: Point) -> Lanes:
    """The lanes before their first step, from points with z and s positive."""
    count = jnp.zeros(len(problem.right), jnp.int32)
    lanes = Lanes(
        point=point,
        best=point,
        error=jnp.full(count.shape, jnp.inf, problem.right.dtype),
        found=count,
        steps=count,
        status=count + _RUNNING,
    )
    return _judged(system, problem, lanes)


def step(system: System, problem: Problem, lanes: Lanes) -> Lanes:
    """A step of every lane that is under way."""
    moved = lanes.replace(point=_moved(system, problem, lanes.point), steps=lanes.steps + 1)
    moved = _judged(system, problem, moved)
    return jax.tree.map(lambda old, new: _where(lanes.is_done, old, new), lanes, moved)


def _judged(system: System, problem: Problem, lanes: Lanes) -> Lanes:
    """The lanes with the newest point compared with the best, and the status that follows."""
    error = _error(system, problem, lanes.point)
    better = error < lanes.error
    best = jax.tree.map(lambda old, new: _where(better, new, old), lanes.best, lanes.point)
    found, least = jnp.where(better, lanes.steps, lanes.found), jnp.where(better, error, lanes.error)
    is_stuck = (lanes.steps - found >= _PATIENCE) | ~jnp.isfinite(error)
    ends = [
        (least <= problem.tolerance, Status.SOLVED),
        (is_stuck, Status.STALLED),
        (lanes.steps >= problem.limit, Status.ITERATION_LIMIT),
    ]
    status = jnp.select([where for where, _ in ends], [jnp.int32(status) for _, status in ends], jnp.int32(_RUNNING))
    return lanes.replace(best=best, error=least, found=found, status=status)


def least_norm_start(system: System, problem: Problem) -> Point:
    """Mehrotra's start: the least-norm solutions of both sets of equations, pushed into the interior.

    Then s is raised until the products z s are even and weigh as much as the residuals. Where s = 0 is nearly feasible
    (features that sum to a constant, say), the products would otherwise be nothing long before z is feasible, and the
    steps no longer than the gap between them.
    """
    right = problem.right
    lanes, m = len(right), system.num_columns
    factor = normal_system.factor(system, jnp.ones((1, m), right.dtype))
    factor = jax.tree.map(lambda leaf: leaf, factor)
    factor = normal_system.factor(system, jnp.ones((lanes, m), right.dtype))
    y, f = normal_system.solve(system, factor, right, jnp.zeros(lanes, right.dtype))
    z = system.transpose_times(y)
    y, _ = normal_system.solve(system, factor, jnp.zeros_like(right), -jnp.ones(lanes, right.dtype))
    s = -system.transpose_times(y)
    z, s = (v + jnp.maximum(-1.5 * v.min(axis=1, keepdims=True), 0.0) + 1e-8 for v in (z, s))
    product = 0.5 * _dot(z, s)
    z, s = z + _column(product / s.sum(axis=1)), s + _column(product / z.sum(axis=1))
    point = Point(z=z, f=f, y=y, s=s)
    worth = sum(_effects(_residuals(system, problem, point), point))
    return point.replace(s=jnp.maximum(s, _column(worth / m) / z))


def _residuals(system: System, problem: Problem, point: Point):
    primal = problem.right - system.times(point.z) - _column(point.f) * system.free
    return primal, -system.transpose_times(point.y) - point.s, -1.0 - point.y @ system.free


def _error(system: System, problem: Problem, point: Point):
    effects = _effects(_residuals(system, problem, point), point)
    return jnp.stack([_dot(point.z, point.s), *effects]).max(axis=0)


def _effects(residuals, point: Point):
    """A residual counts with the multiplier, or the variable, that it stands beside: its first-order effect."""
    primal, dual, free = (jnp.abs(residual) for residual in residuals)
    return [_dot(primal, jnp.abs(point.y)), _dot(dual, point.z), free * jnp.abs(point.f)]


def _moved(system: System, problem: Problem, point: Point) -> Point:
    """A predictor, a corrector, and further correctors as long as they lengthen the step."""
    z, s = point.z, point.s
    factor = normal_system.factor(system, z / s)
    residuals = _residuals(system, problem, point)
    mean = _dot(z, s) / z.shape[1]

    def direction(products, share) -> Point:
        """What adds `products` to z s and takes a share of the residuals away, to first order."""
        primal, dual, free = (residual * share for residual in residuals)
        dy, df = normal_system.solve(system, factor, primal - system.times((products - z * dual) / s), free)
        ds = dual - system.transpose_times(dy)
        return Point(z=(products - z * ds) / s, f=df, y=dy, s=ds)

    def corrected(carry):
        """The change with the next corrector, in the lanes where the last one was worth its while."""
        number, goes_on, target, change, along, across = carry
        is_first, is_second = number == 0, number == 1
        far_along, far_across = (jnp.minimum(1.0, length + _LONGER) for length in (along, across))
        products = (z + _column(far_along) * change.z) * (s + _column(far_across) * change.s)
        further = _towards_centre(products, _column(target))
        aim = jnp.where(is_first, -z * s, jnp.where(is_second, _column(target) - z * s - change.z * change.s, further))
        new = direction(aim, jnp.where(number < 2, 1.0, 0.0))
        new = jax.tree.map(lambda old, more: jnp.where(number < 2, more, old + more), change, new)
        new_along, new_across = _longest(z, new.z), _longest(s, new.s)
        left = _dot(z + _column(new_along) * new.z, s + _column(new_across) * new.s) / (mean * z.shape[1])
        target = jnp.where(is_first, mean * jnp.maximum(left, 0.0) ** 3, target)
        take = goes_on & ((number < 2) | (new_along + new_across >= along + across + _SOME))
        change = jax.tree.map(lambda old, new: _where(take, new, old), change, new)
        along, across = jnp.where(take, new_along, along), jnp.where(take, new_across, across)
        return number + 1, take, target, change, along, across

    nothing = jax.tree.map(jnp.zeros_like, point)
    carry = (0, jnp.ones(len(z), bool), mean, nothing, jnp.zeros_like(mean), jnp.zeros_like(mean))
    *_, change, along, across = jax.lax.while_loop(
        lambda carry: carry[1].any() & (carry[0] < 2 + _CORRECTORS), corrected, carry
    )
    along, across = (
        jnp.minimum(_TO_BOUNDARY * _longest(*pair, most=jnp.inf), 1.0) for pair in ((z, change.z), (s, change.s))
    )
    return point.plus(change, along, across)


def _longest(value, change, most=1.0):
    """[lanes], the longest step up to `most` that keeps every value + step * change non-negative."""
    return jnp.minimum(jnp.where(change < 0, -value / jnp.where(change < 0, change, -1.0), jnp.inf).min(axis=1), most)


def _towards_centre(products, target):
    """What products lack to be near the target; large ones are corrected by no more than the largest that is wanted."""
    low, high = _EVEN * target, target / _EVEN
    return jnp.maximum(jnp.clip(products, low, high) - products, -high)


def _dot(one, other):
    return (one * other).sum(axis=1)


def _column(per_lane):
    """[lanes] beside [lanes, n]; numbers stay as they are."""
    return per_lane if jnp.ndim(per_lane) == 0 else per_lane[:, None]


def _where(take, one, other):
    return jnp.where(take.reshape(-1, *(1,) * (one.ndim - 1)), one, other)
