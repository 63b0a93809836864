"""Planning by MDP toolboxes, and occupancies and values of policies by SciPy and NumPy; all from a `Model`'s arrays.

Run in a process of its own by `bench.limits`. What a toolbox derives from the model alone is not timed.
"""

import dataclasses
import importlib.util
import statistics
import time
from collections.abc import Callable

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from bench.lpal_program import Model

PLANNERS = {
    "mdptoolbox value_iteration": "hiive",
    "mdptoolbox policy_iteration": "hiive",
    "mdptoolbox modified_policy_iteration": "hiive",
    "mdpsolver value_iteration": "mdpsolver",
    "mdpsolver policy_iteration": "mdpsolver",
    "mdpsolver modified_policy_iteration": "mdpsolver",
    "quantecon value_iteration": "quantecon",
    "quantecon policy_iteration": "quantecon",
    "quantecon modified_policy_iteration": "quantecon",
}
SOLVERS = ("scipy spsolve", "scipy splu", "numpy solve")
LEAST_TOLERANCE = 1e-10  # times the largest value
_MAX_ITERATIONS = 1_000_000
_MAX_DENSE_STATES = 6000
_REPEATS = 4
_ENOUGH_SECONDS = 0.5  # of one lane's repetitions
_SHARE_OF_WARM_UP = 0.1  # of the time limit, that a first solve may take to count as a warm-up


@dataclasses.dataclass(frozen=True)
class Results:
    """What a process found for its lanes.

    Attributes:
      found: [lanes, ...], policies as actions [S], occupancies [S, A] or values [S].
      seconds: per lane. build_s: of what depends on the model alone. compile_s: first call beyond the second.
      iterations: per lane, where they are known.
    """

    found: list
    seconds: list[float]
    build_s: float
    compile_s: float
    iterations: list[int]


def is_installed(method: str) -> bool:
    """Whether the module behind a method can be imported."""
    return method in SOLVERS or importlib.util.find_spec(PLANNERS[method]) is not None


# ---------------------------------------------------------------------------------------------------------- planners


def _mdptoolbox(algorithm: str, model: Model, epsilon: float, threads: int) -> Callable:
    import hiive.mdptoolbox.mdp as toolbox

    num_states, num_actions = model.num_states, model.num_actions
    rows = np.arange(num_states) * num_actions
    parts = [model.transition[rows + a] for a in range(num_actions)]
    transitions = [part.toarray() if model.is_dense else scipy.sparse.csr_matrix(part) for part in parts]

    def prepare(reward):
        shared = (transitions, reward, model.discount)
        if algorithm == "value_iteration":
            solver = toolbox.ValueIteration(*shared, epsilon=epsilon, max_iter=_MAX_ITERATIONS, skip_check=True)
            solver.max_iter = _MAX_ITERATIONS  # it makes a bound of its own, too small if epsilon is
        elif algorithm == "policy_iteration":
            # Its direct evaluation knows dense matrices only.
            solver = toolbox.PolicyIteration(
                *shared, max_iter=1000, eval_type=0 if model.is_dense else 1, skip_check=True
            )
        else:
            solver = toolbox.PolicyIterationModified(*shared, epsilon=epsilon, max_iter=100, skip_check=True)

        def solve():
            solver.run()
            return np.asarray(solver.policy), solver.iter

        return solve

    return prepare


def _mdpsolver(algorithm: str, model: Model, epsilon: float, threads: int) -> Callable:
    import mdpsolver

    name = {"value_iteration": "vi", "policy_iteration": "pi", "modified_policy_iteration": "mpi"}[algorithm]
    choice: list[bool] = []  # whether threads pay, tried on the first reward
    probabilities, columns = (_nested(model, array) for array in (model.transition.data, model.transition.indices))

    def prepare(reward):
        solver = mdpsolver.model()
        solver.mdp(discount=model.discount, rewards=reward.tolist(), tranMatProbs=probabilities, tranMatColumns=columns)

        def solve(parallel=None):
            parallel = choice[0] if parallel is None else parallel
            solver.solve(algorithm=name, tolerance=epsilon, parallel=parallel, makeFinalCheck=False)
            return np.asarray(solver.getPolicy()), 0

        if not choice:
            choice.append(threads > 1 and _seconds(lambda: solve(True)) < _seconds(lambda: solve(False)))
        return solve

    return prepare


