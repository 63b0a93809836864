"""The nonzero entries of many small matrices as one block-diagonal matrix: products and least ratios of all at once."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import scipy

if TYPE_CHECKING:
    from jaxtyping import Float, Int

_MAX_SHARES = 2**22  # of slacks at a time: 32 MB


class Blocks(NamedTuple):
    """Blocks on the diagonal of a matrix of weights >= 0, one of a shape for every pair, compressed by columns.

    Attributes:
      weight: [E], positive. row: int [E], in the whole matrix. start: int [P * columns + 1], where columns begin.
      shape: rows and columns of a block.
    """

    weight: np.ndarray
    row: np.ndarray
    start: np.ndarray
    shape: tuple[int, int]

    @classmethod
    def of(cls, columns: Float[np.ndarray, "P columns rows"]) -> Blocks:
        """The transposes of matrices."""
        count, num_columns, num_rows = columns.shape
        block, column, row = np.nonzero(columns)
        start = np.zeros(count * num_columns + 1, np.int64)
        np.cumsum(np.bincount(block * num_columns + column, minlength=count * num_columns), out=start[1:])
        return cls(columns[block, column, row], block * num_rows + row, start, (num_rows, num_columns))

    def part(self, index: Int[np.ndarray, " Q"]) -> Blocks:
        """Some of the blocks, any of them as often as it is named."""
        num_rows, num_columns = self.shape
        counts = np.diff(self.start).reshape(-1, num_columns)[index]
        sizes = counts.sum(axis=1)
        start = np.append(0, np.cumsum(counts))
        block = np.repeat(np.arange(len(index)), sizes)
        entry = np.arange(start[-1]) + (self.start[index * num_columns] - start[:-1:num_columns])[block]
        row = self.row[entry] + ((np.arange(len(index)) - index) * num_rows)[block]
        return Blocks(self.weight[entry], row, start, self.shape)

    def num_entries(self) -> Int[np.ndarray, " P"]:
        """Of each block."""
        return np.diff(self.start[:: self.shape[1]])

    def times(self, matrices: np.ndarray) -> np.ndarray:
        """Products with [P, columns, K]: [P, rows, K]."""
        count, columns, width = matrices.shape
        shape = (count * self.shape[0], count * columns)
        whole = scipy.sparse.csc_array((self.weight, self.row, self.start), shape=shape)
        return (whole @ matrices.reshape(-1, width)).reshape(count, -1, width)

    def least(self, slack: np.ndarray) -> np.ndarray:
        """Least of slack [P, rows, 2, K] / weight over entries of columns: [P, columns, 2, K], infinite over none."""
        count, _, _, most = slack.shape
        width = 2 * most
        slack = slack.reshape(-1, width)
        found = np.full((len(self.start) - 1, width), np.inf)
        (filled,) = np.nonzero(np.diff(self.start))
        step = max(1, _MAX_SHARES // max(1, len(self.row)))
        for first in range(0, width if filled.size else 0, step):
            part = slice(first, first + step)
            with np.errstate(over="ignore"):  # what is infinite is no bound
                shares = slack[self.row, part] / self.weight[:, None]
            found[filled, part] = np.minimum.reduceat(shares, self.start[filled], axis=0)
        return found.reshape(count, -1, 2, most)
