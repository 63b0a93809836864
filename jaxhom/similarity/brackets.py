"""Certified brackets of the errors of many pairs of small models, by PDHG, an interior-point method, or both.

PDHG decides quickly on which side of a threshold an error lies and takes models of any size; the interior-point method
needs about ten steps to any tolerance, each with a factorisation of the size of the map. `bracket_errors` is the one
place that chooses.

Bounds are widened by the rounding of the sums behind them, which is known beforehand. Where it would take up much of
the tolerance, as in float32 it does from about ten states on, PDHG runs until its bounds are as close as asked for but
for that, and the points that it found are judged in float64 on the host.
"""

from collections.abc import Callable

import chex
import jax
import numpy as np

from jaxhom.similarity import interior_point
from jaxhom.similarity.homomorphism_lp import HomomorphismProblem
from jaxhom.similarity.host_certificates import certified_bounds
from jaxhom.solvers import pdhg
from jaxhom.solvers.lane_queue import solve_many
from jaxhom.status import Status

METHODS = ("auto", "pdhg", "interior_point")

_MAX_LANES = 64
_BATCH_BYTES = 32 * 2**20
_CHUNK_PAIRS = 16_384
MAX_INTERIOR_SIZE = 32  # larger models: the normal matrix has (n m)^2 entries
_MAX_INTERIOR_LANES = 128
_FEW_LANES = 16
_FEW_PDHG_LANES = 8
_FEW_BYTES = 2**19  # more than that in a batch of a few pairs' lanes is repeated work worth a program of its own
_SMALL_ROUNDING = 0.125  # of the tolerance: nothing is done about it
_NOISE = 32.0  # times eps: closer than that an iteration does not come
_INTERIOR_BYTES = 2 * 2**20


@chex.dataclass(frozen=True)
class LocalSimilarity:
    """Certified brackets of the optimal errors of P pairs.

    Attributes:
      lower: [P], lower <= e <= upper for the optimal error e, rounding included.
      upper: [P], likewise.
      iterations: int32 [P], iterations of the method that settled the pair; 0 where the local models are isomorphic.
      status: int32 [P], a `jaxhom.Status`.
    """

    lower: np.ndarray
    upper: np.ndarray
    iterations: np.ndarray
    status: np.ndarray


def bracket_errors(
    source: np.ndarray,
    target: np.ndarray,
    *,
    source_size: np.ndarray | None = None,
    target_size: np.ndarray | None = None,
    source_labels: np.ndarray | None = None,
    target_labels: np.ndarray | None = None,
    anchored: bool = True,
    tolerance: float = 1e-4,
    threshold: float | None = None,
    method: str = "auto",
    max_iterations: int = 100_000,
    progress: Callable[[int], object] | None = None,
) -> LocalSimilarity:
    """Brackets the optimal errors of LP (9) for P pairs of models given as arrays.

    Args:
      source: [P, n, A, n], centre first; padding states have no transitions, and neither have actions that are not
        allowed.
      target: [P, m, A, m], likewise.
      source_labels, target_labels: [P, n, A, L] and [P, m, A, L], finite, zero on padding: e also bounds
        |l(i,a) - sum_k f(i,k) l'(k,a)|. None where nothing but transitions counts.
      source_size, target_size: int [P], how many states are real; all if None.
      anchored: require that the centre is mapped to the centre.
      tolerance: largest upper - lower to settle for.
      threshold: None, or epsilon: settle a pair also when e <= epsilon is decided up to the tolerance.
      method: one of `METHODS`.
      max_iterations: of PDHG, per pair.
      progress: called with the number of pairs that just finished.

    Returns:
      `LocalSimilarity` [P].

    Source: Boularias and Chaib-draa 2010, eq. (9).
    """
    progress = progress or _no_progress
    count, n = source.shape[:2]
    m = target.shape[1]
    if source_size is None:
        source_size = np.full(count, n)
    if target_size is None:
        target_size = np.full(count, m)
    if threshold is not None and anchored:
        free = lower_bounds_without_iterations(source, target, source_labels, target_labels)
        is_open = free <= threshold
        progress(int((~is_open).sum()))
    else:
        free, is_open = np.zeros(count, source.dtype), np.ones(count, bool)
    (waiting,) = np.nonzero(is_open)
    result = LocalSimilarity(
        lower=free,
        upper=_upper_bounds_without_iterations(source, source_labels, target_labels),
        iterations=np.zeros(count, np.int32),
        status=np.full(count, Status.SOLVED, np.int32),
    )

    def lanes_last(array, chunk):
        return None if array is None else np.moveaxis(array[chunk], 0, -1)

    for start in range(0, len(waiting), _CHUNK_PAIRS):
        chunk = waiting[start : start + _CHUNK_PAIRS]
        problem = HomomorphismProblem(
            source=lanes_last(source, chunk),
            target=lanes_last(target, chunk),
            source_size=source_size[chunk],
            target_size=target_size[chunk],
            anchored=anchored,
            source_labels=lanes_last(source_labels, chunk),
            target_labels=lanes_last(target_labels, chunk),
        )
        found = _solve(problem, method, tolerance, threshold, max_iterations, progress)
        for name in ("lower", "upper", "iterations", "status"):
            getattr(result, name)[chunk] = getattr(found, name)
    return result


