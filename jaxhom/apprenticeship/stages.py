"""Several methods in turn: each takes the lanes that those before it have left open, from where they stopped."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from jaxhom.apprenticeship.request import Request
from jaxhom.apprenticeship.solution import Found
from jaxhom.status import Status


def in_turn(request: Request, *methods: Callable[[Request], Found]) -> Found:
    """What the first method finds, and for the lanes that it leaves open the next ones.

    A method begins with the policy, weights and values of those before it, and what it finds counts only where its
    certificate is better. The iterations of a lane are those of all methods.
    """
    first, *others = methods
    found = first(request)
    for method in others:
        solution = request.certified(found)
        is_left = solution.status != Status.SOLVED
        if request.limit is not None:
            is_left &= solution.iterations < request.limit
        left = np.flatnonzero(is_left)
        if not left.size:
            break
        old, gap = found.part(left), (solution.margin_bound - solution.margin)[left]
        start = {"policy": solution.policy[left], "weights": solution.weights[left], "spent": solution.iterations[left]}
        asked = request.part(left, value=old.value, **start)
        new = method(asked)
        certified = asked.certified(new)
        is_worse = np.flatnonzero(~(certified.margin_bound - certified.margin < gap))
        if is_worse.size:
            counts = new.iterations
            new = new.with_lanes(is_worse, old.part(is_worse))
            new.iterations[is_worse] = counts[is_worse]
        found = found.with_lanes(left, new)
    return found