def _seconds(call: Callable) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def _nested(model: Model, entries: np.ndarray) -> list:
    """A CSR array of the transitions as lists [S][A][successors]."""
    rows = [row.tolist() for row in np.split(entries, model.transition.indptr[1:-1])]
    return [rows[first : first + model.num_actions] for first in range(0, len(rows), model.num_actions)]


def _quantecon(algorithm: str, model: Model, epsilon: float, threads: int) -> Callable:
    from quantecon.markov import DiscreteDP

    states, actions = (index.ravel() for index in np.indices((model.num_states, model.num_actions)))
    transition = scipy.sparse.csr_matrix(model.transition)
    dense = model.transition.toarray().reshape(model.num_states, model.num_actions, -1) if model.is_dense else None

    def prepare(reward):
        if model.is_dense:
            problem = DiscreteDP(reward, dense, model.discount)
        else:
            problem = DiscreteDP(reward.ravel(), transition, model.discount, states, actions)

        def solve():
            found = problem.solve(algorithm, epsilon=epsilon, max_iter=_MAX_ITERATIONS)
            return np.asarray(found.sigma), found.num_iter

        return solve

    return prepare


_LIBRARIES = {"mdptoolbox": _mdptoolbox, "mdpsolver": _mdpsolver, "quantecon": _quantecon}


def plan(method: str, model: Model, lanes, epsilon: float, limit: float, threads: int) -> Results:
    """An optimal policy for each lane's reward [S, A], as actions [S]; as many lanes as end before the limit."""
    library, algorithm = method.split()
    start = time.perf_counter()
    prepare = _LIBRARIES[library](algorithm, model, epsilon, threads)
    build = time.perf_counter() - start
    return _timed([lambda reward=reward: prepare(reward) for reward, _ in lanes], build, limit)


# ------------------------------------------------------------------------------------------ occupancies and values


def evaluate(method: str, work: str, model: Model, lanes, limit: float, threads: int) -> Results:
    """Occupancies or values of the lanes, each a reward [S, A] and a policy [S, A]."""
    del threads
    identity = scipy.sparse.eye_array(model.num_states, format="csr")
    model.transition  # noqa: B018  (made once)

    def solve(reward, policy):
        system = identity - model.discount * model.policy_matrix(policy)
        right = model.initial if work == "occupancy" else (policy * reward).sum(axis=1)
        found = _linear_solve(method, system.T if work == "occupancy" else system, right)
        return (found[:, None] * policy if work == "occupancy" else found), 0

    return _timed([lambda lane=lane: lambda: solve(*lane) for lane in lanes], 0.0, limit)


def _linear_solve(method: str, system, right: np.ndarray) -> np.ndarray:
    if method == "scipy spsolve":
        return scipy.sparse.linalg.spsolve(system.tocsc(), right)
    if method == "scipy splu":  # the fastest ordering on grids
        return scipy.sparse.linalg.splu(system.tocsc(), permc_spec="MMD_AT_PLUS_A").solve(right)
    return np.linalg.solve(system.toarray(), right)


def can_evaluate(method: str, model: Model) -> bool:
    """Whether a dense matrix would fit."""
    return method != "numpy solve" or model.num_states <= _MAX_DENSE_STATES


def _timed(prepared: list[Callable], build: float, limit: float) -> Results:
    """Calls of each lane, each after a new preparation, which counts as building.

    Quick ones are repeated, for their median; a quick first lane has a warm-up too.
    """
    begin, found, medians, iterations, compile_s = time.perf_counter(), [], [], [], 0.0
    for lane, prepare in enumerate(prepared):
        seconds = []
        while True:
            start = time.perf_counter()
            solve = prepare()
            build += time.perf_counter() - start
            start = time.perf_counter()
            answer, count = solve()
            seconds.append(time.perf_counter() - start)
            if lane == 0 and len(seconds) == 1 and seconds[0] <= _SHARE_OF_WARM_UP * limit:
                continue
            if len(seconds) == _REPEATS or sum(seconds) > _ENOUGH_SECONDS:
                break
        if lane == 0 and len(seconds) > 1:
            compile_s = max(seconds[0] - seconds[1], 0.0)
            seconds = seconds[1:]
        found.append(answer)
        medians.append(statistics.median(seconds))
        iterations.append(int(count))
        if time.perf_counter() - begin + max(seconds) > limit:
            break
    return Results(found, medians, build, compile_s, iterations)
