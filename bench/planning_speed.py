"""Measures planning, occupancies and values by this library and by others on the same instances.

A section is an instance of `bench.planning_instances`; `python -m bench.planning_speed SECTION` prints its rows as
JSON. Every method has a row for one reward or policy (the median of a few) and one for a batch (seconds per lane), each
measured in a process of its own with a time limit; a peer's batch is shared between two processes.

Planning is judged by the policy: its value, by an exact solve of SciPy's, must lie within 1e-6 / (1 - discount) times
the largest reward of an upper bound on the optimal one at every state. Occupancies and values must have a relative
error of 1e-8 against that solve.
"""

import dataclasses
import statistics
import time
from collections.abc import Iterator

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402

import jaxhom  # noqa: E402
from bench import limits, planning_peers  # noqa: E402
from bench.lpal_certificate import policy_solve  # noqa: E402
from bench.lpal_program import Model  # noqa: E402
from bench.planning_instances import TITLES, build, rewards  # noqa: E402
from bench.speed_rows import commit, matches, print_section, versions  # noqa: E402

OURS = "jaxhom"
SEED = 0
LIMIT, QUICK_LIMIT = 300.0, 60.0
LANES, QUICK_LANES = 32, 4
SINGLE_LANES, QUICK_SINGLE_LANES = 3, 1
_LOSS = 1e-6  # per step, as a share of the largest reward
_RELATIVE_ERROR = 1e-8
_MIXED = 0.1  # of the uniform policy, in the policies that are evaluated
_FEWER_LANES = (8, 2)
_ONE_THREAD = 1.5
_START_UP = 60.0
_PACKAGES = ("jax", "mdptoolbox-hiive", "mdpsolver", "quantecon", "scipy", "numpy")


@dataclasses.dataclass(frozen=True)
class Problem:
    """An instance as drawn, with the answers that others are held against.

    Attributes:
      name: of the instance. model: its arrays.
      rewards, policies: [B, S, A].
      upper: [B, S], a bound on the optimal values.
      limit: seconds for one row. single: lanes that are solved one by one.
    """

    name: str
    model: Model
    rewards: np.ndarray
    policies: np.ndarray
    upper: np.ndarray
    limit: float
    single: int

    @classmethod
    def draw(cls, name: str, quick: bool, limit: float | None) -> "Problem":
        """Rewards, their optimal policies mixed with the uniform one, and bounds on the optimal values."""
        lanes, mdp = QUICK_LANES if quick else LANES, build(name)
        drawn = rewards(name, SEED, lanes)
        plans = [jaxhom.optimal_policy(mdp, reward) for reward in drawn]
        policies = np.stack([np.asarray(plan.policy) for plan in plans])
        upper = np.stack([np.asarray(plan.upper_bound(mdp)) for plan in plans])
        mixed = (1.0 - _MIXED) * policies + _MIXED / mdp.num_actions
        single = QUICK_SINGLE_LANES if quick else SINGLE_LANES
        return cls(name, Model.of(mdp), drawn, mixed, upper, limit or (QUICK_LIMIT if quick else LIMIT), single)

    @property
    def loss(self) -> float:
        """That is asked of policies."""
        return _LOSS / (1.0 - self.model.discount) * float(np.abs(self.rewards).max())

    def row(self, work: str, method: str, lanes: int, **fields) -> dict:
        """One row of the table; what is not given stays empty."""
        base = {"instance": TITLES[self.name], "work": work, "S": self.model.num_states, "A": self.model.num_actions}
        base |= {"lanes": lanes, "method": method, "processes": 1, "dtype": "float64"}
        base |= {"device": jax.default_backend() if method == OURS else "cpu"}
        base |= {"error_asked": self.loss if work == "planning" else _RELATIVE_ERROR}
        return base | {"versions": versions(*_PACKAGES), "commit": commit()} | fields

    def judged(self, work: str, results: planning_peers.Results) -> dict:
        """Fields that follow from what was found: its time per lane, and the worst lane's error."""
        error = max(self._error(work, lane, found) for lane, found in enumerate(results.found))
        asked = self.loss if work == "planning" else _RELATIVE_ERROR
        fields = {"seconds": statistics.median(results.seconds), "compile_s": results.compile_s, "status": "measured"}
        fields |= {"error": error if np.isfinite(error) else None, "settled": float(error <= asked)}
        fields |= {"iterations": int(np.median(results.iterations))} if any(results.iterations) else {}
        return fields | {"build_s": results.build_s}

    def _error(self, work: str, lane: int, found: np.ndarray) -> float:
        model, policy, reward = self.model, self.policies[lane], self.rewards[lane]
        if not np.isfinite(found).all():
            return float("inf")
        if work == "planning":
            policy = np.eye(model.num_actions)[found]
            value = policy_solve(model, policy, (policy * reward).sum(axis=1), transpose=False)
            return float((self.upper[lane] - value).max())
        if work == "occupancy":
            exact = policy_solve(model, policy, model.initial, transpose=True)[:, None] * policy
            return float(np.abs(found - exact).sum() / exact.sum())
        exact = policy_solve(model, policy, (policy * reward).sum(axis=1), transpose=False)
        return float(np.abs(found - exact).max() / np.abs(exact).max())


