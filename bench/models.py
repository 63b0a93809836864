"""What a peer needs of a model: its arrays in NumPy and SciPy, small enough to be handed to another process."""

import dataclasses
import functools
import itertools

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.csgraph import reverse_cuthill_mckee
from scipy.sparse.linalg import gmres, splu

_DENSE = 0.25  # share of entries that are not 0, from which on a full matrix takes less time than its sparse factors
# Mean distance of a state's successors in the best order, as a share of all states: 0.02 on a 48 x 48 grid, 0.06 on
# racetrack (a), 0.32 for random successors.
_SCATTERED = 0.1
_MIN_SCATTERED = 2000  # states; smaller factors are cheap even if they fill up
_GMRES = 1e-12
_MAX_RESIDUAL = 1e-11  # relative; a thousandth of the smallest error that rows ask for
_TOO_LARGE = 300_000  # states, from which factors are given up for sweeps: grid316 has 99,856, grid1000 ten times more
_SWEEPS, _MAX_SWEEPS = 300, 3000  # the first leave a twentieth of the error at a discount of 0.99
_MAX_IMPROVEMENTS = 100  # of policy iteration
_ROUNDINGS = 64.0  # of the largest value, that a bound may miss


@dataclasses.dataclass(frozen=True)
class Model:
    """A model's arrays.

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
    def shape(self) -> tuple[int, int]:
        """S and A."""
        return self.probability.shape[:2]

    @functools.cached_property
    def transition(self) -> sparse.csr_array:
        """T as CSR [S A, S]."""
        indptr = np.arange(0, self.probability.size + 1, self.probability.shape[2])
        entries = (self.probability.flatten(), self.next_state.flatten(), indptr)  # copies, which SciPy sorts
        found = sparse.csr_array(entries, shape=(len(indptr) - 1, self.shape[0]))
        found.sum_duplicates()
        found.eliminate_zeros()
        return found

    @functools.cached_property
    def is_dense(self) -> bool:
        """Whether full matrices are the faster ones."""
        return self.transition.nnz > _DENSE * np.prod(self.transition.shape)

    @functools.cached_property
    def is_scattered(self) -> bool:
        """Whether no order of the states makes a band of the graph, so that sparse factors fill up."""
        if self.shape[0] <= _MIN_SCATTERED:
            return False
        graph = self.policy_matrix(np.full(self.shape, 1.0 / self.shape[1]))
        order = reverse_cuthill_mckee((graph + graph.T).tocsr(), symmetric_mode=True)
        place, graph = np.argsort(order), graph.tocoo()
        distance = np.abs(place[graph.row] - place[graph.col])
        return bool(np.mean(distance) > _SCATTERED * self.shape[0])

    @functools.cached_property
    def flow(self) -> sparse.csr_array:
        """The Bellman flow as CSR [S, S A]: (F x)(s) = sum_a x(s, a) - gamma sum_{s', a} x(s', a) T(s', a, s)."""
        pairs = np.arange(np.prod(self.shape) + 1)
        outflow = sparse.csr_array((np.ones(len(pairs) - 1), pairs[:-1] // self.shape[1], pairs))
        return (outflow - self.discount * self.transition).T.tocsr()

    def policy_matrix(self, policy: np.ndarray) -> sparse.csr_array:
        """P of a policy [S, A], CSR [S, S]."""
        # Two index arrays: zeros are eliminated in place.
        places, starts = np.arange(policy.size), np.arange(0, policy.size + 1, self.shape[1])
        averaged = sparse.csr_array((policy.flatten(), places, starts))
        averaged.eliminate_zeros()
        return averaged @ self.transition

    def policy_system(self, policy: np.ndarray, transpose: bool) -> sparse.csc_array:
        """I - discount P, or its transpose, CSC."""
        return self._system(self.policy_matrix(policy), transpose)

    def _system(self, chain: sparse.csr_array, transpose: bool) -> sparse.csc_array:
        system = sparse.eye_array(self.shape[0]) - self.discount * chain
        return (system.T if transpose else system).tocsc()

    def policy_solve(self, policy: np.ndarray, right: np.ndarray, transpose: bool) -> np.ndarray:
        """Solves (I - discount P) z = right, or the transposed system, by none of this library's solvers.

        By a sparse LU factorisation; only where its factors would fill up GMRES stands in, its residual checked.
        """
        return self._solve(self.policy_matrix(policy), right, transpose)

    def _solve(self, chain: sparse.csr_array, right: np.ndarray, transpose: bool) -> np.ndarray:
        """`policy_solve` for P, CSR [S, S]."""
        system = self._system(chain, transpose)
        if self.is_dense:
            return np.linalg.solve(system.toarray(), right)
        if self.is_scattered:
            found = np.zeros_like(right)
            for _ in range(2):  # the second refines
                found = found + gmres(system, right - system @ found, rtol=_GMRES, restart=50, maxiter=20)[0]
            if np.abs(right - system @ found).max() <= _MAX_RESIDUAL * np.abs(right).max():
                return found
        factors = splu(system, permc_spec="MMD_AT_PLUS_A")  # the fastest ordering on grids
        found = factors.solve(right)
        return found + factors.solve(right - system @ found)

    def policy_value(self, policy: np.ndarray, reward: np.ndarray) -> np.ndarray:
        """V [S] of a policy for a reward, both [S, A]."""
        return self.policy_solve(policy, (policy * reward).sum(axis=1), transpose=False)

    def occupancy(self, policy: np.ndarray) -> np.ndarray:
        """x [S, A] of a policy [S, A]."""
        return self.policy_solve(policy, self.initial, transpose=True)[:, None] * policy

    def most_value(self, reward: np.ndarray, enough: float) -> tuple[float, np.ndarray]:
        """What no policy is worth more than for a reward [S, A], the best one about `enough` less; and actions [S].

        By sweeps of value iteration, and from there by policy iteration with factors. For any V with
        b = max_a (r + gamma T V) - V no policy is worth more than V + max_s b / (1 - gamma): that is what is returned.
        """
        states, time = np.arange(self.shape[0]), 1.0 / (1.0 - self.discount)
        value, best = np.full(len(states), reward.max() * time), np.inf
        rounding = _ROUNDINGS * np.finfo(float).eps * np.abs(reward).max() * time**2
        is_large = len(states) > _TOO_LARGE
        for step in itertools.count():
            action_value = reward + self.discount * (self.transition @ value).reshape(self.shape)
            actions = action_value.argmax(axis=1)
            top = action_value[states, actions]
            gain = top - value
            best = min(best, float(self.initial @ value) + max(gain.max(), 0.0) * time + rounding)
            # An optimal policy is worth V + min_s b / (1 - gamma) at least.
            is_close = best - float(self.initial @ value) - gain.min() * time <= enough + rounding
            if is_close or step >= (_MAX_SWEEPS if is_large else _SWEEPS + _MAX_IMPROVEMENTS):
                return best, actions
            if is_large or step < _SWEEPS:
                value = top
            else:
                chosen = self.transition[states * self.shape[1] + actions]
                value = self._solve(chosen, reward[states, actions], transpose=False)

    def least_expectations(self, policy: np.ndarray, enough: float) -> np.ndarray:
        """Feature expectations [K] of a policy [S, A], less what an unsolved flow may hide: about `enough`.

        For any mu with x = mu pi and r = alpha + gamma T^T x - mu they differ from phi . x by at most
        |r|_1 max |phi| / (1 - gamma).
        """
        size, time = abs(self.features).max(), 1.0 / (1.0 - self.discount)
        if self.shape[0] > _TOO_LARGE:
            moves = (self.discount * self.policy_matrix(policy)).T.tocsr()
            mu = self.initial * time
            for _ in range(_MAX_SWEEPS):
                arrived = self.initial + moves @ mu
                missing, mu = np.abs(arrived - mu).sum(), arrived
                if missing * size * time <= enough:
                    break
        else:
            mu = np.maximum(self.policy_solve(policy, self.initial, transpose=True), 0.0)
        x = (mu[:, None] * policy).ravel()
        missing = np.abs(self.initial + self.discount * (self.transition.T @ x) - mu).sum()
        rounding = _ROUNDINGS * np.finfo(float).eps * size * time
        return self.features.T @ x - missing * size * time - rounding
