"""Cholesky factors of sparse symmetric matrices whose graph is a narrow band, in blocks as wide as the band.

On the host. The normal matrices of Bellman flow constraints are such: they link states that share a successor or follow
one another, on grids a band about twice as wide as the grid. Dense blocks make a factorisation a few dozen calls of
matrix products, the fastest that a CPU does.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np
import scipy

if TYPE_CHECKING:
    from jaxtyping import Float, Int

_MIN_BLOCKS = 4  # fewer, and one block is faster


@dataclasses.dataclass(frozen=True)
class Blocks:
    """An order of the unknowns in which a matrix is block tridiagonal.

    Attributes:
      order: [n], the unknowns in their new order. place: [n], its inverse.
      size: of a block; the last one is filled up with the identity.
    """

    order: Int[np.ndarray, " n"]
    place: Int[np.ndarray, " n"]
    size: int

    @property
    def count(self) -> int:
        """Number of blocks."""
        return -(-len(self.order) // self.size)

    def rounded(self) -> Blocks:
        """With blocks of one of four sizes per power of two: the matrices of maps of one size then share programs."""
        step = max(1, (1 << (self.size.bit_length() - 1)) // 4)
        return dataclasses.replace(self, size=min(-(-self.size // step) * step, len(self.order)))

    @property
    def work(self) -> float:
        """Multiplications of a factorisation, to compare orders by."""
        return float(self.count) * self.size**3

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Of a matrix in blocks: those on the diagonal first, then those left of it."""
        return 2, self.count, self.size, self.size

    def places(self, row: Int[np.ndarray, " e"], column: Int[np.ndarray, " e"]) -> Int[np.ndarray, " e"]:
        """Where entries of a matrix lie in its blocks, raveled; -1 right of the diagonal's blocks."""
        (i, k), (j, m) = divmod(self.place[row], self.size), divmod(self.place[column], self.size)
        return np.where(i >= j, (((i - j) * self.count + i) * self.size + k) * self.size + m, -1)

    def filled(
        self, places: Int[np.ndarray, " e"], numbers: Float[np.ndarray, " e"]
    ) -> Float[np.ndarray, "2 count size size"]:
        """A matrix in blocks, with numbers in their places, the last block filled up with the identity."""
        result = np.zeros(self.shape)
        result.ravel()[places] = numbers
        filling = np.arange(len(self.order) - (self.count - 1) * self.size, self.size)
        result[0, -1, filling, filling] = 1.0
        return result

    def cut(self, matrix: scipy.sparse.sparray | np.ndarray) -> Float[np.ndarray, "2 count size size"]:
        """A symmetric matrix [n, n], sparse or dense, in blocks."""
        entries = scipy.sparse.coo_array(matrix)
        places = self.places(entries.row, entries.col)
        is_kept = places >= 0
        return self.filled(places[is_kept], entries.data[is_kept])


def order_in_blocks(pattern: scipy.sparse.sparray | np.ndarray, min_size: int = 1) -> Blocks:
    """Reverse Cuthill-McKee order of a symmetric sparse matrix [n, n]; one block where its band is not narrow.

    Args:
      pattern: the matrix, or another with the same entries that are not 0.
      min_size: of a block: smaller ones are more calls, not less work.
    """
    pattern = scipy.sparse.csr_array(pattern)
    order = scipy.sparse.csgraph.reverse_cuthill_mckee(pattern, symmetric_mode=True)
    place, entries = np.argsort(order), pattern.tocoo()
    width = int(np.abs(place[entries.row] - place[entries.col]).max())
    size = max(width, min_size)
    if _MIN_BLOCKS * size > len(order):
        order = place = np.arange(len(order))
        size = len(order)
    return Blocks(order=order, place=place, size=size)


class BlockCholesky:
    """L L^T = N in the order of `blocks`.

    Block row i of L is (..., `left[i]`, inverse of `inverse[i]`), the inverse triangular factors being what solves use.

    Args:
      matrix: N, symmetric positive definite, in blocks (`Blocks.cut`); the factor takes its place.
      blocks: its order.
      regularisation: share by which each entry of the diagonal is made larger.

    Raises:
      numpy.linalg.LinAlgError: if the matrix is not positive definite in floating point.
    """

    def __init__(self, matrix: Float[np.ndarray, "2 count size size"], blocks: Blocks, regularisation: float = 0.0):
        self.blocks = blocks
        diagonal, self.left = matrix
        corners = np.arange(blocks.size)
        diagonal[:, corners, corners] *= 1.0 + regularisation
        self.inverse = np.empty_like(diagonal)
        for i, block in enumerate(diagonal):
            if i:
                self.left[i] = self.left[i] @ self.inverse[i - 1].T
                block -= self.left[i] @ self.left[i].T
            self.inverse[i] = _inverse_factor(block)

    def unit_factor(self) -> tuple[Float[np.ndarray, "count size size"], Float[np.ndarray, "count size size"]]:
        """Blocks [count, size, size] left of the unit diagonal of U, and inverses of those of C, in U C U^T = N."""
        left = self.left.copy()
        left[1:] = left[1:] @ self.inverse[:-1]
        return left, self.inverse.transpose(0, 2, 1) @ self.inverse

    def solve(self, right: Float[np.ndarray, "n *q"]) -> Float[np.ndarray, "n *q"]:
        """N^-1 right, for right [n] or [n, q]."""
        return self.solve_upper(self.solve_lower(right))

    def solve_lower(self, right: Float[np.ndarray, "n *q"]) -> Float[np.ndarray, "count size *q"]:
        """L^-1 right in the new order, filled up to whole blocks: [n] -> [count, size], [n, q] -> [count, size, q]."""
        blocks = self.blocks
        padded = np.zeros((blocks.count * blocks.size, *right.shape[1:]))
        padded[: len(blocks.order)] = right[blocks.order]
        parts = padded.reshape(blocks.count, blocks.size, *right.shape[1:])
        for i in range(blocks.count):
            known = parts[i] - self.left[i] @ parts[i - 1] if i else parts[i]
            parts[i] = self.inverse[i] @ known
        return parts

    def solve_upper(self, parts: Float[np.ndarray, "count size *q"]) -> Float[np.ndarray, "n *q"]:
        """L^-T of what `solve_lower` returns, in the old order."""
        blocks, found = self.blocks, np.empty_like(parts)
        for i in reversed(range(blocks.count)):
            known = parts[i] - self.left[i + 1].T @ found[i + 1] if i + 1 < blocks.count else parts[i]
            found[i] = self.inverse[i].T @ known
        return found.reshape(-1, *parts.shape[2:])[blocks.place]


def _inverse_factor(matrix: np.ndarray) -> np.ndarray:
    """L^-1 of L L^T = matrix [n, n]."""
    factor, failed = scipy.linalg.lapack.dpotrf(matrix.T, lower=1, overwrite_a=1)
    if failed:
        raise np.linalg.LinAlgError(f"leading minor {failed} of a block is not positive definite")
    inverse, failed = scipy.linalg.lapack.dtrtri(factor, lower=1, overwrite_c=1)
    if failed:
        raise np.linalg.LinAlgError(f"diagonal entry {failed} of a block's factor is 0")
    return inverse
