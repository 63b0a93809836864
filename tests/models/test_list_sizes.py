"""Sizes are rounded up by as much as is said, hold what they have to, and are the same for maps of one kind."""

import numpy as np
import pytest

import jaxhom
from jaxhom.models.list_sizes import (
    ListSizes,
    RowSize,
    common_sizes,
    rounded_count,
    rounded_edges,
    rounded_width,
)


def test_widths():
    """Exact where a term more is felt, multiples of 16 where sums are loops over so many."""
    rounded = {width: rounded_width(width) for width in range(1, 50)}
    assert all(rounded[width] == width for width in (*range(1, 11), 12, 16, 32, 48))
    assert (rounded[11], rounded[13], rounded[17], rounded[33]) == (12, 16, 32, 48)


@pytest.mark.parametrize("beside", [0, 500, 10_000])
def test_counts(beside):
    """By an eighth, or a sixteenth of what is beside; 0 stays 0, since programs leave out what is not there."""
    counts = np.arange(1, 3000)
    rounded = np.array([rounded_count(int(count), beside) for count in counts])
    assert rounded_count(0, beside) == 0
    assert (rounded >= counts).all()
    assert (rounded - counts <= np.maximum(counts / 8, beside / 16)).all()
    assert (np.diff(rounded) >= 0).all()
    assert {rounded_count(count, least=8) for count in range(1, 9)} == {8}
    assert len(np.unique(rounded)) <= 8 * np.log2(3000)


@pytest.mark.parametrize(("edges", "expected"), [(1, 100), (100, 100), (101, 200), (211, 400), (1650, 1800)])
def test_edges(edges, expected):
    """As many for every state: powers of two up to four, then finer."""
    assert rounded_edges(edges, 100, RowSize(20, 0)) == expected


def test_no_more_edges_than_rows_hold():
    assert rounded_edges(211, 100, RowSize(3, 0)) == 300
    assert rounded_edges(211, 100, RowSize(3, 2)) == 332


def test_common_sizes():
    """The largest of each; successors are shared where all models that have wide pairs share theirs."""
    rows = {"predecessors": RowSize(4, 0), "outgoing": RowSize(3, 1), "incoming": RowSize(4, 0)}
    one = ListSizes(slots=9, narrow_width=2, wide_pairs=5, shares_successors=True, edges=100, **rows)
    narrow = one._replace(slots=3, narrow_width=3, wide_pairs=0, shares_successors=False, outgoing=RowSize(4, 0))
    both = common_sizes([one, narrow])
    assert both == one._replace(narrow_width=3, outgoing=RowSize(4, 1))
    assert common_sizes([narrow, narrow]) == narrow
    assert not common_sizes([one, narrow._replace(wide_pairs=1)]).shares_successors


def test_maps_of_one_kind_have_one_size():
    """Mazes on a grid with as many walls, which are states that nothing leads out of or into."""

    def maze(seed):
        rng = np.random.default_rng(seed)
        free = np.ones((8, 8), bool)
        free.ravel()[rng.choice(np.arange(1, 63), 8, replace=False)] = False
        states = np.arange(64)
        cells = np.stack(np.divmod(states, 8), axis=1)
        moved = np.clip(cells[:, None] + [(-1, 0), (1, 0), (0, -1), (0, 1)], 0, 7)
        stays = ~free[tuple(np.moveaxis(moved, -1, 0))] | ~free.ravel()[:, None]
        next_state = np.where(stays, states[:, None], moved @ [8, 1])
        slips = np.stack([np.roll(next_state, k, axis=1) for k in range(4)], axis=-1)  # each move, or another
        return jaxhom.MDP.from_successors(slips, np.broadcast_to([0.7, 0.1, 0.1, 0.1], slips.shape), discount=0.9)

    found = {maze(seed).dynamics.sizes for seed in range(20)}
    assert len(found) == 1
