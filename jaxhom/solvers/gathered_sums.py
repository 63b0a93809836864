"""Products with sparse matrices for a batch of vectors, as sums of gathered entries.

    y_i = sum_r c_ir x_{j_ir},      x [lanes, n], y [lanes, m].

The rows of the matrix are padded to one width, which a CPU walks through several times as fast as it adds entries one
by one to where they belong. A row longer than the width is cut into pieces, and the pieces are summed by another, much
smaller matrix of the same kind: what padding costs is bounded, however uneven the rows are.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import numpy as np
import scipy.sparse

from jaxhom.status import Record

if TYPE_CHECKING:
    from jaxtyping import Array, Float, Int

_WIDTHS = (1, 2, 4, 5, 6, 8, 12, 16, 20, 32)  # to be tried


class GatheredSums(Record):
    """A sparse matrix [m, n], for products with rows of vectors.

    Attributes:
      index: int32, one array [width, pieces] per level: where the entries of each piece of a row are gathered.
      coefficient: likewise, what they are multiplied by; 0 on padding.
    """

    index: tuple[Int[Array, "width pieces"], ...]
    coefficient: tuple[Float[Array, "width pieces"], ...]

    @classmethod
    def of(cls, matrix: scipy.sparse.sparray) -> GatheredSums:
        """Prepares a concrete matrix, on the host."""
        matrix = scipy.sparse.csr_array(matrix)
        index, coefficient = [], []
        while True:
            width, first = _cut(np.diff(matrix.indptr))
            index.append(_padded(matrix.indices, matrix.indptr, width, first))
            coefficient.append(_padded(matrix.data, matrix.indptr, width, first))
            if first[-1] == len(first) - 1:  # a piece per row
                return cls(index=tuple(index), coefficient=tuple(coefficient))
            ones = np.ones(first[-1])
            matrix = scipy.sparse.csr_array((ones, np.arange(first[-1]), first), shape=(len(first) - 1, first[-1]))

    def times(self, x: Float[Array, "lanes n"]) -> Float[Array, "lanes m"]:
        """The products with every row of x."""
        for index, coefficient in zip(self.index, self.coefficient, strict=True):
            total = 0.0
            for where, share in zip(index, coefficient, strict=True):
                total = total + share * x.at[:, where].get(mode="promise_in_bounds")
            x = jax.numpy.asarray(total)
        return x


def _cut(lengths: np.ndarray) -> tuple[int, np.ndarray]:
    """The width that makes the fewest entries, padding and later levels included, and the first piece of each row."""

    def pieces(width):
        return np.maximum(1, -(-lengths // width))

    def entries(width):
        cut = pieces(width)
        return width * cut.sum() + (cut.max() > 1) * 2 * cut.sum()

    longest = max(1, lengths.max(initial=0))
    width = int(min((w for w in {*_WIDTHS, int(min(longest, _WIDTHS[-1]))} if w <= longest), key=entries))
    return width, np.append(0, np.cumsum(pieces(width)))


def _padded(values: np.ndarray, starts: np.ndarray, width: int, first: np.ndarray) -> np.ndarray:
    """The rows' values [width, pieces], 0 where there are none."""
    padded = np.zeros((first[-1], width), np.int32 if values.dtype.kind == "i" else np.float64)
    lengths = np.diff(starts)
    row = np.repeat(np.arange(len(lengths)), lengths)
    within = np.arange(len(values)) - starts[row]
    padded[first[row] + within // width, within % width] = values
    return np.ascontiguousarray(padded.T)