# --------------------------------------------------------------------------------------------------------------- rows


def our_rows(problem: Problem, work: str) -> Iterator[dict]:
    """One lane, and all together."""
    for batch in (False, True):
        lanes = len(problem.rewards) if batch else problem.single
        task = {"name": problem.name, "work": work, "rewards": problem.rewards[:lanes], "limit": problem.limit}
        task["policies"] = None if work == "planning" else problem.policies[:lanes]
        # The loss of the greedy policy is at most twice the Bellman residual over 1 - discount.
        task["tolerance"] = 0.5 * (1.0 - problem.model.discount) * problem.loss
        found = ask("planning_ours", "solve", task | {"batch": batch}, 2.5 * problem.limit + _START_UP)
        lanes = lanes if batch else 1
        fields = found if isinstance(found, dict) else problem.judged(work, found)
        yield problem.row(work, OURS, lanes, **fields)


def ask(module: str, function: str, task: dict, limit: float):
    """What a process returned, or the fields of a row without an answer."""
    try:
        found = limits.start(module, function, task).result(limit)
    except RuntimeError as error:
        return {"status": "failed", "note": str(error)}
    return {"status": "time limit", "note": "no answer in time"} if found is None else found


def peer_rows(problem: Problem, work: str, method: str) -> Iterator[dict]:
    """One lane, and as many as the time limit lets expect."""
    if not planning_peers.is_installed(method):
        yield problem.row(work, method, 1, status="not installed")
        return
    if not planning_peers.can_evaluate(method, problem.model):
        return
    fields, epsilon = settled(problem, work, method, problem.loss, problem.single, batch=False)
    yield problem.row(work, method, 1, **fields)
    if not fields.get("settled"):
        return
    expected = _ONE_THREAD * (fields["seconds"] + fields["build_s"] / problem.single) / 2.0
    for lanes in (len(problem.rewards), *_FEWER_LANES):
        if lanes * expected <= problem.limit:
            fields, _ = settled(problem, work, method, epsilon, lanes, batch=True)
            yield problem.row(work, method, lanes, **fields)
            return


def settled(problem: Problem, work: str, method: str, epsilon: float, lanes: int, batch: bool) -> tuple[dict, float]:
    """Fields of the first tolerance of a toolbox whose policies are good enough, or of the last there was time for."""
    spent, fields = 0.0, {}
    while True:
        start = time.perf_counter()
        found, processes = solve(problem, work, method, epsilon, lanes, problem.limit - spent, batch)
        spent += time.perf_counter() - start
        if isinstance(found, dict):
            return fields or found, epsilon
        fields = problem.judged(work, found) | {"processes": processes}
        fields |= {"note": f"tolerance {epsilon:.1g}"} if work == "planning" else {}
        least = planning_peers.LEAST_TOLERANCE * problem.loss / _LOSS
        if fields["settled"] or spent > problem.limit or work != "planning" or 0.1 * epsilon < least:
            return fields, epsilon
        epsilon *= 0.1


def solve(problem: Problem, work: str, method: str, epsilon: float, lanes: int, limit: float, batch: bool):
    """(`Results` or the fields of a row without any, number of processes)."""
    processes = 2 if batch else 1
    task = {"method": method, "model": problem.model, "limit": limit}
    if work == "planning":
        function, task["epsilon"] = "plan", epsilon
    else:
        function, task["work"] = "evaluate", work
    values = list(zip(problem.rewards[:lanes], problem.policies[:lanes], strict=True))
    try:
        shared = ("planning_peers", function, task, "lanes", values, processes, limit + _START_UP)
        parts = limits.side_by_side(*shared)
    except RuntimeError as error:
        return {"status": "failed", "note": str(error)}, processes
    if parts is None or (batch and sum(len(part.found) for part in parts) < lanes):
        return {"status": "time limit", "note": f"no answer in {problem.limit:g} s"}, processes
    if not batch:
        return parts[0], 1
    found = [entry for part in parts for entry in part.found]
    seconds = max(sum(part.seconds) for part in parts) / lanes
    build_s, compile_s = (max(getattr(part, name) for part in parts) for name in ("build_s", "compile_s"))
    iterations = [entry for part in parts for entry in part.iterations]
    return planning_peers.Results(found, [seconds] * lanes, build_s, compile_s, iterations), len(parts)


def section(name: str, quick: bool, methods: list[str] | None, limit: float | None) -> Iterator[dict]:
    """All rows of an instance: ours, then each peer's, for each kind of work."""
    problem = Problem.draw(name, quick, limit)
    for work in ("planning", "occupancy", "policy_value"):
        if matches(OURS, methods):
            yield from our_rows(problem, work)
        for method in planning_peers.PLANNERS if work == "planning" else planning_peers.SOLVERS:
            if matches(method, methods):
                yield from peer_rows(problem, work, method)


if __name__ == "__main__":
    print_section(section, TITLES)
