"""Linear systems of interior-point steps over occupancies, on the host.

    [ A D A^T   B ] [ y ]   [ right      ]
    [ B^T       0 ] [ f ] = [ free right ],     D = diag(d), d > 0.

The first rows of A, its core, are flow constraints: they link a state to its successors alone, so their part of A D A^T
is as sparse as the model's graph, on a grid a band about twice as wide as the grid. The other rows (one per feature, or
per state) are eliminated on the side where they cost less. *Before* the core if no two of them share a column: their
part is diagonal, and where each concerns few states the band stays narrow. *After* it otherwise, as a dense border.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import scipy

from jaxhom.solvers.block_tridiagonal import BlockCholesky, Blocks, order_in_blocks

if TYPE_CHECKING:
    from jaxtyping import Float, Int

REGULARISATION = 1e-14  # share of each diagonal entry of what is factorised
REFINEMENTS = 2  # per solve, at most: as d spreads, the factorisation alone loses digits
ACCURATE = 1e-8  # share of the right-hand side that may be missing
_MIN_BLOCK = 32  # smaller ones are more calls, not less work
_MANY_PRODUCTS = 2e6  # of entries of A: of twice as many (1,000 states, 4 actions, 30 successors of each) finding the
# places takes as long as eight steps with them save
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
        self._normal.prepare()

    def factor(self, d: Float[np.ndarray, " m"]) -> None:
        """Factorises the system for d [m] positive; `numpy.linalg.LinAlgError` where rounding makes it indefinite."""
        self._d = d
        self._normal.factor(d)
        self._behind_free = self._normal.solve(self.free_columns)
        self._free_inverse = np.linalg.inv(self.free_columns.T @ self._behind_free)

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
        f = self._free_inverse @ (self.free_columns.T @ y - free_right)
        return y - self._behind_free @ f, f


class _Before:
    """A D A^T with rows that share no column eliminated before the core."""

    def __init__(self, core, others):
        self._core, self._others = core, others
        shared = abs(core) @ abs(others.T)
        self._blocks = order_in_blocks(abs(core) @ abs(core.T) + shared @ shared.T, _MIN_BLOCK)
        self.work = self._blocks.work

    def prepare(self) -> None:
        """What is the same for every d."""
        core, others, blocks = self._core, self._others, self._blocks
        self._core_product, self._square = _Assembly(core, core, blocks), others.multiply(others).tocsr()
        shape = _Whole(core.shape[0], others.shape[0])
        places, self._cross_sums = _known_products(core, others, shape)
        row, self._column = divmod(places, shape.num_columns)
        self._cross = scipy.sparse.csr_array((np.zeros(len(places)), (row, self._column)), shape=shape)
        self._cross_transpose = self._cross.T  # of the same numbers
        self._first, self._second = _in_one_column(self._column, self._column)
        place = blocks.places(row[self._first], row[self._second])
        is_kept = place >= 0
        self._first, self._second = self._first[is_kept], self._second[is_kept]
        self._places, self._entry = np.unique(place[is_kept], return_inverse=True)

    def factor(self, d: np.ndarray) -> None:
        self._cross.data[:], self._diagonal = self._cross_sums @ d, self._square @ d
        schur, half = self._core_product(d), self._cross.data / np.sqrt(self._diagonal)[self._column]
        behind = np.bincount(self._entry, half[self._first] * half[self._second], len(self._places))
        schur.ravel()[self._places] -= behind
        self._factor = BlockCholesky(schur, self._blocks, REGULARISATION)

    def solve(self, right: np.ndarray) -> np.ndarray:
        num_core = len(self._blocks.order)
        core, others = right[:num_core], right[num_core:]
        diagonal = self._diagonal.reshape(-1, *(1,) * (right.ndim - 1))
        y = self._factor.solve(core - self._cross @ (others / diagonal))
        return np.concatenate([y, (others - self._cross_transpose @ y) / diagonal])


class _After:
    """A D A^T with the other rows as a dense border of the core."""

    def __init__(self, core, others):
        self._blocks = order_in_blocks(abs(core) @ abs(core).T, _MIN_BLOCK)
        self._core, self._others = _stored(core), _stored(others)
        num_core, num_others = core.shape[0], others.shape[0]
        border = num_core * num_others * (2 * self._blocks.size + num_others) + num_others**3 / 3
        self.work = self._blocks.work + border

    def prepare(self) -> None:
        """What is the same for every d."""
        core, others = self._core, self._others
        self._core_product = _Assembly(core, core, self._blocks)
        self._border = _Assembly(core, others, _Whole(core.shape[0], others.shape[0]))
        self._corner_product = _Assembly(others, others, _Whole(others.shape[0], others.shape[0]))

    def factor(self, d: np.ndarray) -> None:
        self._factor = BlockCholesky(self._core_product(d), self._blocks, REGULARISATION)
        half = self._factor.solve_lower(self._border(d))
        self._half = half.reshape(-1, half.shape[-1])
        corner = self._corner_product(d) - self._half.T @ self._half
        corner[np.diag_indices_from(corner)] *= 1.0 + REGULARISATION
        self._corner = scipy.linalg.cho_factor(corner, lower=True, overwrite_a=True, check_finite=False)

    def solve(self, right: np.ndarray) -> np.ndarray:
        num_core = len(self._blocks.order)
        half = self._factor.solve_lower(right[:num_core])
        others = right[num_core:] - self._half.T @ half.reshape(-1, *right.shape[1:])
        others = scipy.linalg.cho_solve(self._corner, others, check_finite=False)
        core = self._factor.solve_upper(half - (self._half @ others).reshape(half.shape))
        return np.concatenate([core, others])


class _Whole(NamedTuple):
    """A matrix as a plain array, made as `Blocks` makes one in blocks."""

    num_rows: int
    num_columns: int

    def places(self, row: Int[np.ndarray, " e"], column: Int[np.ndarray, " e"]) -> Int[np.ndarray, " e"]:
        return row * self.num_columns + column

    def filled(self, places: Int[np.ndarray, " e"], numbers: Float[np.ndarray, " e"]) -> np.ndarray:
        result = np.zeros(self)
        result.ravel()[places] = numbers
        return result

    def cut(self, matrix: scipy.sparse.sparray | np.ndarray) -> np.ndarray:
        return matrix.toarray() if scipy.sparse.issparse(matrix) else matrix


class _Assembly:
    """F D G^T for many D = diag(d) in a layout: by sums of known products where both are sparse and those few."""

    def __init__(
        self,
        first: scipy.sparse.sparray | np.ndarray,
        second: scipy.sparse.sparray | np.ndarray,
        layout: Blocks | _Whole,
    ):
        self._first, self._transpose, self._layout, self._sums = first, second.T, layout, None
        if not (scipy.sparse.issparse(first) and scipy.sparse.issparse(second)):
            return
        self._transpose = second.T.tocsr()
        in_columns = np.diff(first.tocsc().indptr).astype(float) @ np.diff(self._transpose.indptr)
        if in_columns <= _MANY_PRODUCTS:
            self._places, self._sums = _known_products(first, second, layout)

    def __call__(self, d: np.ndarray) -> np.ndarray:
        if self._sums is None:
            return self._layout.cut((self._first * d) @ self._transpose)
        return self._layout.filled(self._places, self._sums @ d)


def _known_products(
    first: scipy.sparse.sparray, second: scipy.sparse.sparray, layout: Blocks | _Whole
) -> tuple[Int[np.ndarray, " e"], scipy.sparse.csr_array]:
    """The places in a layout where F D G^T is not 0 for every D = diag(d), ascending, and P: it is P d there."""
    f, g = first.tocoo(), second.tocoo()
    of_first, of_second = _in_one_column(f.col, g.col)
    place = layout.places(f.row[of_first].astype(np.int64), g.row[of_second])
    is_kept = place >= 0
    of_first, of_second = of_first[is_kept], of_second[is_kept]
    places, entry = np.unique(place[is_kept], return_inverse=True)
    products = f.data[of_first] * g.data[of_second]
    return places, scipy.sparse.csr_array((products, (entry, f.col[of_first])), shape=(len(places), f.shape[1]))


def _in_one_column(
    first: Int[np.ndarray, " m"], second: Int[np.ndarray, " n"]
) -> tuple[Int[np.ndarray, " e"], Int[np.ndarray, " e"]]:
    """All pairs of an entry of one matrix and one of another, given their columns, that stand in the same."""
    count = np.bincount(second, minlength=max(first.max(initial=-1), second.max(initial=-1)) + 1)
    begin, partners = np.cumsum(count) - count, count[first]
    of_first = np.repeat(np.arange(len(first)), partners)
    number = np.arange(len(of_first)) - np.repeat(np.cumsum(partners) - partners, partners)
    return of_first, np.argsort(second, kind="stable")[begin[first[of_first]] + number]


def _stored(matrix):
    """A matrix as its products are fastest."""
    is_dense = matrix.nnz > _DENSE * matrix.shape[0] * matrix.shape[1]
    return matrix.toarray() if is_dense else matrix.tocsr()
