"""How large the index arrays of the successor layout are: rounded up to few sizes.

A program is compiled for the shapes of its arrays. The maps of one game mostly agree in S, A and N, but hardly ever in
the number of edges of their graphs or in the length of lists; rounded up, they share one program, and can be stacked.
What a program reads in every sweep is rounded up by a sixteenth or so, and what it reads once by more.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from jaxhom import checks

PIECE = 16  # items of a row that are added up in one go
FEW_PIECES = 8  # of all rows, that nobody feels: a fraction of a microsecond
_EXACT_WIDTH = 10  # up to here a term more in every row is felt
_EXACT_DEGREE = 4  # edges per state up to which they are rounded to powers of two: grids with walls have two to four


class RowSize(NamedTuple):
    """The shapes of `PaddedRows`: narrow [R, width], wide [pieces, PIECE]."""

    width: int
    pieces: int


class ListSizes(NamedTuple):
    """The sizes of `SuccessorLists` that do not follow from S and A.

    Attributes:
      slots: N.
      narrow_width: slots that every sweep reads for every pair.
      wide_pairs: J, pairs with more successors than that.
      shares_successors: whether all these pairs have the same.
      predecessors, outgoing, incoming: of the lists of entries and of edges.
      edges: E.
    """

    slots: int
    narrow_width: int
    wide_pairs: int
    shares_successors: bool
    predecessors: RowSize
    edges: int
    outgoing: RowSize
    incoming: RowSize


def common_sizes(sizes: Iterable[ListSizes]) -> ListSizes:
    """The least sizes that hold the lists of every one of some models."""
    sizes = list(sizes)
    shares = all(one.shares_successors or not one.wide_pairs for one in sizes)
    rows = {
        name: RowSize(*np.max([getattr(one, name) for one in sizes], axis=0).tolist())
        for name in ("predecessors", "outgoing", "incoming")
    }
    counts = {
        name: max(getattr(one, name) for one in sizes) for name in ("slots", "narrow_width", "wide_pairs", "edges")
    }
    return ListSizes(**counts, **rows, shares_successors=shares and counts["wide_pairs"] > 0)


def rounded_width(width: int) -> int:
    """Width of rows that are read whole: exact while it is small, then 12, then multiples of 16."""
    if width <= _EXACT_WIDTH:
        return width
    return 12 if width <= 12 else -(-width // PIECE) * PIECE


def rounded_count(count: int, beside: int = 0, least: int = 1) -> int:
    """More by at most an eighth, by a sixteenth of `beside`, which is read all the same, or by less than `least`.

    0 stays 0: programs leave out what is not there.
    """
    if count == 0:
        return 0
    step = max(_power_below(count) // 8, _power_below(beside // 16), least)
    return -(-count // step) * step


def rounded_edges(count: int, num_states: int, outgoing: RowSize) -> int:
    """Edges, as many per state of all: programs read them once for every policy, and then rows of them."""
    degree = -(-count // num_states)
    degree = 1 << (degree - 1).bit_length() if degree <= _EXACT_DEGREE else rounded_count(degree)
    most = num_states * outgoing.width + outgoing.pieces * PIECE  # all that fit into the rows
    return min(num_states * degree, most, checks.MAX_SLOTS)


def _power_below(count: int) -> int:
    """The largest power of two that is not larger; 0 for 0."""
    return 1 << (count.bit_length() - 1) if count > 0 else 0
