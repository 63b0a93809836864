"""Planning by MDP toolboxes, and occupancies and values of policies by SciPy and NumPy; all from a `Model`'s arrays.

Each is a class of the protocol of `bench.processes`, made from the work, the algorithm, a `Model` and what is given by
keyword. A lane is a reward and a policy, both [S, A]; answers are policies as actions [S], occupancies [S, A] or values
[S].
"""

import importlib.util

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from bench.models import Model
from bench.processes import timed

_MAX_ITERATIONS = 1_000_000  # more than any instance needs
_MAX_STEPS = {"policy_iteration": 1000, "modified_policy_iteration": 100}  # of mdptoolbox; more than it needs
_MAX_DENSE_STATES = 6000  # 300 MB


class MdpToolbox:
    """mdptoolbox-hiive."""

    def __init__(self, work: str, algorithm: str, model: Model, *, tolerance: float, **_):
        import hiive.mdptoolbox.mdp as toolbox

        del work
        rows = np.arange(model.shape[0]) * model.shape[1]
        parts = [model.transition[rows + a] for a in range(model.shape[1])]
        self._parts = [part.toarray() if model.is_dense else scipy.sparse.csr_matrix(part) for part in parts]
        self._discount, self._steps = model.discount, _MAX_STEPS.get(algorithm, _MAX_ITERATIONS)
        self._options = {"skip_check": True, "max_iter": self._steps, "epsilon": tolerance}
        names = {"value_iteration": "ValueIteration", "modified_policy_iteration": "PolicyIterationModified"}
        self._solver = getattr(toolbox, names.get(algorithm, "PolicyIteration"))
        if algorithm == "policy_iteration":
            del self._options["epsilon"]
            self._options["eval_type"] = 0 if model.is_dense else 1  # its direct evaluation knows dense matrices only

    def load(self, lanes: list) -> None:
        ((reward, _),) = lanes
        self._ready = self._solver(self._parts, reward, self._discount, **self._options)
        self._ready.max_iter = self._steps  # it makes a bound of its own, too small if epsilon is

    def solve(self, limit: float) -> list:
        del limit
        self._ready.run()
        return [(np.asarray(self._ready.policy), "", int(self._ready.iter))]


class MdpSolver:
    """mdpsolver, on one thread or more, whichever is faster on the first reward."""

    def __init__(self, work: str, algorithm: str, model: Model, *, tolerance: float, threads: int, **_):
        import mdpsolver

        del work
        name = {"value_iteration": "vi", "policy_iteration": "pi", "modified_policy_iteration": "mpi"}[algorithm]
        self._options = {"algorithm": name, "tolerance": tolerance, "makeFinalCheck": False}
        self._model, self._parallel = mdpsolver.model, None if threads > 1 else False
        lists = {"tranMatProbs": model.transition.data, "tranMatColumns": model.transition.indices}
        self._arguments = {name: _nested(model, array) for name, array in lists.items()} | {"discount": model.discount}

    def load(self, lanes: list) -> None:
        ((reward, _),) = lanes
        if self._parallel is None:
            seconds = {parallel: self._seconds(reward, parallel) for parallel in (True, False)}
            self._parallel = min(seconds, key=seconds.get)
        self._ready = self._model()
        self._ready.mdp(rewards=reward.tolist(), **self._arguments)

    def _seconds(self, reward: np.ndarray, parallel: bool) -> float:
        self._ready = self._model()
        self._ready.mdp(rewards=reward.tolist(), **self._arguments)
        _, seconds, _ = timed(lambda: self._ready.solve(**self._options, parallel=parallel), 0)
        return seconds

    def solve(self, limit: float) -> list:
        del limit
        self._ready.solve(**self._options, parallel=self._parallel)
        return [(np.asarray(self._ready.getPolicy()), "", 0)]


def _nested(model: Model, entries: np.ndarray) -> list:
    """A CSR array of the transitions as lists [S][A][successors]."""
    rows = [row.tolist() for row in np.split(entries, model.transition.indptr[1:-1])]
    return [rows[first : first + model.shape[1]] for first in range(0, len(rows), model.shape[1])]


class QuantEcon:
    """QuantEcon's DiscreteDP, on full or on sparse matrices."""

    def __init__(self, work: str, algorithm: str, model: Model, *, tolerance: float, **_):
        from quantecon.markov import DiscreteDP

        del work
        self._problem, self._discount, self._is_dense = DiscreteDP, model.discount, model.is_dense
        self._options = {"method": algorithm, "epsilon": tolerance, "max_iter": _MAX_ITERATIONS}
        if model.is_dense:
            self._transition, self._pairs = model.transition.toarray().reshape(*model.shape, -1), ()
        else:
            self._transition = scipy.sparse.csr_matrix(model.transition)
            self._pairs = tuple(index.ravel() for index in np.indices(model.shape))

    def load(self, lanes: list) -> None:
        ((reward, _),) = lanes
        reward = reward if self._is_dense else reward.ravel()
        self._ready = self._problem(reward, self._transition, self._discount, *self._pairs)

    def solve(self, limit: float) -> list:
        del limit
        found = self._ready.solve(**self._options)
        return [(np.asarray(found.sigma), "", int(found.num_iter))]


class LinearSolver:
    """Occupancies and values by one linear solve: of SciPy's sparse ones, or of NumPy's."""

    def __init__(self, work: str, algorithm: str, model: Model, **_):
        self._work, self._algorithm, self._model = work, algorithm, model
        model.transition  # noqa: B018  (made once)

    def load(self, lanes: list) -> None:
        (self._lane,) = lanes

    def solve(self, limit: float) -> list:
        del limit
        reward, policy = self._lane
        is_occupancy = self._work == "occupancy"
        right = self._model.initial if is_occupancy else (policy * reward).sum(axis=1)
        found = self._linear_solve(self._model.policy_system(policy, transpose=is_occupancy), right)
        return [(found[:, None] * policy if is_occupancy else found, "", 0)]

    def _linear_solve(self, system, right: np.ndarray) -> np.ndarray:
        if self._algorithm == "spsolve":
            return scipy.sparse.linalg.spsolve(system, right)
        if self._algorithm == "splu":  # the fastest ordering on grids
            return scipy.sparse.linalg.splu(system, permc_spec="MMD_AT_PLUS_A").solve(right)
        return np.linalg.solve(system.toarray(), right)


_LIBRARIES = {
    "mdptoolbox": ("hiive", MdpToolbox),
    "mdpsolver": ("mdpsolver", MdpSolver),
    "quantecon": ("quantecon", QuantEcon),
    "scipy": ("scipy", LinearSolver),
    "numpy": ("numpy", LinearSolver),
}
_PLANNERS = ("mdptoolbox", "mdpsolver", "quantecon")
_ALGORITHMS = ("value_iteration", "policy_iteration", "modified_policy_iteration")
PLANNERS = tuple(f"{library} {algorithm}" for library in _PLANNERS for algorithm in _ALGORITHMS)
SOLVERS = ("scipy spsolve", "scipy splu", "numpy solve")


def package(method: str) -> str:
    """The package behind a method."""
    return _LIBRARIES[method.split()[0]][0]


def is_installed(method: str) -> bool:
    """Whether it can be imported."""
    return importlib.util.find_spec(package(method)) is not None


def can_solve(method: str, model: Model) -> bool:
    """Whether a full matrix would fit, where one is needed."""
    return method != "numpy solve" or model.shape[0] <= _MAX_DENSE_STATES


def opened(method: str, work: str, model: Model, **options):
    """A method's solver."""
    library, algorithm = method.split()
    return _LIBRARIES[library][1](work, algorithm, model, **options)
