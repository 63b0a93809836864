"""Canonical forms of small models: which of them are equal up to a renaming of states that keeps the centre.

Colour refinement: every state gets a hash of its own colour and of the probabilities and colours of what it leads to
and what leads to it, repeatedly. Sorting by colour gives a canonical order, and two models count as equal only if,
brought into that order, they are equal to the entry. A hash that collides or a tie that is broken badly can miss an
isomorphism, which costs time, but never invent one.
"""

import numpy as np

_MAX_ONE_BY_ONE = 32  # larger models have their ties broken all at once
_MAX_ATTEMPTS = 2000  # to name the image of a state, before it stays open whether two models are equal
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
    quanta, marks = _quantised(transition, labels, bits)
    count, size = quanta.shape[:2]
    colour = _refine(quanta, _first_colours(quanta, marks))
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


def stable_colours(transition: np.ndarray, bits: int, labels: np.ndarray | None = None) -> np.ndarray:
    """Colours [P, n] of the states after refinement; the same, in some order, for isomorphic models."""
    quanta, marks = _quantised(transition, labels, bits)
    return _refine(quanta, _first_colours(quanta, marks))


def are_isomorphic(transition: np.ndarray, bits: int, labels: np.ndarray | None = None) -> bool | None:
    """Whether two models are equal up to a renaming of states that keeps the centre; None if that takes too long.

    A state whose colour others share is singled out in the first model, and each that may be its image in the second
    one, until all colours are different; colours that do not occur as often in both end the attempt.

    Args:
      transition, bits, labels: of the two, as in `canonical_forms`.
    """
    quanta, marks = _quantised(transition, labels, bits)
    left, waiting = _MAX_ATTEMPTS, [_refine_together(quanta, _first_colours(quanta, marks))]
    while waiting:
        colour = waiting.pop()
        if colour is None:
            continue
        tied = _tied(colour[:1])[0]
        if not tied.any():
            order = np.argsort(colour, axis=1)
            rows = np.take_along_axis(quanta, order[:, :, None, None], axis=1)
            one, other = np.take_along_axis(rows, order[:, None, None, :], axis=3)
            same_marks = marks is None or np.array_equal(*np.take_along_axis(marks, order[:, :, None], axis=1))
            if same_marks and np.array_equal(one, other):
                return True
            continue
        chosen = colour[0, tied].min()
        first = int(np.flatnonzero(colour[0] == chosen)[0])
        new = _mix(colour[:1, first] + np.uint64(7))
        for image in np.flatnonzero(colour[1] == chosen):
            if left == 0:
                return None
            left -= 1
            single = colour.copy()
            single[[0, 1], [first, image]] = new
            waiting.append(_refine_together(quanta, single))
    return False


def _refine_together(quanta: np.ndarray, colour: np.ndarray) -> np.ndarray | None:
    """Refined colours [2, n] of two models, after equally many rounds; None where these differ in how often."""
    present, edge = _edges(quanta)
    while True:
        if not np.array_equal(*np.sort(colour, axis=1)):
            return None
        refined = _refined(edge, present, colour)
        if (_num_colours(refined) == _num_colours(colour)).all():
            return colour
        colour = refined


def colours_in_rounds(
    transition: np.ndarray, bits: int, labels: np.ndarray | None, num_rounds: int, is_anchored: bool
) -> np.ndarray:
    """Colours of every state before and after each round of refinement, uint64 [R + 1, P, n].

    Equal colours, in any two models, stand for equal surroundings up to as many steps as there were rounds.

    Args:
      transition, bits, labels: as in `canonical_forms`.
      num_rounds: R.
      is_anchored: whether the centre has a colour of its own from the start.
    """
    quanta, marks = _quantised(transition, labels, bits)
    present, edge = _edges(quanta)
    colours = [_first_colours(quanta, marks, is_anchored)]
    for _ in range(num_rounds):
        colours.append(_refined(edge, present, colours[-1]))
    return np.stack(colours)


def _quantised(transition, labels, bits: int) -> tuple[np.ndarray, np.ndarray | None]:
    """Probabilities [P, n, A, n] and labels [P, n, A L] as whole numbers of quanta."""
    quanta = np.rint(transition.astype(np.float64) * 2.0**bits).astype(np.uint64)
    if labels is None:
        return quanta, None
    marks = np.rint(labels.astype(np.float64) * 2.0**bits).astype(np.int64).view(np.uint64)
    return quanta, marks.reshape(*quanta.shape[:2], -1)


def _first_colours(quanta: np.ndarray, marks: np.ndarray | None, is_anchored: bool = True) -> np.ndarray:
    """Colours [P, n] of the labels, and of being the centre."""
    count, size = quanta.shape[:2]
    own = np.where(is_anchored & (np.arange(size) == 0), 1, 2).astype(np.uint64)
    colour = np.broadcast_to(own, (count, size))
    if marks is None:
        return colour
    place = np.arange(marks.shape[2], dtype=np.uint64)
    return _mix(colour + _mix(_mix(marks) + place).sum(axis=2))


def _refine(quanta: np.ndarray, colour: np.ndarray) -> np.ndarray:
    """Colour refinement to a stable partition; colours are [P, n] hashes that do not depend on the order.

    A model stops when its own partition is stable: its colours must not depend on the models beside it.
    """
    present, edge = _edges(quanta)
    colour, active = colour.copy(), np.arange(len(colour))
    while active.size:
        old = colour[active]
        colour[active] = _refined(edge, present, old)
        refines = _num_colours(colour[active]) != _num_colours(old)
        active, edge, present = active[refines], edge[refines], present[refines]
    return colour


def _edges(quanta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where there is a transition, and the hash of its probability and its action, [P, n, A, n]."""
    action = np.arange(quanta.shape[2], dtype=np.uint64)[:, None]
    return quanta > 0, _mix(quanta * np.uint64(31) + action)


def _refined(edge: np.ndarray, present: np.ndarray, colour: np.ndarray) -> np.ndarray:
    """Colours [P, n] after one round."""
    leads_to = np.where(present, _mix(edge + colour[:, None, None, :]), np.uint64(0))
    led_to_by = np.where(present, _mix(edge ^ _mix(colour)[:, :, None, None]), np.uint64(0))
    outgoing, incoming = leads_to.sum(axis=(2, 3)), led_to_by.sum(axis=(1, 2))
    return _mix(colour + _mix(outgoing) + _mix(_mix(incoming)))


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
