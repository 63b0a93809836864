"""Certified brackets of the errors of many pairs of small models, by PDHG, an interior-point method, or both.

PDHG decides quickly on which side of a threshold an error lies and takes models of any size; the interior-point method
needs about ten steps to any tolerance, each with a factorisation of the size of the map. `choose_method` is the one
place that chooses. Decisions of which bounds without iterations (`free_bounds`) or intervals (`propagation`) can be
sure need neither.

Bounds are widened by the rounding of the sums behind them, which is known beforehand. Where it would take up much of
the tolerance, as in float32 it does from about ten states on, PDHG runs until its bounds are as close as asked for but
for that, and the points that it found are judged in float64 on the host.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np

from jaxhom import checks, programs
from jaxhom.similarity import interior_point
from jaxhom.similarity.free_bounds import lower_bounds_without_iterations, upper_bounds_without_iterations
from jaxhom.similarity.homomorphism_lp import HomomorphismProblem
from jaxhom.similarity.host_certificates import certified_bounds
from jaxhom.similarity.host_interior_point import seconds_on_host, solve_on_host
from jaxhom.similarity.model_pairs import ModelPairs
from jaxhom.similarity.propagation import bounds_by_intervals
from jaxhom.solvers import pdhg
from jaxhom.solvers.lane_queue import is_settled, solve_many
from jaxhom.status import Record, Status

METHODS = ("auto", "pdhg", "interior_point")
Progress = Callable[[int], object]
"""Called with the number of pairs that just finished."""

_MAX_LANES = 64  # of PDHG: they fill a CPU's vector units, and more wait for the slowest
_BATCH_BYTES = 32 * 2**20  # of a batch of PDHG
_CHUNK_PAIRS = 16_384  # that are on the host as copies with the lanes last
MAX_INTERIOR_SIZE = 32  # larger models: the normal matrix has (n m)^2 entries
_MAX_INTERIOR_LANES = 128  # of models so small that more would fit: they wait for the slowest
_FEW_LANES = 16  # a handful of pairs is one narrow batch: a step costs what its lanes cost, used or not
_FEW_PDHG_LANES = 8  # the same for PDHG
_FEW_BYTES = 2**19  # more than that in a batch of a few pairs' lanes is repeated work worth a program of its own
_SMALL_ROUNDING = 0.125  # of the tolerance: nothing is done about it
NOISE = 32.0  # times eps: closer than that an iteration does not come
_INTERIOR_BYTES = 2 * 2**20  # of a batch's normal matrices: a core's own cache
_TIGHT = 1e-3  # wider gaps PDHG closes sooner
_MAP_LANES = 8  # maps are asked for a few at a time


def no_progress(count: int) -> None:
    """Where nobody looks."""
    del count


class LocalSimilarity(Record):
    """Certified brackets of the optimal errors of P pairs.

    Attributes:
      lower: [P], lower <= e <= upper for the optimal error e, rounding included.
      upper: [P], likewise.
      iterations: int32 [P], iterations of the method that settled the pair; 0 where none was needed.
      status: int32 [P], a `jaxhom.Status`.
    """

    lower: np.ndarray
    upper: np.ndarray
    iterations: np.ndarray
    status: np.ndarray


class Goal(NamedTuple):
    """How far a pair of models is to be settled, and by which means.

    Attributes:
      tolerance: largest upper - lower to settle for.
      threshold: NaN, or epsilon: settle a pair also when e <= epsilon is decided up to the tolerance.
      method: one of `METHODS`.
      max_iterations: of PDHG, per pair.
    """

    tolerance: float = 1e-4
    threshold: float = np.nan
    method: str = "auto"
    max_iterations: int = 100_000

    @classmethod
    def checked(cls, **fields) -> Goal:
        """The goal, or `ValueError` where a field is out of range."""
        checks.refuse_traced(**fields)
        goal = cls(**fields)
        if goal.method not in METHODS:
            raise ValueError(f"method must be one of {METHODS}, got {goal.method!r}")
        if not goal.tolerance > 0:
            raise ValueError(f"tolerance must be positive, got {goal.tolerance}")
        if "threshold" in fields and not goal.threshold >= 0:
            raise ValueError(f"threshold must not be negative, got {goal.threshold}")
        checks.require_count("max_iterations", goal.max_iterations)
        return goal

    @property
    def decides(self) -> bool:
        """Whether the goal is a decision."""
        return not np.isnan(self.threshold)

    def is_met(self, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
        """bool [P]: whether bounds [P] are settled."""
        return is_settled(lower, upper, self.tolerance, self.threshold)


def choose_method(n: int, m: int, dtype, goal: Goal) -> str:
    """How LP (9) from n to m states is solved: interior points for tight brackets of small float64 models on a CPU."""
    if goal.method != "auto":
        return goal.method
    is_small = max(n, m) <= MAX_INTERIOR_SIZE and dtype == np.float64 and jax.default_backend() == "cpu"
    return "interior_point" if is_small and not goal.decides and goal.tolerance <= _TIGHT else "pdhg"


def is_small_work(problem: HomomorphismProblem) -> bool:
    """Whether the host is done with a problem before its program would be compiled."""
    sizes = np.asarray(problem.source_size), np.asarray(problem.target_size)
    return max(map(np.max, sizes)) <= MAX_INTERIOR_SIZE and not programs.pays(float(seconds_on_host(*sizes).sum()))


def bracket_errors(
    source: np.ndarray,
    target: np.ndarray,
    *,
    source_size: np.ndarray | None = None,
    target_size: np.ndarray | None = None,
    source_labels: np.ndarray | None = None,
    target_labels: np.ndarray | None = None,
    anchored: bool = True,
    pairs: np.ndarray | None = None,
    goal: Goal = Goal(),  # noqa: B008 (a tuple, it never changes)
    iterates: bool = True,
    progress: Progress = no_progress,
) -> LocalSimilarity:
    """Brackets the optimal errors of LP (9) for P pairs of models given as arrays.

    Args:
      source: [S, n, A, n], centre first; padding states have no transitions, and neither have actions that are not
        allowed.
      target: [S', m, A, m], likewise.
      source_size, target_size: int [S] and [S'], how many states are real; all if None.
      source_labels, target_labels: [S, n, A, L] and [S', m, A, L], finite, zero on padding: e also bounds
        |l(i,a) - sum_k f(i,k) l'(k,a)|. None where nothing but transitions counts.
      anchored: require that the centre is mapped to the centre.
      pairs: int [P, 2], numbers of a source and a target each; if None, each source with the target of its number.
      goal: what to settle for.
      iterates: solve what bounds and intervals leave open; otherwise that is at its limit of iterations, which is 0.
      progress: called with the number of pairs that just finished.

    Returns:
      `LocalSimilarity` [P].

    Source: Boularias and Chaib-draa 2010, eq. (9).
    """
    models = ModelPairs.of(
        source,
        target,
        source_size=source_size,
        target_size=target_size,
        source_labels=source_labels,
        target_labels=target_labels,
        anchored=anchored,
        pairs=pairs,
    )
    result = _no_iterations(models)
    if goal.decides and anchored:
        result.lower[:] = lower_bounds_without_iterations(models)
    (waiting,) = np.nonzero(~(result.lower > goal.threshold))
    progress(len(result.lower) - len(waiting))
    if goal.decides and goal.method == "auto" and waiting.size:
        waiting = _decide_by_intervals(models, waiting, goal, result, progress)
    if not iterates:
        result.status[waiting] = Status.ITERATION_LIMIT
        return result
    for start in range(0, len(waiting), _CHUNK_PAIRS):
        chunk = waiting[start : start + _CHUNK_PAIRS]
        found = _solve(models.problem(chunk), goal, progress)
        for name in ("lower", "upper", "iterations", "status"):
            getattr(result, name)[chunk] = getattr(found, name)
    return result


def find_maps(
    source: np.ndarray,
    target: np.ndarray,
    *,
    goal: Goal = Goal(),  # noqa: B008
    **options,
) -> tuple[LocalSimilarity, np.ndarray]:
    """As `bracket_errors`, with its options, and the maps that prove the upper bounds: [P, n, m], zero on padding."""
    problem = ModelPairs.of(source, target, **options).problem(slice(None))
    if is_small_work(problem):
        near = solve_on_host(problem, goal.tolerance, goal.threshold, no_progress)
        if goal.is_met(near.lower, near.upper).all():
            status = np.full(len(near.steps), Status.SOLVED, np.int32)
            return LocalSimilarity(lower=near.lower, upper=near.upper, iterations=near.steps, status=status), near.maps
    found, state = _settle_by_pdhg(problem, goal, _MAP_LANES, keep=("best_primal",))
    return found, np.moveaxis(state["best_primal"], -1, 0)


def _no_iterations(models: ModelPairs) -> LocalSimilarity:
    """What holds before anything is computed."""
    count = len(models.pairs)
    return LocalSimilarity(
        lower=np.zeros(count, models.dtype),
        upper=upper_bounds_without_iterations(models),
        iterations=np.zeros(count, np.int32),
        status=np.full(count, Status.SOLVED, np.int32),
    )


def _decide_by_intervals(models: ModelPairs, waiting: np.ndarray, goal: Goal, result: LocalSimilarity, progress):
    """Writes down what intervals find of the pairs that wait, int [W]; those of them that still do."""
    lower, upper = bounds_by_intervals(models, waiting, goal.threshold, goal.tolerance)
    result.lower[waiting] = np.maximum(result.lower[waiting], lower)
    result.upper[waiting] = np.minimum(result.upper[waiting], upper)
    is_met = goal.is_met(lower, upper)
    progress(int(is_met.sum()))
    return waiting[~is_met]


def _solve(problem: HomomorphismProblem, goal: Goal, progress) -> LocalSimilarity:
    """Brackets of the lanes of a problem; what the interior-point method leaves open, PDHG finishes."""
    (n, _, _, count), m, dtype = problem.source.shape, len(problem.target), problem.source.dtype
    if goal.method == "auto" and is_small_work(problem):
        lower, upper, iterations, _ = solve_on_host(problem, goal.tolerance, goal.threshold, progress)
    elif choose_method(n, m, dtype, goal) == "pdhg":
        return _settle_by_pdhg(problem, goal, _pdhg_lanes(problem), progress)[0]
    else:
        found = solve_many(
            interior_point.SOLVER,
            problem,
            tolerance=goal.tolerance,
            threshold=goal.threshold,
            max_iterations=interior_point.MAX_ITERATIONS,
            lanes=_interior_lanes(problem),
            keep=("lower", "upper", "steps"),
            progress=progress,
        )
        lower, upper, iterations = found["lower"], found["upper"], found["steps"]
    status = np.full(count, Status.SOLVED, np.int32)
    (rest,) = np.nonzero(~goal.is_met(lower, upper))
    if rest.size:
        part = jax.tree.map(lambda leaf: leaf[..., rest], problem)
        others, _ = _settle_by_pdhg(part, goal, _pdhg_lanes(problem))
        lower[rest], upper[rest] = np.maximum(lower[rest], others.lower), np.minimum(upper[rest], others.upper)
        iterations[rest] = others.iterations
        status[rest] = np.where(goal.is_met(lower[rest], upper[rest]), Status.SOLVED, others.status)
    return LocalSimilarity(lower=lower, upper=upper, iterations=iterations, status=status)


def _settle_by_pdhg(
    problem: HomomorphismProblem,
    goal: Goal,
    lanes: int,
    progress: Progress = no_progress,
    keep: tuple[str, ...] = (),
) -> tuple[LocalSimilarity, dict[str, np.ndarray]]:
    """Certified bounds of every lane, as close as asked for where the dtype allows it.

    Args:
      problem: NumPy arrays.
      goal: what to settle for.
      lanes: width of the batch.
      progress: called with the number of pairs that just finished.
      keep: fields of PDHG's state to return as well.
    """
    eps = np.finfo(problem.source.dtype).eps
    of_lower, of_upper = (float(np.max(part)) for part in problem.rounding())
    rounding = of_lower + of_upper
    is_narrow = rounding > _SMALL_ROUNDING * goal.tolerance
    gap, limit = goal.tolerance, goal.threshold
    if is_narrow:  # ask for what the bounds would be without their widening, with room for the noise in them
        gap = max(0.5 * goal.tolerance, NOISE * eps) + rounding
        limit = goal.threshold - of_lower + NOISE * eps
    points = ("best_primal", "best_dual") if is_narrow else ()
    found = solve_many(
        pdhg.SOLVER,
        problem,
        tolerance=gap,
        threshold=limit,
        max_iterations=goal.max_iterations,
        lanes=lanes,
        keep=tuple({"lower", "upper", "steps", *points, *keep}),
        progress=progress,
    )
    lower, upper = np.fmax(found["lower"], 0.0), found["upper"]
    (rest,) = np.nonzero(~goal.is_met(lower, upper))
    if is_narrow and rest.size:
        part = jax.tree.map(lambda leaf: leaf[..., rest], problem)
        proved_lower, proved_upper = certified_bounds(part, *(found[name][..., rest] for name in points))
        lower[rest], upper[rest] = np.fmax(lower[rest], proved_lower), np.fmin(upper[rest], proved_upper)
    unsettled = np.where(found["steps"] < goal.max_iterations, Status.STALLED, Status.ITERATION_LIMIT)
    status = np.where(goal.is_met(lower, upper), Status.SOLVED, unsettled).astype(np.int32)
    return LocalSimilarity(lower=lower, upper=upper, iterations=found["steps"], status=status), found


def _pdhg_lanes(problem) -> int:
    """Both models and the six pairs of points that the engine keeps have to fit into the cache."""
    n, num_actions, m = *problem.source.shape[:2], problem.target.shape[0]
    entries = num_actions * (n * n + m * m + 6 * n * m) + 6 * n * m
    is_large = _FEW_PDHG_LANES * entries * problem.source.dtype.itemsize > _FEW_BYTES
    most, count = _MAX_LANES, problem.source.shape[-1]
    if is_large and count <= _FEW_PDHG_LANES:
        most = 2 ** int(np.ceil(np.log2(count))) if n + m > MAX_INTERIOR_SIZE else _FEW_PDHG_LANES
    return _fitting_lanes(problem, entries, _BATCH_BYTES, most)


def _interior_lanes(problem) -> int:
    """A few normal matrices have to; a handful of pairs need no more lanes than that."""
    entries = (problem.source.shape[0] * problem.target.shape[0]) ** 2
    most = _FEW_LANES if problem.source.shape[-1] <= _FEW_LANES else _MAX_INTERIOR_LANES
    return _fitting_lanes(problem, entries, _INTERIOR_BYTES, most)


def _fitting_lanes(problem, entries: int, num_bytes: int, most: int) -> int:
    fitting = max(1, num_bytes // (entries * problem.source.dtype.itemsize))
    return int(min(most, 2 ** int(np.log2(fitting))))
