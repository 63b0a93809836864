"""LPAL (eqs. 2-5) as a sparse linear program and as its dual, from a model's successor arrays, in NumPy alone.

    primal   max v                      F x = alpha,   phi_k . x - v >= Vhat_k,   x >= 0,   v free
    dual     min alpha . h - Vhat . w   F^T h - sum_k w_k phi_k >= 0,   sum_k w_k = 1,   w >= 0,   h free

F is the Bellman flow, (F x)(s) = sum_a x(s, a) - gamma sum_{s', a} x(s', a) T(s', a, s). Of the solutions only x and w
count, whichever program a solver is given: each is the multiplier of the other's rows. In units of shares of all
discounted time, x, v, alpha and Vhat are 1 - gamma times as large, so that x sums to 1.
"""

import dataclasses
import functools

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.csgraph import reverse_cuthill_mckee

_DENSE = 0.25  # share of entries that are not 0
_SCATTERED = 0.1  # mean distance of a state's successors in the best order, as a share of all states
_MIN_SCATTERED = 2000


@dataclasses.dataclass(frozen=True)
class LinearProgram:
    """min cost . z subject to row_lower <= matrix z <= row_upper, z >= lower; `changing` says what follows Vhat.

    Attributes:
      matrix: CSR [rows, columns].
      cost, lower: [columns].
      row_lower, row_upper: [rows].
    """

    matrix: sparse.csr_array
    cost: np.ndarray
    lower: np.ndarray
    row_lower: np.ndarray
    row_upper: np.ndarray


