"""Ragged lists in rectangles: every item is found again in its row, and sums are those of a dense matrix."""

import jax
import numpy as np
import pytest

from jaxhom.models.padded_rows import gather_sum, narrow_width, pad_rows, rows_and_places, sum_rows

COUNTS = {
    "all alike": [3, 3, 3, 3],
    "one row": [5],
    "some empty": [0, 2, 0, 1, 0],
    "one long": [1] * 40 + [30],
    "a few long": [2, 0, 1, 2] * 30 + [17, 40, 18] + [2] * 5,
    "two widths": [1] * 60 + [4] * 20 + [60],
    "long in the mean": list(range(1, 30)),
}


def lists(counts):
    """Items in an order that mixes the rows, and their owners."""
    rng = np.random.default_rng(len(counts))
    owner = rng.permutation(np.repeat(np.arange(len(counts)), counts))
    return rng.permutation(len(owner)), owner


@pytest.mark.parametrize("name", COUNTS)
def test_rows_keep_their_items_in_order(name):
    counts = COUNTS[name]
    items, owner = lists(counts)
    rows = pad_rows(items, owner, len(counts), sentinel=-7)
    for r in range(len(counts)):
        pieces = [rows.narrow[r], *rows.wide[rows.wide_row == r]]
        kept = np.concatenate(pieces)
        np.testing.assert_array_equal(kept[kept != -7], items[owner == r])
    for array in (rows.narrow, rows.wide, rows.wide_row):
        assert array.dtype == np.int32


@pytest.mark.parametrize("name", COUNTS)
def test_width_that_reads_least(name):
    """Against all widths, long rows read to the end of the longest: the best if it halves that, or the longest row."""
    counts = np.array(COUNTS[name])
    longest = counts.max()
    cost = {w: len(counts) * w + (counts > w).sum() * (longest - w) for w in range(1, longest + 1)}
    width = narrow_width(counts)
    if 2 * min(cost.values()) < cost[longest]:
        assert cost[width] == min(cost.values())
    else:
        assert width == longest


@pytest.mark.parametrize(("name", "width"), [("all alike", 3), ("one long", 1), ("two widths", 4), ("a few long", 2)])
def test_widths_worked_out_by_hand(name, width):
    assert narrow_width(np.array(COUNTS[name])) == width


@pytest.mark.parametrize("name", ["a few long", "long in the mean"])
def test_sums_over_rows(name):
    """Weights for all columns or one per column; the sentinel's weight is 0. "long in the mean" runs in blocks."""
    counts = COUNTS[name]
    rng = np.random.default_rng(0)
    items, owner = lists(counts)
    rows = pad_rows(items, owner, len(counts), sentinel=len(items))
    state = np.append(rng.integers(6, size=len(items)), 0)
    weight = np.append(rng.normal(size=len(items)), 0.0)
    weights = np.append(rng.normal(size=(len(items), 3)), np.zeros((1, 3)), axis=0)
    value, values = rng.normal(size=6), rng.normal(size=(6, 3))
    matrix, matrices = np.zeros((len(counts), 6)), np.zeros((len(counts), 6, 3))
    np.add.at(matrix, (owner, state[items]), weight[items])
    np.add.at(matrices, (owner, state[items]), weights[items])

    @jax.jit
    def sums(rows, state, weight, weights, value, values):
        index, each = rows.lookup(state), rows.lookup(weight)
        return (
            sum_rows(index, each, value),
            sum_rows(index, each, values),
            sum_rows(index, rows.lookup(weights), values),
        )

    single, batch, own = sums(rows, state, weight, weights, value, values)
    np.testing.assert_allclose(single, matrix @ value, rtol=0, atol=1e-12)
    np.testing.assert_allclose(batch, matrix @ values, rtol=0, atol=1e-12)
    np.testing.assert_allclose(own, np.einsum("rsb,sb->rb", matrices, values), rtol=0, atol=1e-12)


@pytest.mark.parametrize("width", [16, 33])
def test_sums_of_many_terms(width):
    """Two axes of rows, with lengths just within and beyond what is unrolled, and a multiple of neither."""
    rng = np.random.default_rng(width)
    index, weight = rng.integers(5, size=(2, 3, width)), rng.normal(size=(2, 3, width))
    values = rng.normal(size=(5, 2))
    total = jax.jit(gather_sum)(index, weight, values)
    np.testing.assert_allclose(total, np.einsum("ijn,ijnb->ijb", weight, values[index]), rtol=0, atol=1e-12)


def test_rows_and_places_of_ragged_rows():
    row, place = rows_and_places(np.array([2, 0, 3, 1, 0]))
    np.testing.assert_array_equal(row, [0, 0, 2, 2, 2, 3])
    np.testing.assert_array_equal(place, [0, 1, 0, 1, 2, 0])
    assert all(len(array) == 0 for array in rows_and_places(np.zeros(0, int)))
