"""Several methods in turn: each takes the lanes that those before it have left open, from where they stopped."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from jaxhom.apprenticeship.request import Request
from jaxhom.apprenticeship.solution import Found
from jaxhom.status import Status

if TYPE_CHECKING:
    from jaxtyping import Int


def in_turn(request: Request, *methods: Callable[[Request], Found]) -> Found:
    """What the first method finds, and for the lanes that it leaves open the next ones.

    A method begins with the policies, weights and values of those before it, and what it finds counts only where it
    leaves less open. The iterations of a lane are those of all methods.
    """
    first, *others = methods
    found = first(request)
    for method in others:
        left = _left_open(request, found)
        if not left.size:
            break
        old = found.part(left)
        limit = None if request.limit is None else int((request.limit - old.iterations).min())
        new = method(request.part(left, policy=old.x, weights=old.weights, value=old.value, limit=limit))
        iterations = old.iterations + new.iterations
        is_worse = np.flatnonzero(~(new.gap < old.gap) & np.isfinite(old.gap))
        if is_worse.size:
            new = new.with_lanes(is_worse, old.part(is_worse))
        is_out = iterations >= (np.inf if request.limit is None else request.limit)
        stopped = np.where(is_out, Status.ITERATION_LIMIT, new.stopped)
        found = found.with_lanes(left, dataclasses.replace(new, iterations=iterations, stopped=stopped))
    return found


def _left_open(request: Request, found: Found) -> Int[np.ndarray, " C"]:
    """The lanes that are open by the method's own account, or by the certificate, and have iterations left."""
    is_open = ~(found.gap <= request.tolerance)
    closed = np.flatnonzero(~is_open)
    if closed.size:
        is_open[closed] = request.part(closed).certified(found.part(closed)).status != Status.SOLVED
    if request.limit is not None:
        is_open &= found.iterations < request.limit
    return np.flatnonzero(is_open)
