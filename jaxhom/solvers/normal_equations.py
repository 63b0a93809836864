"""Linear systems of interior-point steps over occupancies, on the host.

    [ A D A^T   B ] [ y ]   [ right      ]
    [ B^T       0 ] [ f ] = [ free right ],     D = diag(d), d > 0.

The first rows of A, its core, are flow constraints: they link a state to its successors alone, so their part of A D A^T
is as sparse as the model's graph, on a grid a band about twice as wide as the grid. The other rows (one per feature, or
per state) are eliminated on the side where they cost less. *Before* the core if no two of them share a column: their
part is diagonal, and where each concerns few states the band stays narrow. *After* it otherwise, as a dense border.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import scipy

from jaxhom.solvers.block_tridiagonal import BlockCholesky, order_in_blocks

if TYPE_CHECKING:
    from jaxtyping import Float

REGULARISATION = 1e-14  # share of each diagonal entry of what is factorised
REFINEMENTS = 2  # per solve, at most: as d spreads, the factorisation alone loses digits
ACCURATE = 1e-8  # share of the right-hand side that may be missing
_MIN_BLOCK = 32  # smaller ones are more calls, not less work
_DENSE = 0.2  # share of entries from which on dense products are taken to be faster


class Rows:
    """A and B of a program, and what its linear systems share: prepared once, for any number of programs.

    Args:
      matrix: sparse A [n, m], every row with an entry.
      free_columns: B [n, q], few.
      num_core: rows before this number are flow constraints.

    Attributes:
      matrix, transpose, free_columns: A, A^T, B.
      work: multiplications of one factorisation, about.
    """

    def __init__(self, matrix: scipy.sparse.sparray, free_columns: Float[np.ndarray, "n q"], num_core: int):
        matrix = scipy.sparse.csr_array(matrix)
        self.matrix, self.transpose, self.free_columns = _stored(matrix), _stored(matrix.T), free_columns
        core, others = matrix[:num_core], matrix[num_core:]
        self._normal: _Before | _After = _After(core, others)
        shared = (abs(others) @ abs(others).T).tocoo()
        if (shared.row == shared.col).all():
            before = _Before(core, others)
            self._normal = before if before.work <= self._normal.work else self._normal
        self.work = self._normal.work

    def factor(self, d: Float[np.ndarray, " m"]) -> None:
        """Factorises the system for d [m] positive; `numpy.linalg.LinAlgError` where rounding makes it indefinite."""
        self._d = d
        self._normal.factor(d)
        self._behind_free = self._normal.solve(self.free_columns)
        self._free_block = self.free_columns.T @ self._behind_free

    def solve(
        self, right: Float[np.ndarray, " n"], free_right: Float[np.ndarray, " q"]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " q"]]:
        """(y, f), with iterative refinement."""
        y, f = self._solve_once(right, free_right)
        scale = np.abs(right).max(initial=np.abs(free_right).max(initial=0.0))
        for _ in range(REFINEMENTS):
            missing = right - self.matrix @ (self._d * (self.transpose @ y)) - self.free_columns @ f
            free_missing = free_right - self.free_columns.T @ y
            if max(np.abs(missing).max(), np.abs(free_missing).max(initial=0.0)) <= ACCURATE * scale:
                break
            more_y, more_f = self._solve_once(missing, free_missing)
            y, f = y + more_y, f + more_f
        return y, f

    def _solve_once(self, right, free_right):
        y = self._normal.solve(right)
        f = np.linalg.solve(self._free_block, self.free_columns.T @ y - free_right)
        return y - self._behind_free @ f, f


class _Before:
    """A D A^T with rows that share no column eliminated before the core."""

    def __init__(self, core, others):
        self._core, self._core_transpose = core, core.T.tocsr()
        self._others, self._others_transpose = others, others.T.tocsr()
        self._square = others.multiply(others).tocsr()
        shared = abs(core) @ abs(self._others_transpose)
        self._blocks = order_in_blocks(abs(core) @ abs(self._core_transpose) + shared @ shared.T, _MIN_BLOCK)
        self.work = self._blocks.work

    def factor(self, d: np.ndarray) -> None:
        scaled = self._core * d
        self._cross, self._diagonal = scaled @ self._others_transpose, self._square @ d
        schur = scaled @ self._core_transpose - (self._cross / self._diagonal) @ self._cross.T
        self._factor = BlockCholesky(schur, self._blocks, REGULARISATION)

    def solve(self, right: np.ndarray) -> np.ndarray:
        num_core = len(self._blocks.order)
        core, others = right[:num_core], right[num_core:]
        diagonal = self._diagonal.reshape(-1, *(1,) * (right.ndim - 1))
        y = self._factor.solve(core - self._cross @ (others / diagonal))
        return np.concatenate([y, (others - self._cross.T @ y) / diagonal])


class _After:
    """A D A^T with the other rows as a dense border of the core."""

    def __init__(self, core, others):
        self._blocks = order_in_blocks(abs(core) @ abs(core).T, _MIN_BLOCK)
        self._core, self._core_transpose = _stored(core), _stored(core.T)
        self._others, self._others_transpose = _stored(others), _stored(others.T)
        num_core, num_others = core.shape[0], others.shape[0]
        border = num_core * num_others * (2 * self._blocks.size + num_others) + num_others**3 / 3
        self.work = self._blocks.work + border

    def factor(self, d: np.ndarray) -> None:
        scaled = self._core * d
        self._factor = BlockCholesky(scaled @ self._core_transpose, self._blocks, REGULARISATION)
        half = self._factor.solve_lower(_dense(scaled @ self._others_transpose))
        self._half = half.reshape(-1, half.shape[-1])
        corner = _dense((self._others * d) @ self._others_transpose) - self._half.T @ self._half
        corner[np.diag_indices_from(corner)] *= 1.0 + REGULARISATION
        self._corner = scipy.linalg.cho_factor(corner, lower=True, overwrite_a=True, check_finite=False)

    def solve(self, right: np.ndarray) -> np.ndarray:
        num_core = len(self._blocks.order)
        half = self._factor.solve_lower(right[:num_core])
        others = right[num_core:] - self._half.T @ half.reshape(-1, *right.shape[1:])
        others = scipy.linalg.cho_solve(self._corner, others, check_finite=False)
        core = self._factor.solve_upper(half - (self._half @ others).reshape(half.shape))
        return np.concatenate([core, others])


def _stored(matrix):
    """A matrix as its products are fastest."""
    is_dense = matrix.nnz > _DENSE * matrix.shape[0] * matrix.shape[1]
    return matrix.toarray() if is_dense else matrix.tocsr()


def _dense(matrix) -> np.ndarray:
    return matrix.toarray() if scipy.sparse.issparse(matrix) else matrix
