"""The linear programs that peers are given: LPAL (eqs. 2-5), and LP (8) and (9), in one form.

LPAL in shares of all discounted time has x, v, alpha and Vhat 1 - gamma times as large, so that x sums to 1; F is the
Bellman flow (`Model.flow`):

    primal   max v                      F x = alpha,   phi_k . x - v >= Vhat_k,   x >= 0,   v free
    dual     min alpha . h - Vhat . w   F^T h - sum_k w_k phi_k >= 0,   sum_k w_k = 1,   w >= 0,   h free

Of the solutions only x and w count, whichever program a solver is given: each is the multiplier of the other's rows.

A soft homomorphism is z = (f, e): min e with the rows of f summing to 1, e - K f >= 0, e + K f >= 0, f >= 0, where
(K f)(i, a, k) = sum_j T(i, a, j) f(j, k) - sum_l f(i, l) T'(l, a, k). The multipliers of the two blocks give the dual
point y = y+ - y- of `jaxhom.similarity.homomorphism_lp`.
"""

import dataclasses
import functools

import numpy as np
import scipy.sparse as sparse

from bench.models import Model


@dataclasses.dataclass(frozen=True)
class LinearProgram:
    """min cost . z,  matrix z = right where `is_equation` and >= right elsewhere,  lower <= z <= upper.

    A bound is 0 or infinite. Programs that follow one another share the arrays that do not change.

    Attributes:
      matrix: CSR [rows, columns].
      cost, lower, upper: [columns].
      right: [rows]. is_equation: bool [rows].
    """

    matrix: sparse.csr_array
    cost: np.ndarray
    right: np.ndarray
    is_equation: np.ndarray
    lower: np.ndarray
    upper: np.ndarray

    @property
    def row_upper(self) -> np.ndarray:
        """Upper bounds of the rows; `right` are the lower ones."""
        return np.where(self.is_equation, self.right, np.inf)


