"""A primal-dual interior-point method for sparse linear programs over occupancies, one at a time, on the host.

    min c . z + g . f   subject to   A z + B f = b,   z >= 0,   f free,

with A sparse and B a few dense columns. Flow constraints link a state to its successors alone, so the normal matrix
A D A^T of an interior-point step is as sparse as the model's graph: on a grid it is a band about twice as wide as the
grid. Each step (Mehrotra's predictor and corrector, 1992) costs one banded Cholesky factorisation, after reverse
Cuthill-McKee ordering. Rows that share no column with one another (one per state, or one per region) have a diagonal
block in the normal matrix and are eliminated before, which leaves the band as narrow as the flow's own.

Certificates are left to the caller, who knows how to make feasible points of z and of the multipliers.
"""

import chex
import numpy as np
import scipy.linalg
import scipy.sparse
from scipy.sparse.csgraph import reverse_cuthill_mckee

from jaxhom.mdp import MDP

_TO_BOUNDARY = 0.995
_REGULARISATION = 1e-14  # share of each diagonal entry of the normal matrix
_REFINEMENTS = 2  # per solve: as z / s spreads, the factorisation alone loses digits
_PATIENCE = 30  # steps without a smaller error, after which rounding has won


@chex.dataclass(frozen=True)
class InteriorPoint:
    """An iterate.

    Attributes:
      z: [m], positive. f: [q]. y: [n], multipliers of the rows. s: [m], positive, c - A^T y up to a residual.
      error: the largest of z . s and of what the residuals are worth in the objective, see `_error`.
      iterations: steps taken.
    """

    z: np.ndarray
    f: np.ndarray
    y: np.ndarray
    s: np.ndarray
    error: float = np.inf
    iterations: int = 0