def lower_bounds_without_iterations(source, target, source_labels=None, target_labels=None) -> np.ndarray:
    """Lower bounds on the anchored errors of P pairs from single dual entries y at the centre, [P].

    The centre is mapped to the centre, so (K f)(0,a,0) >= T(0,a,0) - T'(0,a,0): the maps of the other states only add
    to it. And off the centre (K f)(0,a,k) <= sum_{j != 0} T(0,a,j) - T'(0,a,k): what leaves is all that can arrive.
    Labels of the centre meet those of the centre alone.

    Args:
      source, target, source_labels, target_labels: NumPy, as in `bracket_errors`.
    """
    stays, stays_there = source[:, 0, :, :1], target[:, 0, :, :1]  # [P, A, 1]
    leaves_there = target[:, 0, :, 1:]
    staying = (stays - stays_there).max(axis=(1, 2))
    leaves = source[:, 0, :, 1:].sum(axis=-1, keepdims=True)
    leaving = (leaves_there - leaves).max(axis=(1, 2), initial=-1.0)
    rounding = (8.0 + source.shape[1]) * np.finfo(source.dtype).eps
    bound = np.maximum(staying, leaving) - rounding
    if source_labels is not None:
        apart = np.abs(source_labels[:, 0] - target_labels[:, 0]).max(axis=(1, 2), initial=0.0)
        bound = np.maximum(bound, apart * (1.0 - 2.0 * np.finfo(source.dtype).eps))
    return np.maximum(bound, 0.0).astype(source.dtype)


def _upper_bounds_without_iterations(source, source_labels, target_labels) -> np.ndarray:
    """[P]: |K f| <= 1 for every map f, and what labels differ by is within their range."""
    bound = np.ones(len(source), source.dtype)
    if source_labels is None:
        return bound
    axes = (1, 2, 3)
    highest = (labels.max(axis=axes, initial=0.0) for labels in (source_labels, target_labels))
    lowest = (labels.min(axis=axes, initial=0.0) for labels in (source_labels, target_labels))
    width = np.maximum(*highest) - np.minimum(*lowest)
    return np.maximum(bound, width * (1.0 + 4.0 * np.finfo(source.dtype).eps)).astype(source.dtype)


def suits_interior_point(source: jax.Array, target: jax.Array, tolerance: float) -> bool:
    """Whether the interior-point method is the faster one for tight brackets: small models in float64 on a CPU.

    Args:
      source: [n, ...]. target: [m, ...].
    """
    is_small = max(source.shape[0], target.shape[0]) <= MAX_INTERIOR_SIZE
    return is_small and tolerance <= 1e-3 and source.dtype == np.float64 and jax.default_backend() == "cpu"


