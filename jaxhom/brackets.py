"""Certified brackets of the errors of many pairs of small models, by PDHG, an interior-point method, or both.

PDHG decides quickly on which side of a threshold an error lies and takes models of any size; the interior-point method
needs about ten steps to any tolerance, each with a factorisation of the size of the map. `bracket_errors` is the one
place that chooses.
"""

from collections.abc import Callable

import chex
import jax
import numpy as np

from jaxhom import interior_point
from jaxhom.lane_queue import solve_many
from jaxhom.pdhg import Status, engine
from jaxhom.pdhg.homomorphism_lp import HomomorphismProblem

METHODS = ("auto", "pdhg", "interior_point")

_MAX_LANES = 64
_BATCH_BYTES = 32 * 2**20
_CHUNK_PAIRS = 16_384
MAX_INTERIOR_SIZE = 32  # larger models: the normal matrix has (n m)^2 entries
_MAX_INTERIOR_LANES = 128
_FEW_LANES = 16
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
    anchored: bool = True,
    tolerance: float = 1e-4,
    threshold: float | None = None,
    method: str = "auto",
    max_iterations: int = 100_000,
    progress: Callable[[int], object] | None = None,
) -> LocalSimilarity:
    """Brackets the optimal errors of LP (9) for P pairs of models given as arrays.

    Args:
      source: [P, n, A, n], centre first; padding states have no transitions.
      target: [P, m, A, m], likewise.
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
        free = lower_bounds_without_iterations(source, target)
        is_open = free <= threshold
        progress(int((~is_open).sum()))
    else:
        free, is_open = np.zeros(count, source.dtype), np.ones(count, bool)
    (waiting,) = np.nonzero(is_open)
    # |K f| <= 1 for every map f, so 1 is an upper bound that costs nothing.
    result = LocalSimilarity(
        lower=free,
        upper=np.ones(count, source.dtype),
        iterations=np.zeros(count, np.int32),
        status=np.full(count, Status.SOLVED, np.int32),
    )
    for start in range(0, len(waiting), _CHUNK_PAIRS):
        chunk = waiting[start : start + _CHUNK_PAIRS]
        problem = HomomorphismProblem(
            source=np.moveaxis(source[chunk], 0, -1),
            target=np.moveaxis(target[chunk], 0, -1),
            source_size=source_size[chunk],
            target_size=target_size[chunk],
            anchored=anchored,
        )
        found = _solve(problem, method, tolerance, threshold, max_iterations, progress)
        for name in ("lower", "upper", "iterations", "status"):
            getattr(result, name)[chunk] = getattr(found, name)
    return result


def lower_bounds_without_iterations(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Lower bounds on the anchored errors of P pairs from single dual entries y at the centre, [P].

    The centre is mapped to the centre, so (K f)(0,a,0) >= T(0,a,0) - T'(0,a,0): the maps of the other states only add
    to it. And off the centre (K f)(0,a,k) <= sum_{j != 0} T(0,a,j) - T'(0,a,k): what leaves is all that can arrive.
    """
    stays, stays_there = source[:, 0, :, :1], target[:, 0, :, :1]  # [P, A, 1]
    leaves_there = target[:, 0, :, 1:]
    staying = (stays - stays_there).max(axis=(1, 2))
    leaves = source[:, 0, :, 1:].sum(axis=-1, keepdims=True)
    leaving = (leaves_there - leaves).max(axis=(1, 2), initial=-1.0)
    rounding = (8.0 + source.shape[1]) * np.finfo(source.dtype).eps
    return np.maximum(np.maximum(staying, leaving) - rounding, 0.0).astype(source.dtype)


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
    stages = [(engine.SOLVER, max_iterations, _pdhg_lanes(problem))]
    if method == "interior_point" or (method == "auto" and is_tight):
        stages.insert(0, (interior_point.SOLVER, interior_point.MAX_ITERATIONS, _interior_lanes(problem)))
    count = problem.source.shape[-1]
    lower, upper = np.zeros(count, problem.source.dtype), np.full(count, np.inf, problem.source.dtype)
    iterations = np.zeros(count, np.int32)
    for solver, limit, lanes in stages:
        (rest,) = np.nonzero(~_is_settled(lower, upper, tolerance, threshold))
        if not rest.size:
            break
        found = solve_many(
            solver,
            jax.tree.map(lambda leaf, rest=rest: leaf[..., rest], problem),
            tolerance=tolerance,
            threshold=threshold,
            max_iterations=limit,
            lanes=lanes,
            keep=("lower", "upper", "steps"),
            progress=progress,
        )
        lower[rest] = np.maximum(lower[rest], found["lower"])
        upper[rest] = np.minimum(upper[rest], found["upper"])
        iterations[rest] = found["steps"]
        progress = _no_progress  # every pair has been counted
    settled = _is_settled(lower, upper, tolerance, threshold)
    status = np.where(settled, Status.SOLVED, Status.ITERATION_LIMIT).astype(np.int32)
    return LocalSimilarity(lower=lower, upper=upper, iterations=iterations, status=status)


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
    return _fitting_lanes(problem, entries, _BATCH_BYTES, _MAX_LANES)


def _interior_lanes(problem) -> int:
    """A few normal matrices have to; a handful of pairs need no more lanes than that."""
    entries = (problem.source.shape[0] * problem.target.shape[0]) ** 2
    most = _FEW_LANES if problem.source.shape[-1] <= _FEW_LANES else _MAX_INTERIOR_LANES
    return _fitting_lanes(problem, entries, _INTERIOR_BYTES, most)


def _fitting_lanes(problem, entries: int, num_bytes: int, most: int) -> int:
    fitting = max(1, num_bytes // (entries * problem.source.dtype.itemsize))
    return int(min(most, 2 ** int(np.log2(fitting))))