@dataclasses.dataclass(frozen=True)
class Lpal:
    """LPAL on one model, for any Vhat.

    Attributes:
      form: "primal" or "dual".
      shares: whether in shares of all discounted time.
    """

    model: Model
    form: str
    shares: bool

    @functools.cached_property
    def unit(self) -> float:
        """What x, v, alpha and Vhat are multiplied with."""
        return 1.0 - self.model.discount if self.shares else 1.0

    @functools.cached_property
    def base(self) -> LinearProgram:
        """The program for Vhat = 0."""
        model, alpha = self.model, self.unit * self.model.initial
        (num_states, pairs), num_features = model.flow.shape, model.features.shape[1]
        if self.form == "primal":
            minus_v = sparse.csr_array(-np.ones((num_features, 1)))
            matrix = sparse.block_array([[model.flow, None], [model.features.T, minus_v]], format="csr")
            cost, lower = (np.append(np.zeros(pairs), last) for last in (-1.0, -np.inf))
            right, is_equation = (
                np.append(alpha, np.zeros(num_features)),
                np.arange(len(matrix.indptr) - 1) < num_states,
            )
        else:
            ones = sparse.csr_array(np.ones((1, num_features)))
            matrix = sparse.block_array([[model.flow.T, -model.features], [None, ones]], format="csr")
            cost = np.append(alpha, np.zeros(num_features))
            lower = np.append(np.full(num_states, -np.inf), np.zeros(num_features))
            right = np.append(np.zeros(pairs), 1.0)
            is_equation = right == 1.0
        return LinearProgram(matrix, cost, right, is_equation, lower, np.full(len(cost), np.inf))

    def given(self, expectations: np.ndarray) -> LinearProgram:
        """The program for Vhat [K]: its own right-hand side or cost, the rest shared."""
        name, sign = ("right", 1.0) if self.form == "primal" else ("cost", -1.0)
        changed = getattr(self.base, name).copy()
        changed[-len(expectations) :] = sign * self.unit * expectations
        return dataclasses.replace(self.base, **{name: changed})

    def read(self, z: np.ndarray, multipliers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """x [S, A] in shares or not, and w [K], from a solution and the multipliers of its rows (>= 0 for >=)."""
        x, w = (z, multipliers) if self.form == "primal" else (multipliers, z)
        return x[:-1].reshape(self.model.shape), w[-self.model.features.shape[1] :]


class Homomorphisms:
    """LP (8) or (9) for pairs of models (T [n, A, n], T' [m, A, m]) that have zeros in the same places.

    The matrix is linear in the numbers of (T, T', 1), so that a pair costs one sparse product.

    Args:
      source, target: one pair.
      anchored: whether state 0 is mapped to state 0.

    Attributes:
      fill: CSR [entries of the matrix, numbers of (T, T', 1)].
    """

    def __init__(self, source: np.ndarray, target: np.ndarray, anchored: bool):
        self.shape = n, _, m = (*source.shape[:2], len(target))
        num_maps, one = n * m, source.size + target.size + 1
        # At first entries hold which number of (T, T', 1) they are, counted from 1, with its sign.
        number, eye = np.arange(1.0, one), sparse.eye_array
        moved = np.where(source, number[: source.size].reshape(source.shape), 0.0).reshape(-1, n)
        mapped = np.where(target, -number[source.size :].reshape(target.shape), 0.0).transpose(1, 2, 0).reshape(-1, m)
        parts = sparse.kron(moved, eye(m), "coo"), sparse.kron(eye(n), mapped, "coo")
        data, rows, columns = (
            np.concatenate([getattr(part, name) for part in parts]) for name in ("data", "row", "col")
        )
        product = sparse.coo_array((data, (rows, columns)), shape=parts[0].shape)  # two numbers may meet
        sums = sparse.kron(eye(n), np.full((1, m), float(one)))
        e = sparse.coo_array(np.full((product.shape[0], 1), float(one)))
        entries = sparse.block_array([[sums, None], [-product, e], [product, e]], format="coo")
        places, slot = np.unique(entries.row.astype(int) * (num_maps + 1) + entries.col, return_inverse=True)
        from_numbers = np.sign(entries.data), (slot, np.abs(entries.data).astype(int) - 1)
        self.fill = sparse.csr_array(from_numbers, shape=(len(places), one))
        indptr = np.searchsorted(places, np.arange(entries.shape[0] + 1) * (num_maps + 1))
        self._structure = (places % (num_maps + 1)).astype(np.int32), indptr.astype(np.int32)
        upper = np.full(num_maps + 1, np.inf)
        upper[1:m] = 0.0 if anchored else np.inf
        ends = {"lower": np.zeros(num_maps + 1), "upper": upper, "cost": np.append(np.zeros(num_maps), 1.0)}
        right = np.append(np.ones(n), np.zeros(2 * product.shape[0]))
        self._rest = ends | {"right": right, "is_equation": right == 1.0}

    def given(self, pair: tuple[np.ndarray, np.ndarray]) -> LinearProgram:
        """The program of one pair; all but the matrix is shared."""
        numbers = np.concatenate([pair[0].ravel(), pair[1].ravel(), [1.0]])
        return LinearProgram(sparse.csr_array((self.fill @ numbers, *self._structure)), **self._rest)

    def read(self, z: np.ndarray, multipliers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """f [n, m] and y [n, A, m]."""
        n, _, m = self.shape
        plus, minus = np.split(multipliers[n:], 2)
        return z[:-1].reshape(n, m), (plus - minus).reshape(self.shape)


class Conic:
    """The same as A x + s = b with s = 0 in the first rows and s >= 0 in the others, min q . x.

    The first rows are fixed entries of z, then equations; the others are inequalities, then z >= 0 where it is bounded.
    How A's entries follow from the matrix's is found once for all programs that have zeros in the same places.

    Attributes:
      matrix: CSR, A of the program that it was made from. num_zero: its first rows.
      take, sign: A's entries are `sign` times (entries of the matrix, 1) at `take`.
    """

    def __init__(self, lp: LinearProgram):
        self.is_fixed, entries = lp.upper == 0.0, lp.matrix.copy()
        entries.data = np.arange(1.0, entries.nnz + 1.0)
        bound = sparse.eye_array(len(lp.cost), format="csr") * (entries.nnz + 1.0)
        rows = [bound[self.is_fixed], entries[lp.is_equation], -entries[~lp.is_equation]]
        numbers = sparse.vstack([*rows, -bound[(lp.lower == 0.0) & ~self.is_fixed]], format="csr")
        numbers.sort_indices()
        self.take, self.sign = np.abs(numbers.data).astype(int) - 1, np.sign(numbers.data)
        self.num_fixed, self.num_zero = int(self.is_fixed.sum()), int(self.is_fixed.sum() + lp.is_equation.sum())
        self.matrix = numbers
        self.matrix.data = self.values(lp)

    def values(self, lp: LinearProgram) -> np.ndarray:
        """The entries of A."""
        return self.sign * np.append(lp.matrix.data, 1.0)[self.take]

    def right(self, lp: LinearProgram) -> np.ndarray:
        """b."""
        b = np.zeros(self.matrix.shape[0])
        b[self.num_fixed : self.num_zero] = lp.right[lp.is_equation]
        b[self.num_zero : self.num_fixed + len(lp.right)] = -lp.right[~lp.is_equation]
        return b

    def multipliers(self, lp: LinearProgram, y: np.ndarray) -> np.ndarray:
        """Those of the linear program's rows, from the cones' y (q + A^T y = 0)."""
        found, y = np.empty(len(lp.right)), y[self.num_fixed :]
        found[lp.is_equation], found[~lp.is_equation] = np.split(y[: len(found)], [int(lp.is_equation.sum())])
        found[lp.is_equation] *= -1.0
        return found
