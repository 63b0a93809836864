"""The point of a convex hull that is nearest to the origin (Wolfe 1976), with the mixture that it is.

    min |sum_j q_j p_j|_2   over   q >= 0,  sum_j q_j = 1

An active-set method: the points with q_j > 0 are affinely independent, and the mixture is the point of their affine
hull that is nearest. As long as some point lies on the near side of it, that point joins; if the nearest point of the
larger affine hull lies outside the convex one, points leave. Exact up to rounding after finitely many steps, and few
where only one point is new.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float, Int

_STEPS = 1000  # never needed: it ends a loop that rounding might keep going
_ROUNDINGS = 64.0  # of squared lengths, by which a point has to be nearer to join


def nearest_mixture(points: Float[np.ndarray, "M K"], start: Float[np.ndarray, " M"]) -> Float[np.ndarray, " M"]:
    """The mixture q [M] of the points [M, K] that is nearest to the origin.

    Args:
      points: [M, K].
      start: [M], a mixture to begin with, such as the nearest one before points were added.
    """
    shares = start / start.sum()
    size = np.linalg.norm(points, axis=1).max()
    for _ in range(_STEPS):
        nearest = shares @ points
        length = nearest @ nearest
        along = points @ nearest
        joins = along.argmin()
        rounding = _ROUNDINGS * np.finfo(float).eps * size * np.sqrt(length)
        if along[joins] >= length - rounding or shares[joins] > 0:
            break
        better = _shrink(points, shares, np.append(np.flatnonzero(shares), joins))
        if not np.linalg.norm(better @ points) < np.sqrt(length):
            break
        shares = better
    return shares


def _shrink(
    points: Float[np.ndarray, "M K"], shares: Float[np.ndarray, " M"], support: Int[np.ndarray, " J"]
) -> Float[np.ndarray, " M"]:
    """The nearest mixture of the affine hull of a support, or of that of the part of it that is not left on the way."""
    now = shares[support]
    while True:
        goal = _affine(points[support])
        falls = goal <= 0
        if not falls.any():
            break
        step = (now[falls] / (now[falls] - goal[falls] + np.finfo(float).tiny)).min()
        now = np.maximum(now + min(step, 1.0) * (goal - now), 0.0)
        leaves = falls & (now <= np.finfo(float).eps)
        if not leaves.any():  # rounding: what was to leave has to
            leaves = falls & (now == now[falls].min())
        support, now = support[~leaves], now[~leaves]
    found = np.zeros_like(shares)
    found[support] = goal / goal.sum()
    return found


def _affine(points: Float[np.ndarray, "J K"]) -> Float[np.ndarray, " J"]:
    """Coefficients of sum 1 of the point of an affine hull that is nearest to the origin; they may be negative."""
    base = points[0]
    rest = np.linalg.lstsq((points[1:] - base).T, -base, rcond=None)[0]
    return np.append(1.0 - rest.sum(), rest)
