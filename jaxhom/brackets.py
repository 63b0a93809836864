"""Certified brackets of the errors of many pairs of small models, by PDHG, an interior-point method, or both.

PDHG decides quickly on which side of a threshold an error lies and takes models of any size; the interior-point method
needs about ten steps to any tolerance, each with a factorisation of the size of the map. `bracket_errors` is the one
place that chooses.
"""

from collections.abc import Callable

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxhom import interior_point
from jaxhom.pdhg import Status, engine, solve_many
from jaxhom.pdhg.homomorphism_lp import HomomorphismProblem

METHODS = ("auto", "pdhg", "interior_point")

_MAX_LANES = 64
_BATCH_BYTES = 32 * 2**20
_CHUNK_PAIRS = 16_384
_MAX_INTERIOR_SIZE = 16  # larger models: the normal matrix, (n m)^2, is slower than PDHG
_INTERIOR_LANES = 32


@chex.dataclass(frozen=True)
class LocalSimilarity:
    """Certified brackets of the optimal errors of P pairs.

    Attributes:
      lower, upper: [P], lower <= e <= upper, rounding included.
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
    progress: Callable[[int], object] = lambda count: None,
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
        if method == "interior_point" or (method == "auto" and _suits_interior_point(problem, tolerance, threshold)):
            solve = _by_interior_point
        else:
            solve = _by_pdhg
        found = solve(problem, tolerance, threshold, max_iterations, progress)
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


def _suits_interior_point(problem: HomomorphismProblem, tolerance: float, threshold: float | None) -> bool:
    """Tight brackets of small models in float64 on a CPU; decisions and coarse brackets are PDHG's."""
    is_small = max(problem.source.shape[0], problem.target.shape[0]) <= _MAX_INTERIOR_SIZE
    is_tight = threshold is None and tolerance <= 1e-3
    return is_small and is_tight and problem.source.dtype == np.float64 and jax.default_backend() == "cpu"


def _by_pdhg(problem, tolerance, threshold, max_iterations, progress) -> LocalSimilarity:
    n, num_actions, _, _ = problem.source.shape
    m = problem.target.shape[0]
    # Both models and the six pairs of points that the engine keeps, per lane.
    entries = num_actions * (n * n + m * m + 6 * n * m) + 6 * n * m
    fitting = max(1, _BATCH_BYTES // (entries * problem.source.dtype.itemsize))
    state = solve_many(
        problem,
        tolerance=tolerance,
        threshold=threshold,
        max_iterations=max_iterations,
        lanes=int(min(_MAX_LANES, 2 ** int(np.log2(fitting)))),
        progress=progress,
    )
    settled = engine.is_settled(state, tolerance, threshold)
    return LocalSimilarity(
        lower=state.lower,
        upper=state.upper,
        iterations=state.steps,
        status=np.where(settled, Status.SOLVED, Status.ITERATION_LIMIT).astype(np.int32),
    )


def _by_interior_point(problem, tolerance, threshold, max_iterations, progress) -> LocalSimilarity:
    """Batches of a fixed width; the lanes that stall short of the tolerance go on to PDHG."""
    count = problem.source.shape[-1]
    lower, upper = np.zeros((2, count), problem.source.dtype)
    iterations = np.zeros(count, np.int32)
    limit = None if threshold is None else jnp.asarray(threshold, problem.source.dtype)
    for start in range(0, count, _INTERIOR_LANES):
        index = np.arange(start, min(start + _INTERIOR_LANES, count))
        padded = np.resize(index, _INTERIOR_LANES)  # one shape; the surplus repeats
        state = _interior_point(_take(problem, padded), tolerance, limit)
        lower[index], upper[index] = state.lower[: len(index)], state.upper[: len(index)]
        iterations[index] = state.steps[: len(index)]
        progress(len(index))
    status = np.full(count, Status.SOLVED, np.int32)
    is_open = upper - lower > tolerance
    if threshold is not None:
        is_open &= (lower <= threshold) & (upper > threshold + tolerance)
    (rest,) = np.nonzero(is_open)
    if rest.size:
        finished = _by_pdhg(_take(problem, rest), tolerance, threshold, max_iterations, lambda count: None)
        lower[rest] = np.maximum(lower[rest], finished.lower)
        upper[rest] = np.minimum(upper[rest], finished.upper)
        iterations[rest], status[rest] = finished.iterations, finished.status
    return LocalSimilarity(lower=lower, upper=upper, iterations=iterations, status=status)


def _take(problem: HomomorphismProblem, lanes: np.ndarray) -> HomomorphismProblem:
    return jax.tree.map(lambda leaf: leaf[..., lanes], problem)


@jax.jit
def _interior_point(problem, tolerance, threshold) -> interior_point.InteriorPointState:
    return interior_point.solve(problem, tolerance=tolerance, threshold=threshold)