@dataclasses.dataclass(frozen=True)
class Model:
    """What the program needs of a model; small enough to be handed to another process.

    Attributes:
      next_state, probability: [S, A, N].
      features: CSR [S A, K].
      initial: [S].
      discount: number.
    """

    next_state: np.ndarray
    probability: np.ndarray
    features: sparse.csr_array
    initial: np.ndarray
    discount: float

    @classmethod
    def of(cls, mdp) -> "Model":
        """Of a `jaxhom.MDP`."""
        shape = (mdp.num_states * mdp.num_actions, mdp.num_features)
        features = sparse.csr_array(np.asarray(mdp.features, float).reshape(shape))
        arrays = (np.asarray(mdp.next_state), np.asarray(mdp.probability, float))
        return cls(*arrays, features, np.asarray(mdp.initial, float), float(mdp.discount))

    @property
    def num_states(self) -> int:
        """S."""
        return self.probability.shape[0]

    @property
    def num_actions(self) -> int:
        """A."""
        return self.probability.shape[1]

    @property
    def num_features(self) -> int:
        """K."""
        return self.features.shape[1]

    @functools.cached_property
    def transition(self) -> sparse.csr_array:
        """T as CSR [S A, S]."""
        pairs, slots = self.num_states * self.num_actions, self.probability.shape[2]
        indptr = np.arange(0, pairs * slots + 1, slots)
        entries = (self.probability.flatten(), self.next_state.flatten(), indptr)  # copies, which SciPy sorts
        found = sparse.csr_array(entries, shape=(pairs, self.num_states))
        found.sum_duplicates()
        found.eliminate_zeros()
        return found

    @functools.cached_property
    def is_dense(self) -> bool:
        """Whether full matrices are the faster ones."""
        return self.transition.nnz > _DENSE * self.num_states * self.transition.shape[0]

    @functools.cached_property
    def is_scattered(self) -> bool:
        """Whether no order of the states makes a band of the graph, so that sparse factors fill up."""
        if self.num_states <= _MIN_SCATTERED:
            return False
        uniform = np.full((self.num_states, self.num_actions), 1.0 / self.num_actions)
        graph = self.policy_matrix(uniform)
        order = reverse_cuthill_mckee((graph + graph.T).tocsr(), symmetric_mode=True)
        place, graph = np.argsort(order), graph.tocoo()
        distance = np.abs(place[graph.row] - place[graph.col])
        return bool(np.mean(distance) > _SCATTERED * self.num_states)

    @functools.cached_property
    def flow(self) -> sparse.csr_array:
        """F as CSR [S, S A]."""
        pairs = self.num_states * self.num_actions
        outflow = sparse.csr_array((np.ones(pairs), np.arange(pairs) // self.num_actions, np.arange(pairs + 1)))
        return (outflow - self.discount * self.transition).T.tocsr()

    def policy_matrix(self, policy: np.ndarray) -> sparse.csr_array:
        """P of a policy [S, A], CSR [S, S]."""
        pairs = self.num_states * self.num_actions
        indptr = np.arange(0, pairs + 1, self.num_actions)
        averaged = sparse.csr_array((policy.flatten(), np.arange(pairs), indptr), shape=(self.num_states, pairs))
        averaged.eliminate_zeros()
        return averaged @ self.transition


@dataclasses.dataclass(frozen=True)
class Program:
    """The programs of one model: made once, and changed for every Vhat.

    Attributes:
      model: the model.
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
        num_states, pairs, num_features = model.num_states, model.flow.shape[1], model.num_features
        if self.form == "primal":
            minus_v = sparse.csr_array(-np.ones((num_features, 1)))
            matrix = sparse.block_array([[model.flow, None], [model.features.T, minus_v]], format="csr")
            cost = np.append(np.zeros(pairs), -1.0)
            lower = np.append(np.zeros(pairs), -np.inf)
            row_lower = np.concatenate([alpha, np.zeros(num_features)])
            row_upper = np.concatenate([alpha, np.full(num_features, np.inf)])
        else:
            ones = sparse.csr_array(np.ones((1, num_features)))
            matrix = sparse.block_array([[model.flow.T, -model.features], [None, ones]], format="csr")
            cost = np.concatenate([alpha, np.zeros(num_features)])
            lower = np.concatenate([np.full(num_states, -np.inf), np.zeros(num_features)])
            row_lower = np.append(np.zeros(pairs), 1.0)
            row_upper = np.append(np.full(pairs, np.inf), 1.0)
        return LinearProgram(matrix, cost, lower, row_lower, row_upper)

    def given(self, expectations: np.ndarray) -> LinearProgram:
        """The program for Vhat [K]: its own row bounds or cost, the rest shared."""
        num_features, Vhat = self.model.num_features, self.unit * expectations
        if self.form == "primal":
            row_lower = self.base.row_lower.copy()
            row_lower[-num_features:] = Vhat
            return dataclasses.replace(self.base, row_lower=row_lower)
        cost = self.base.cost.copy()
        cost[-num_features:] = -Vhat
        return dataclasses.replace(self.base, cost=cost)

    def read(self, z: np.ndarray, multipliers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """x [S, A] in shares or not, and w [K], from a solution and the multipliers of its rows (>= 0 for >=)."""
        num_features = self.model.num_features
        if self.form == "primal":
            x, w = z[:-1], multipliers[-num_features:]
        else:
            x, w = multipliers[:-1], z[-num_features:]
        return x.reshape(self.model.num_states, self.model.num_actions), w


@dataclasses.dataclass(frozen=True)
class ConicProgram:
    """The same as A z + s = b with s = 0 in the first rows and s >= 0 in the others, min q . z."""

    matrix: sparse.csr_array
    num_zero: int
    order: np.ndarray  # of the linear program's rows among A's; bounds of z follow
    program: Program

    @classmethod
    def of(cls, program: Program) -> "ConicProgram":
        """Equations first, then inequalities, then z >= 0 where it is bounded."""
        base = program.base
        is_equation = base.row_lower == base.row_upper
        order = np.concatenate([np.flatnonzero(is_equation), np.flatnonzero(~is_equation)])
        num_zero = int(is_equation.sum())
        rows = base.matrix[order]
        signs = np.where(np.arange(len(order)) < num_zero, 1.0, -1.0)
        bounded = np.flatnonzero(base.lower == 0.0)
        shape = (len(bounded), base.matrix.shape[1])
        bounds = sparse.csr_array((-np.ones(len(bounded)), (np.arange(len(bounded)), bounded)), shape=shape)
        matrix = sparse.vstack([sparse.diags_array(signs) @ rows, bounds], format="csr")
        matrix.sort_indices()
        return cls(matrix, num_zero, order, program)

    def given(self, expectations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """q and b."""
        lp = self.program.given(expectations)
        b = np.zeros(self.matrix.shape[0])
        b[: len(self.order)] = lp.row_lower[self.order]
        b[self.num_zero : len(self.order)] *= -1.0
        return lp.cost, b

    def read(self, z: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """x and w, from z and the cones' multipliers y (q + A^T y = 0)."""
        multipliers = np.empty(len(self.order))
        multipliers[self.order] = y[: len(self.order)]
        return self.program.read(z, multipliers)