def flow_matrix(mdp: MDP) -> scipy.sparse.csr_array:
    """F [S, S A] of the Bellman flow F x = alpha: (F x)(s) = sum_a x(s, a) - gamma sum_{s', a} x(s', a) T(s', a, s)."""
    num_states, num_actions, slots = mdp.next_state.shape
    pair = np.arange(num_states * num_actions)
    probability = np.asarray(mdp.probability, float).ravel()
    entries = (probability, (np.asarray(mdp.next_state).ravel(), np.repeat(pair, slots)))
    inflow = scipy.sparse.csr_array(entries, shape=(num_states, len(pair)))
    outflow = scipy.sparse.csr_array((np.ones(len(pair)), (pair // num_actions, pair)), shape=inflow.shape)
    flow = outflow - float(mdp.discount) * inflow
    flow.eliminate_zeros()
    return flow


class Rows:
    """A and B of a program, and what its normal matrices share: prepared once, for any number of programs.

    Args:
      matrix: sparse A [n, m], every row with an entry.
      free_columns: B [n, q].
      num_core: rows from this number on are eliminated before the others are factorised. They must not share columns
        with one another; if they do, all rows are factorised together.
    """

    def __init__(self, matrix, free_columns: np.ndarray, num_core: int):
        self.matrix, self.free_columns = scipy.sparse.csr_array(matrix), free_columns
        self.transpose = self.matrix.T.tocsr()
        extra = self.matrix[num_core:]
        shared = (abs(extra) @ abs(extra).T).tocoo()
        self.num_core = num_core if (shared.row == shared.col).all() else self.matrix.shape[0]
        self._core, self._extra = self.matrix[: self.num_core], self.matrix[self.num_core :]
        self._square = self._extra.multiply(self._extra).tocsr()
        pattern = self._schur(abs(self._core), -abs(self._extra), np.ones(self.matrix.shape[1]))[0]
        self._order = reverse_cuthill_mckee(pattern.tocsr(), symmetric_mode=True)
        self._place = np.argsort(self._order)
        self.bandwidth = int(np.abs(self._place[pattern.row] - self._place[pattern.col]).max())

    def factor(self, d: np.ndarray) -> None:
        """Factorises A diag(d) A^T bordered by B, for d [m] positive."""
        self._d = d
        schur, self._cross, self._diagonal = self._schur(self._core, self._extra, d)
        row, column = self._place[schur.row], self._place[schur.col]
        lower = row >= column
        band = np.zeros((self.bandwidth + 1, self.num_core))
        band[(row - column)[lower], column[lower]] = schur.data[lower]
        band[0] *= 1.0 + _REGULARISATION
        self._factor = scipy.linalg.cholesky_banded(band, overwrite_ab=True, lower=True, check_finite=False)
        self._behind_free = self._solve_normal(self.free_columns)
        self._free_block = self.free_columns.T @ self._behind_free

    def solve(self, right: np.ndarray, free_right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Solves A D A^T y + B f = right, B^T y = free_right, with iterative refinement."""
        y, f = self._solve_once(right, free_right)
        for _ in range(_REFINEMENTS):
            missing = right - self.matrix @ (self._d * (self.transpose @ y)) - self.free_columns @ f
            more_y, more_f = self._solve_once(missing, free_right - self.free_columns.T @ y)
            y, f = y + more_y, f + more_f
        return y, f

    def _solve_once(self, right, free_right):
        y = self._solve_normal(right)
        f = np.linalg.solve(self._free_block, self.free_columns.T @ y - free_right)
        return y - self._behind_free @ f, f

    def _solve_normal(self, right: np.ndarray) -> np.ndarray:
        """(A D A^T)^-1 right, [n] or [n, q]."""
        core, extra = right[: self.num_core], right[self.num_core :]
        diagonal = self._diagonal.reshape(-1, *(1,) * (right.ndim - 1))
        reduced = core - self._cross @ (extra / diagonal)
        y = np.empty_like(core)
        factor = (self._factor, True)
        y[self._order] = scipy.linalg.cho_solve_banded(factor, reduced[self._order], check_finite=False)
        return np.concatenate([y, (extra - self._cross.T @ y) / diagonal])

    def _schur(self, core, extra, d):
        """Normal matrix of the core rows after elimination of the extra ones; the cross block; the extra diagonal."""
        scaled = core * d
        cross, diagonal = scaled @ extra.T, self._square @ d
        schur = scaled @ core.T - (cross / diagonal) @ cross.T
        return schur.tocoo(), cross, diagonal


def solve(rows: Rows, cost, free_cost, right, *, tolerance: float = 1e-9, max_iterations: int = 100) -> InteriorPoint:
    """Solves one program, or comes as near as rounding allows.

    Args:
      rows: A [n, m] and B [n, q].
      cost: c [m]. free_cost: g [q]. right: b [n].
      tolerance: stop where `InteriorPoint.error` is below it, in units of the objective.
      max_iterations: steps at most.

    Returns:
      The iterate with the least `error`.

    Source: Mehrotra 1992; Wright 1997, chapter 10.
    """
    program = (cost, free_cost, right)
    point = best = _start(rows, *program)
    for iteration in range(max_iterations):
        residuals = _residuals(rows, *program, point)
        point = point.replace(error=_error(residuals, point), iterations=iteration)
        if point.error < best.error:
            best = point
        if best.error <= tolerance or iteration - best.iterations >= _PATIENCE:
            break
        try:
            point = _step(rows, residuals, point)
        except np.linalg.LinAlgError:  # a normal matrix that rounding has made indefinite
            break
    return best


def _start(rows: Rows, cost, free_cost, right) -> InteriorPoint:
    """Mehrotra's start: the least-norm solutions of both sets of equations, pushed into the interior."""
    rows.factor(np.ones(len(cost)))
    y, f = rows.solve(right, np.zeros_like(free_cost))
    z = rows.transpose @ y
    y, _ = rows.solve(rows.matrix @ cost, free_cost)
    s = cost - rows.transpose @ y
    z, s = (v + max(-1.5 * v.min(), 0.0) + 1e-8 for v in (z, s))
    product = 0.5 * (z @ s)
    z, s = z + product / s.sum(), s + product / z.sum()
    return InteriorPoint(z=z, f=f, y=y, s=s)


def _residuals(rows: Rows, cost, free_cost, right, point: InteriorPoint):
    primal = right - rows.matrix @ point.z - rows.free_columns @ point.f
    return primal, cost - rows.transpose @ point.y - point.s, free_cost - rows.free_columns.T @ point.y


def _error(residuals, point: InteriorPoint) -> float:
    """A residual counts with the multiplier, or the variable, that it stands beside: its first-order effect."""
    effects = zip(residuals, (point.y, point.z, point.f), strict=True)
    return float(max(point.z @ point.s, *(np.abs(residual) @ np.abs(beside) for residual, beside in effects)))


def _step(rows: Rows, residuals, point: InteriorPoint) -> InteriorPoint:
    """One predictor and corrector step."""
    z, s = point.z, point.s
    primal, dual, free = residuals
    rows.factor(z / s)

    def direction(complementarity):
        y, f = rows.solve(primal - rows.matrix @ ((complementarity - z * dual) / s), free)
        change = dual - rows.transpose @ y
        return (complementarity - z * change) / s, change, y, f

    dz, ds, _, _ = direction(-z * s)
    target = (z + _length(z, dz) * dz) @ (s + _length(s, ds) * ds)
    centring = (target / (z @ s)) ** 3 * (z @ s) / len(z)
    dz, ds, dy, df = direction(centring - z * s - dz * ds)
    along, across = _length(z, dz, _TO_BOUNDARY), _length(s, ds, _TO_BOUNDARY)
    return point.replace(z=z + along * dz, f=point.f + along * df, s=s + across * ds, y=point.y + across * dy)


def _length(value: np.ndarray, change: np.ndarray, share: float = 1.0) -> float:
    """The longest step up to 1 that leaves `value` positive, times `share` where the boundary is in the way."""
    falling = change < 0
    return min(1.0, share * float(np.min(-value[falling] / change[falling], initial=np.inf)))
