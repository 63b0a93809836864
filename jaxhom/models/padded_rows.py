"""Ragged lists of indices as rectangular arrays, and weighted sums over them.

Sparse products run on padded rows: entry [r, n] names the n-th number that row r adds up. Rows that are far longer
than most (a restart anywhere on a track, say) would make every row pay for them, so they are kept apart.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom.models.list_sizes import FEW_PIECES, PIECE, RowSize, rounded_count, rounded_width
from jaxhom.status import Record

if TYPE_CHECKING:
    from jaxtyping import Array, ArrayLike, Float, Int, Num

_MAX_UNROLL = PIECE  # terms that are written out; longer sums are loops over blocks of so many
MAX_UNROLLED_ACTIONS = 16  # more are not written out one by one: programs would take minutes to compile


class PaddedRows(Record):
    """One list per row, split so that a few long ones do not widen all of them.

    Attributes:
      narrow: [R, W, ...], the first W items of every row; a sentinel where a row is shorter.
      wide_row: int32 [J], the rows that go on; once for every V further items. J is rounded up (`list_sizes`).
      wide: [J, V, ...], those items; the sentinel where a row is shorter.
    """

    narrow: Num[Array, "R W *X"]
    wide_row: Int[Array, " J"]
    wide: Num[Array, "J V *X"]

    @property
    def size(self) -> RowSize:
        """W and J."""
        return RowSize(self.narrow.shape[1], self.wide.shape[0])

    def lookup(self, table: Num[Array, "I *X"]) -> PaddedRows:
        """The rows with every item i replaced by table[i]."""
        return PaddedRows(narrow=table[self.narrow], wide_row=self.wide_row, wide=table[self.wide])


def pad_rows(
    items: Int[np.ndarray, " I"],
    owner: Int[np.ndarray, " I"],
    num_rows: int,
    sentinel: int,
    size: RowSize | None = None,
) -> PaddedRows:
    """Lists, per row, the items that it owns, in their order; owners in [0, num_rows). On the host.

    Args:
      items: [I].
      owner: int [I], the row of each.
      num_rows: R.
      sentinel: what stands where there is no item.
      size: of the arrays, large enough; that of `row_size` if None. Pieces that no row needs hold sentinels and belong
        to the last row.
    """
    order = np.argsort(owner, kind="stable")
    items, owner = items[order], owner[order]
    counts = np.bincount(owner, minlength=num_rows)
    width, num_pieces = row_size(counts) if size is None else size
    place = np.arange(len(items)) - (np.cumsum(counts) - counts)[owner]
    narrow = np.full((num_rows, width), sentinel, np.int32)
    inside = place < width
    narrow[owner[inside], place[inside]] = items[inside]
    pieces = -(-np.maximum(counts - width, 0) // PIECE)  # a few rows may be far longer than the other long ones
    first_piece = np.cumsum(pieces) - pieces
    wide = np.full((num_pieces, PIECE), sentinel, np.int32)
    piece, slot = np.divmod(place[~inside] - width, PIECE)
    wide[first_piece[owner[~inside]] + piece, slot] = items[~inside]
    wide_row = np.full(num_pieces, num_rows - 1, np.int32)
    wide_row[: pieces.sum()] = np.repeat(np.arange(num_rows), pieces)
    return PaddedRows(narrow=narrow, wide_row=wide_row, wide=wide)


def rows_and_places(lengths: Int[np.ndarray, " R"]) -> tuple[Int[np.ndarray, " I"], Int[np.ndarray, " I"]]:
    """Of all items of ragged rows, one row after the other: the row of each, and its place there."""
    row = np.repeat(np.arange(len(lengths), dtype=np.int64), lengths)
    return row, np.arange(len(row)) - (np.cumsum(lengths) - lengths)[row]


def narrow_width(counts: Int[np.ndarray, " R"]) -> int:
    """Width that minimises the items read per sweep, all rows to the width and long rows to the end."""
    longest = int(counts.max())
    widths = np.unique(counts[counts > 0])
    beyond = np.array([(counts > w).sum() for w in widths])
    cost = counts.size * widths + beyond * (longest - widths)
    best = int(np.argmin(cost))
    return int(widths[best]) if 2 * cost[best] < cost[-1] else longest


def row_size(counts: Int[np.ndarray, " R"]) -> RowSize:
    """The shape of rows with so many items each, rounded up."""
    width = rounded_width(narrow_width(counts))
    pieces = -(-np.maximum(counts - width, 0) // PIECE)
    return RowSize(width, rounded_count(int(pieces.sum()), counts.size * width // PIECE, FEW_PIECES))


def sum_rows(index: PaddedRows, weight: PaddedRows, values: Float[Array, "S *B"]) -> Float[Array, "R *B"]:
    """sum_n weight[r, n] values[index[r, n]] for every row; `values` [S] or [S, B], weights without B or with it."""
    total = gather_sum(index.narrow, weight.narrow, values)
    if index.wide_row.size:
        total = total.at[index.wide_row].add(gather_sum(index.wide, weight.wide, values))
    return total


def gather_sum(index: Int[Array, "*R n"], weight: Float[Array, "*R n *B"], values: Float[ArrayLike, "S *B"]) -> Array:
    """sum_n weight[..., n] values[index[..., n]], unrolled while n is small.

    Args:
      index: [..., n].
      weight: [..., n], or [..., n, B] beside values of shape [S, B].
      values: [S] or [S, B].
    """
    axis = index.ndim - 1
    if index.shape[-1] > _MAX_UNROLL:
        values = jnp.asarray(values)

        # A loop over blocks of terms, each one fused pass: the gathered numbers never go through memory.
        def blocks(array):
            padding = [(0, 0)] * array.ndim
            padding[axis] = (0, -index.shape[-1] % _MAX_UNROLL)
            shape = (*index.shape[:-1], -1, _MAX_UNROLL, *array.shape[axis + 1 :])
            return jnp.moveaxis(jnp.pad(array, padding).reshape(shape), axis, 0)

        total = jnp.zeros(index.shape[:-1] + values.shape[1:], jnp.result_type(weight, values))
        return jax.lax.scan(
            lambda total, block: (total + gather_sum(*block, values), None), total, (blocks(index), blocks(weight))
        )[0]
    spread = (..., None) if weight.ndim < axis + values.ndim else ...
    terms = (jax.lax.index_in_dim(weight, n, axis, keepdims=False) for n in range(index.shape[-1]))
    return sum(term[spread] * values[index[..., n]] for n, term in enumerate(terms))
