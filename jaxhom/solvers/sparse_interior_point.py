"""A primal-dual interior-point method for sparse linear programs over occupancies, one at a time, on the host.

    min c . z + g . f   subject to   A z + B f = b,   z >= 0,   f free,

with A sparse and B a few dense columns. Each step costs one factorisation (`normal_equations`) and some solves:
Mehrotra's predictor and corrector (1992), then correctors after Gondzio (1996), which pull the products z s together
that would otherwise end far apart: programs over occupancies stall without them.

Certificates are left to the caller, who knows how to make feasible points of z and of the multipliers.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jaxhom.solvers.normal_equations import Rows
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
from jaxhom.status import Record, Status

if TYPE_CHECKING:
    from jaxtyping import Float


class InteriorPoint(Record):
    """An iterate.

    Attributes:
      z: [m], positive. f: [q]. y: [n], multipliers of the rows. s: [m], positive, c - A^T y up to a residual.
      error: the largest of z . s and of what the residuals are worth in the objective, see `_error`.
      iterations: steps taken to it.
      steps: steps taken in all. status: SOLVED, or why the steps ended.
    """

    z: Float[np.ndarray, " m"]
    f: Float[np.ndarray, " q"]
    y: Float[np.ndarray, " n"]
    s: Float[np.ndarray, " m"]
    error: float = np.inf
    iterations: int = 0
    steps: int = 0
    status: Status = Status.STALLED


def solve(
    rows: Rows,
    cost: Float[np.ndarray, " m"],
    free_cost: Float[np.ndarray, " q"],
    right: Float[np.ndarray, " n"],
    *,
    tolerance: float = 1e-9,
    max_iterations: int = 100,
) -> InteriorPoint:
    """Solves one program, or comes as near as rounding allows.

    Args:
      rows: A [n, m] and B [n, q].
      cost: c [m]. free_cost: g [q]. right: b [n].
      tolerance: stop where `InteriorPoint.error` is below it, in units of the objective.
      max_iterations: steps at most.

    Returns:
      The iterate with the least `error`; with a factorisation that fails from the beginning, one of ones and zeros.

    Source: Mehrotra 1992; Gondzio 1996; Wright 1997, chapter 10.
    """
    program = (cost, free_cost, right)
    best, status = _nowhere(rows, cost, right), Status.STALLED
    taken = 0
    try:
        rows.factor(np.ones(len(cost)))
        point = start(rows, *program)
        for taken in range(max_iterations + 1):
            residuals = _residuals(rows, *program, point)
            point = point.replace(error=_error(residuals, point), iterations=taken)
            if point.error < best.error:
                best = point
            if best.error <= tolerance:
                status = Status.SOLVED
                break
            if taken - best.iterations >= PATIENCE or not np.isfinite(point.error):
                break
            if taken == max_iterations:
                status = Status.ITERATION_LIMIT
                break
            point = _step(rows, residuals, point)
    except np.linalg.LinAlgError:  # a normal matrix that rounding has made indefinite
        pass
    return best.replace(steps=taken, status=status)


def _nowhere(rows: Rows, cost, right) -> InteriorPoint:
    """What there is before anything is known."""
    free = np.zeros(rows.free_columns.shape[1])
    return InteriorPoint(z=np.ones(len(cost)), f=free, y=np.zeros(len(right)), s=np.ones(len(cost)))


def start(
    rows: Rows, cost: Float[np.ndarray, " m"], free_cost: Float[np.ndarray, " q"], right: Float[np.ndarray, " n"]
) -> InteriorPoint:
    """Mehrotra's start: the least-norm solutions of both sets of equations, pushed into the interior.

    Then s is raised until the products z s are even and weigh as much as the residuals. Where s = 0 is nearly feasible
    (features that sum to a constant, say), the products would otherwise be nothing long before z is feasible, and the
    steps no longer than the gap between them. `rows` are factorised for d = 1.
    """
    y, f = rows.solve(right, np.zeros_like(free_cost))
    z = rows.transpose @ y
    y, _ = rows.solve(rows.matrix @ cost, free_cost)
    s = cost - rows.transpose @ y
    z, s = (v + max(-1.5 * v.min(), 0.0) + 1e-8 for v in (z, s))
    product = 0.5 * (z @ s)
    z, s = z + product / s.sum(), s + product / z.sum()
    point = InteriorPoint(z=z, f=f, y=y, s=s)
    worth = sum(_effects(_residuals(rows, cost, free_cost, right, point), point))
    return point.replace(s=np.maximum(s, worth / (len(z) * z)))


def _residuals(rows: Rows, cost, free_cost, right, point: InteriorPoint):
    primal = right - rows.matrix @ point.z - rows.free_columns @ point.f
    return primal, cost - rows.transpose @ point.y - point.s, free_cost - rows.free_columns.T @ point.y


def _error(residuals, point: InteriorPoint) -> float:
    return float(max(point.z @ point.s, *_effects(residuals, point)))


def _effects(residuals, point: InteriorPoint) -> list[float]:
    """A residual counts with the multiplier, or the variable, that it stands beside: its first-order effect."""
    pairs = zip(residuals, (point.y, point.z, point.f), strict=True)
    return [np.abs(residual) @ np.abs(beside) for residual, beside in pairs]


def _step(rows: Rows, residuals, point: InteriorPoint) -> InteriorPoint:
    """A predictor, a corrector, and further correctors as long as they lengthen the step."""
    z, s = point.z, point.s
    rows.factor(z / s)
    nothing = [np.zeros_like(residual) for residual in residuals]

    def direction(products, residuals) -> _Change:
        """What adds `products` to z s and takes the residuals away, to first order."""
        primal, dual, free = residuals
        dy, df = rows.solve(primal - rows.matrix @ ((products - z * dual) / s), free)
        ds = dual - rows.transpose @ dy
        return _Change((products - z * ds) / s, df, dy, ds)

    change = direction(-z * s, residuals)
    along, across = change.lengths(point)
    left = (z + along * change.z) @ (s + across * change.s) / (z @ s)
    target = mehrotra_target((z @ s) / len(z), left, most=np.inf)
    change = direction(target - z * s - change.z * change.s, residuals)
    along, across = change.lengths(point)
    for _ in range(MOST_CORRECTORS):
        further_along, further_across = min(1.0, along + LONGER), min(1.0, across + LONGER)
        products = (z + further_along * change.z) * (s + further_across * change.s)
        corrected = change.corrected(direction(towards_centre(products, target, EVEN), nothing))
        longer_along, longer_across = corrected.lengths(point)
        if longer_along + longer_across < along + across + WORTH_IT:
            break
        change, along, across = corrected, longer_along, longer_across
    along, across = change.lengths(point, TO_BOUNDARY)
    return point.replace(
        z=z + along * change.z, f=point.f + along * change.f, y=point.y + across * change.y, s=s + across * change.s
    )


class _Change(NamedTuple):
    """What a step adds to an iterate, before it is cut to length."""

    z: np.ndarray
    f: np.ndarray
    y: np.ndarray
    s: np.ndarray

    def corrected(self, by: "_Change") -> "_Change":
        return _Change(*map(np.add, self, by))

    def lengths(self, point: InteriorPoint, share: float = 1.0) -> tuple[float, float]:
        """The longest steps up to 1 that leave z, and s, positive; times `share` where the boundary is in the way."""
        sides = (point.z, self.z), (point.s, self.s)
        return tuple(float(longest_step(side, to_boundary=share)) for side in sides)
