"""Canonical forms of small models: which of them are equal up to a renaming of states that keeps the centre.

Colour refinement: every state gets a hash of its own colour and of the probabilities and colours of what it leads to
and what leads to it, repeatedly. Sorting by colour gives a canonical order, and two models count as equal only if,
brought into that order, they are equal to the entry. A hash that collides or a tie that is broken badly can miss an
isomorphism, which costs time, but never invent one.
"""

import numpy as np

_MAX_ONE_BY_ONE = 32  # larger models have their ties broken all at once
_SEED = np.uint64(0x9E3779B97F4A7C15)


def canonical_forms(
    transition: np.ndarray, bits: int, labels: np.ndarray | None = None
) -> tuple[list[bytes], np.ndarray]:
    """Keys that are equal only if two models of the same size are equal up to renaming.

    Args:
      transition: [P, n, A, n], the centre of each model is its state 0.
      bits: probabilities and labels count as equal if they agree to 2^-bits.
      labels: [P, n, A, L], what else a renaming has to keep.

    Returns:
      P keys, and the order of the states that each is read off in, int [P, n], centre first.
    """
    quanta = np.rint(transition.astype(np.float64) * 2.0**bits).astype(np.uint64)
    count, size = quanta.shape[:2]
    colour = np.broadcast_to(np.where(np.arange(size) == 0, 1, 2).astype(np.uint64), (count, size))
    if labels is not None:
        marks = np.rint(labels.astype(np.float64) * 2.0**bits).astype(np.int64).view(np.uint64).reshape(count, size, -1)
        place = np.arange(marks.shape[2], dtype=np.uint64)
        colour = _mix(colour + _mix(_mix(marks) + place).sum(axis=2))
    colour = _refine(quanta, colour)
    active = np.arange(count)
    while True:
        tied = _tied(colour[active])
        active = active[tied.any(axis=1)]
        if not active.size:
            break
        colour[active] = _refine(quanta[active], _break_ties(colour[active], tied[tied.any(axis=1)]))
    order = np.argsort(np.where(np.arange(size) == 0, np.uint64(0), colour), axis=1, kind="stable")
    rows = np.take_along_axis(quanta, order[:, :, None, None], axis=1)
    canonical = np.take_along_axis(rows, order[:, None, None, :], axis=3)
    keys = [model.tobytes() for model in canonical]
    if labels is not None:
        ordered = np.take_along_axis(marks, order[:, :, None], axis=1)
        keys = [key + mark.tobytes() for key, mark in zip(keys, ordered, strict=True)]
    return keys, order


def _refine(quanta: np.ndarray, colour: np.ndarray) -> np.ndarray:
    """Colour refinement to a stable partition; colours are [P, n] hashes that do not depend on the order.

    A model stops when its own partition is stable: its colours must not depend on the models beside it.
    """
    action = np.arange(quanta.shape[2], dtype=np.uint64)[:, None]
    present = quanta > 0
    edge = _mix(quanta * np.uint64(31) + action)
    colour, active = colour.copy(), np.arange(len(colour))
    while active.size:
        old = colour[active]
        leads_to = np.where(present, _mix(edge + old[:, None, None, :]), np.uint64(0))
        led_to_by = np.where(present, _mix(edge ^ _mix(old)[:, :, None, None]), np.uint64(0))
        outgoing, incoming = leads_to.sum(axis=(2, 3)), led_to_by.sum(axis=(1, 2))
        colour[active] = _mix(old + _mix(outgoing) + _mix(_mix(incoming)))
        refines = _num_colours(colour[active]) != _num_colours(old)
        active, edge, present = active[refines], edge[refines], present[refines]
    return colour


def _num_colours(colour: np.ndarray) -> np.ndarray:
    """Number of different colours in each row."""
    ordered = np.sort(colour, axis=1)
    return 1 + (ordered[:, 1:] != ordered[:, :-1]).sum(axis=1)


def _tied(colour: np.ndarray) -> np.ndarray:
    """Marks, per row, the states whose colour another state has too."""
    order = np.argsort(colour, axis=1, kind="stable")
    ordered = np.take_along_axis(colour, order, axis=1)
    equal = np.zeros((len(colour), colour.shape[1] + 1), bool)
    equal[:, 1:-1] = ordered[:, 1:] == ordered[:, :-1]
    tied = np.zeros(colour.shape, bool)
    np.put_along_axis(tied, order, equal[:, 1:] | equal[:, :-1], axis=1)
    return tied


def _break_ties(colour: np.ndarray, tied: np.ndarray) -> np.ndarray:
    """Gives one state of the smallest tied colour a colour of its own; all tied states if the model is large."""
    rank = np.arange(colour.shape[1], dtype=np.uint64)
    if colour.shape[1] > _MAX_ONE_BY_ONE:
        return np.where(tied, _mix(colour + rank), colour)
    chosen = np.argmin(np.where(tied, colour, np.iinfo(np.uint64).max), axis=1)[:, None]
    return np.where(rank == chosen, _mix(colour + np.uint64(7)), colour)


def _mix(value: np.ndarray) -> np.ndarray:
    """The finaliser of splitmix64 (Steele, Lea and Flood 2014), modulo 2^64."""
    value = value + _SEED
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return value ^ (value >> np.uint64(31))