def _solve(problem, method, tolerance, threshold, max_iterations, progress) -> LocalSimilarity:
    """Brackets of the lanes of a problem; what the interior-point method leaves open, PDHG finishes."""
    is_tight = threshold is None and suits_interior_point(problem.source, problem.target, tolerance)
    count = problem.source.shape[-1]
    if method == "interior_point" or (method == "auto" and is_tight):
        options = {"lanes": _interior_lanes(problem), "keep": ("lower", "upper", "steps"), "progress": progress}
        limits = {"tolerance": tolerance, "threshold": threshold, "max_iterations": interior_point.MAX_ITERATIONS}
        found = solve_many(interior_point.SOLVER, problem, **limits, **options)
        lower, upper, iterations = found["lower"], found["upper"], found["steps"]
        progress = _no_progress  # every pair has been counted
    else:
        lower, upper = np.zeros(count, problem.source.dtype), np.full(count, np.inf, problem.source.dtype)
        iterations = np.zeros(count, np.int32)
    status = np.full(count, Status.SOLVED, np.int32)
    (rest,) = np.nonzero(~_is_settled(lower, upper, tolerance, threshold))
    if rest.size:
        found = settle_by_pdhg(
            jax.tree.map(lambda leaf: leaf[..., rest], problem),
            tolerance=tolerance,
            threshold=threshold,
            max_iterations=max_iterations,
            lanes=_pdhg_lanes(problem),
            progress=progress,
        )
        lower[rest], upper[rest] = np.maximum(lower[rest], found["lower"]), np.minimum(upper[rest], found["upper"])
        iterations[rest] = found["steps"]
        settled = _is_settled(lower[rest], upper[rest], tolerance, threshold)
        status[rest] = np.where(settled, Status.SOLVED, found["status"])
    return LocalSimilarity(lower=lower, upper=upper, iterations=iterations, status=status)


def settle_by_pdhg(
    problem: HomomorphismProblem,
    *,
    tolerance: float,
    threshold: float | None = None,
    max_iterations: int,
    lanes: int,
    keep: tuple[str, ...] = (),
    progress: Callable[[int], object] | None = None,
) -> dict[str, np.ndarray]:
    """Certified bounds of every lane, as close as asked for where the dtype allows it.

    Args:
      problem: NumPy arrays.
      tolerance, threshold, max_iterations: as in `bracket_errors`.
      lanes: width of the batch.
      keep: further fields of the engine's state to return.
      progress: called with the number of pairs that just finished.

    Returns:
      lower, upper, steps, status [P] and what `keep` names.
    """
    eps = np.finfo(problem.source.dtype).eps
    of_lower, of_upper = (float(np.max(part)) for part in problem.rounding())
    rounding = of_lower + of_upper
    is_narrow = rounding > _SMALL_ROUNDING * tolerance
    gap, limit = tolerance, threshold
    if is_narrow:  # ask for what the bounds would be without their widening, with room for the noise in them
        gap = max(0.5 * tolerance, _NOISE * eps) + rounding
        limit = None if threshold is None else threshold - of_lower + _NOISE * eps
    points = ("best_primal", "best_dual") if is_narrow else ()
    found = solve_many(
        pdhg.SOLVER,
        problem,
        tolerance=gap,
        threshold=limit,
        max_iterations=max_iterations,
        lanes=lanes,
        keep=tuple({"lower", "upper", "steps", *points, *keep}),
        progress=progress or _no_progress,
    )
    found["lower"] = np.fmax(found["lower"], 0.0)
    (rest,) = np.nonzero(~_is_settled(found["lower"], found["upper"], tolerance, threshold))
    if is_narrow and rest.size:
        part = jax.tree.map(lambda leaf: leaf[..., rest], problem)
        lower, upper = certified_bounds(part, *(found[name][..., rest] for name in points))
        found["lower"][rest] = np.fmax(found["lower"][rest], lower)
        found["upper"][rest] = np.fmin(found["upper"][rest], upper)
    settled = _is_settled(found["lower"], found["upper"], tolerance, threshold)
    unsettled = np.where(found["steps"] < max_iterations, Status.STALLED, Status.ITERATION_LIMIT)
    return found | {"status": np.where(settled, Status.SOLVED, unsettled).astype(np.int32)}


def _no_progress(count: int) -> None:
    del count


def _is_settled(lower, upper, tolerance, threshold) -> np.ndarray:
    settled = upper - lower <= tolerance
    if threshold is not None:
        settled |= (lower > threshold) | (upper <= threshold + tolerance)
    return settled


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
