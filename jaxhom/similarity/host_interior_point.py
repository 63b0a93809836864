"""The interior-point method of `interior_point` in NumPy, for so few pairs that compiling would take longer.

The same central path, Mehrotra's predictor and corrector (1992), lanes first. Work is in float64 whatever the type of
the models; every iterate is feasible up to rounding, and what is returned is what `host_certificates` proves of the
points: bounds that do not depend on how these were found.
"""

from __future__ import annotations

import dataclasses
import threading
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jaxhom.similarity.homomorphism_lp import HomomorphismProblem
from jaxhom.similarity.host_certificates import Certificate, adjoint, forward
from jaxhom.similarity.host_normal_matrices import inverse_factors, normal_matrices
from jaxhom.solvers.blas_threads import one_blas_thread
from jaxhom.solvers.lane_queue import is_settled, map_on_cores, num_cores

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from jaxtyping import Float, Int

MAX_ITERATIONS = 80  # ten to twenty are usual
_TO_BOUNDARY = 0.995  # of the way: points stay positive
_SECONDS, _GROWTH = 2e-6, 1.7  # of a pair, times (n m)^1.7: 0.5 ms for five states, 120 for 25
_BATCHES_PER_CORE, _SHORT = 2, 0.05  # batches at least, of work that takes more seconds than that
_LEAST_SHARE = 0.5  # of the work of a lane that its own size would make; a batch more costs some ten milliseconds
_CHUNK_BYTES = 64 * 2**20  # of normal matrices at a time


class Answer(NamedTuple):
    """Bounds [P] in the type of the models, iterations int32 [P], and the maps [P, n, m] that prove the upper ones."""

    lower: Float[np.ndarray, " P"]
    upper: Float[np.ndarray, " P"]
    steps: Int[np.ndarray, " P"]
    maps: Float[np.ndarray, "P n m"]


class _Point(NamedTuple):
    """f [P, n, m], e [P], y+ and y- [P, n, A, m + L], and z [P, n, m]."""

    f: np.ndarray
    e: np.ndarray
    plus: np.ndarray
    minus: np.ndarray
    z: np.ndarray

    def part(self, index) -> _Point:
        return _Point(*(leaf[index] for leaf in self))


def solve_on_host(
    problem: HomomorphismProblem, tolerance: float, threshold: float, progress: Callable[[int], object]
) -> Answer:
    """Bounds of every lane of a problem of NumPy arrays, settled as `is_settled` has it where rounding allows it."""
    n, m, count = len(problem.source), len(problem.target), problem.source.shape[-1]
    lower, upper = np.zeros(count, problem.source.dtype), np.zeros(count, problem.source.dtype)
    whole = Answer(lower, upper, np.zeros(count, np.int32), np.zeros((count, n, m), problem.source.dtype))
    lock = threading.Lock()

    def work(lanes: Int[np.ndarray, " B"]) -> None:
        found = _solve(_Models(problem, lanes), tolerance, threshold)
        with lock:
            for place, new in zip(whole[:3], found[:3], strict=True):
                place[lanes] = new
            whole.maps[lanes, : found.maps.shape[1], : found.maps.shape[2]] = found.maps
            progress(len(lanes))

    sizes = np.asarray(problem.source_size), np.asarray(problem.target_size)
    batches = list(_batches(*sizes))
    with one_blas_thread():
        if seconds_on_host(*sizes).sum() > _SHORT:
            map_on_cores(work, batches)
        else:  # before a thread would have begun
            for lanes in batches:
                work(lanes)
    return whole


def seconds_on_host(source_size: Int[np.ndarray, " P"], target_size: Int[np.ndarray, " P"]) -> Float[np.ndarray, " P"]:
    """About how long pairs of so many states take."""
    return _SECONDS * (source_size * target_size) ** _GROWTH


def _batches(source_size: Int[np.ndarray, " P"], target_size: Int[np.ndarray, " P"]) -> Iterator[Int[np.ndarray, " B"]]:
    """The lanes, in batches of so similar sizes that at most half of the work is about padding, and for every core."""
    seconds = seconds_on_host(source_size, target_size)
    most = max(seconds.sum() / (_BATCHES_PER_CORE * num_cores()), _SHORT)
    left = np.argsort(-seconds, kind="stable")
    while left.size:
        n, m = (np.maximum.accumulate(size[left]) for size in (source_size, target_size))
        fits = seconds[left] >= _LEAST_SHARE * seconds_on_host(n, m)
        fits &= np.cumsum(seconds[left]) <= most
        fits &= np.arange(1, len(left) + 1) * (n * m) ** 2 <= _CHUNK_BYTES // (8 * 4)
        count = max(1, len(left) if fits.all() else int(fits.argmin()))
        yield left[:count]
        left = left[count:]


class _Models:
    """Some lanes of a problem, lanes first, in float64; as wide as the largest of them."""

    def __init__(self, problem: HomomorphismProblem, lanes: Int[np.ndarray, " B"]):
        n, m = (int(size[lanes].max()) for size in (problem.source_size, problem.target_size))
        problem = dataclasses.replace(
            problem,
            source=problem.source[:n, :, :n],
            target=problem.target[:m, :, :m],
            source_labels=None if problem.source_labels is None else problem.source_labels[:n],
            target_labels=None if problem.target_labels is None else problem.target_labels[:m],
        )
        self.certificate = Certificate(problem, lanes)
        models = self.certificate.models
        self.source, self.target, self.labels = models[0], models[1], models[2:]
        n, m, num_actions = self.source.shape[1], self.target.shape[1], self.source.shape[2]
        rows = np.arange(n) < problem.source_size[lanes, None]
        columns = np.arange(m) < problem.target_size[lanes, None]
        self.real = rows[:, :, None] & columns[:, None]
        self.first = int(problem.anchored)
        self.free = self.real.copy()
        self.free[:, : self.first] = False
        is_row = np.broadcast_to(self.real[:, :, None], (len(rows), n, num_actions, m))
        of_labels = np.broadcast_to(rows[:, :, None, None], (len(rows), n, num_actions, problem.num_labels))
        self.is_row = np.concatenate([is_row, of_labels], axis=3)

    def part(self, index) -> _Models:
        """Some of the lanes."""
        new = object.__new__(_Models)
        for name, value in vars(self).items():
            if name == "labels":
                value = tuple(None if leaf is None else leaf[index] for leaf in value)
            elif name == "certificate":
                value = value.part(index)
            elif name != "first":
                value = value[index]
            setattr(new, name, value)
        return new

    def forward(self, f):
        """K f."""
        return forward(self.source, self.target, *self.labels, f)

    def adjoint(self, y):
        """K^T y."""
        return adjoint(self.source, self.target, *self.labels, y)


def _solve(models: _Models, tolerance: float, threshold: float) -> Answer:
    count = len(models.source)
    lower, upper = np.zeros(count), np.full(count, np.inf)
    steps, left = np.zeros(count, np.int32), np.arange(count)
    point = _start(models)
    maps = point.f.copy()
    for iteration in range(MAX_ITERATIONS + 1):
        found_lower, found_upper = models.certificate.bounds(point.f, point.plus - point.minus)
        is_better = found_upper < upper[left]
        maps[left[is_better]] = models.certificate.feasible(point.f)[is_better]
        lower[left], upper[left] = np.fmax(lower[left], found_lower), np.fmin(upper[left], found_upper)
        steps[left] = iteration
        is_finite = np.logical_and.reduce([np.isfinite(leaf).reshape(len(left), -1).all(axis=1) for leaf in point])
        goes_on = ~is_settled(lower[left], upper[left], tolerance, threshold) & is_finite
        if not goes_on.all():
            left, models, point = left[goes_on], models.part(goes_on), point.part(goes_on)
        if not left.size:
            break
        with np.errstate(all="ignore"):  # a lane that breaks down is found out by its point
            point = _step_of_each(models, point)
    dtype = models.certificate.dtype
    return Answer(lower.astype(dtype), upper.astype(dtype), steps, maps.astype(dtype))


def _start(models: _Models) -> _Point:
    """Uniform f and y, e well above |K f|, and z constant on the free entries: strictly feasible."""
    f = models.real / np.maximum(models.real.sum(axis=2, keepdims=True), 1)
    if models.first:
        f[:, 0] = np.eye(f.shape[2])[0]
    weight = 1.0 / models.is_row.sum(axis=(1, 2, 3))
    y = 0.5 * weight[:, None, None, None] * models.is_row
    e = 1.5 * np.abs(models.forward(f)).max(axis=(1, 2, 3)) + 0.1
    return _Point(f=f, e=e, plus=y, minus=y.copy(), z=weight[:, None, None] * models.free)


def _step_of_each(models: _Models, point: _Point) -> _Point:
    """The next points; NaN for lanes whose system is singular in float64, where rounding ends the work."""
    try:
        return _step(models, point)
    except np.linalg.LinAlgError:
        if len(point.e) == 1:
            return _Point(*(np.full_like(leaf, np.nan) for leaf in point))
    halves = (slice(None, len(point.e) // 2), slice(len(point.e) // 2, None))
    found = [_step_of_each(models.part(half), point.part(half)) for half in halves]
    return _Point(*map(np.concatenate, zip(*found, strict=True)))


def _step(models: _Models, point: _Point) -> _Point:
    product, e = models.forward(point.f), point.e[:, None, None, None]
    masks = (models.is_row, models.is_row, models.free)
    # The three products y s. Where an entry does not exist, 1 stands in for its s and 0 for its y.
    slacks = (e - product, e + product, point.f)
    primal = tuple(np.where(mask, s, 1.0) for mask, s in zip(masks, slacks, strict=True))
    dual = (point.plus, point.minus, point.z)
    direction = _factorise(models, *(y / s for y, s in zip(dual, primal, strict=True)))
    number = sum(_sum(mask) for mask in masks)

    def move(goals):
        df, change, de, *new_dual = direction(*(goal / s for goal, s in zip(goals, primal, strict=True)))
        wide = de[:, None, None, None]
        d_primal = (np.where(masks[0], wide - change, 0.0), np.where(masks[0], wide + change, 0.0), df)
        d_dual = tuple(new - old for new, old in zip(new_dual, dual, strict=True))
        return d_primal, d_dual, de, (_longest(primal, d_primal), _longest(dual, d_dual))

    mu = sum(_sum(y * s) for y, s in zip(dual, primal, strict=True)) / number
    d_primal, d_dual, _, (on_primal, on_dual) = move(tuple(np.zeros_like(y) for y in dual))
    ahead = sum(
        _sum((s + _wide(on_primal, s) * ds) * (y + _wide(on_dual, s) * dy))
        for s, y, ds, dy in zip(primal, dual, d_primal, d_dual, strict=True)
    )
    mu *= np.clip(ahead / number / mu, 0.0, 1.0) ** 3
    goals = tuple(
        np.where(mask, _wide(mu, ds) - ds * dy, 0.0) for mask, ds, dy in zip(masks, d_primal, d_dual, strict=True)
    )
    d_primal, d_dual, de, (on_primal, on_dual) = move(goals)
    on_primal, on_dual = (np.minimum(1.0, _TO_BOUNDARY * length) for length in (on_primal, on_dual))
    plus, minus, z = (y + _wide(on_dual, y) * dy for y, dy in zip(dual, d_dual, strict=True))
    return _Point(
        f=point.f + _wide(on_primal, point.f) * d_primal[2], e=point.e + on_primal * de, plus=plus, minus=minus, z=z
    )


def _factorise(models: _Models, d_plus, d_minus, d_f) -> Callable:
    """As `newton.factorise`, which says what is eliminated how."""
    first, free = models.first, models.free[:, models.first :]
    lanes, rows, m = free.shape
    size = rows * m
    is_free = free.reshape(lanes, size)
    normal = normal_matrices(models.source, models.target, d_plus + d_minus, first, *models.labels)
    if not is_free.all():
        normal *= is_free[:, :, None] & is_free[:, None]
    index = np.arange(size)
    normal[:, index, index] += np.where(is_free, d_f[:, first:].reshape(lanes, size), 1.0)
    factor = inverse_factors(normal)
    coupling = np.where(models.free, models.adjoint(d_plus - d_minus), 0.0)[:, first:].reshape(lanes, size)
    on_rows = (factor.reshape(lanes, size, rows, 1, m) @ free[:, None, :, :, None].astype(float))[..., 0, 0]
    behind = np.concatenate([on_rows, (factor @ coupling[..., None])], axis=2)  # W (E^T, c)
    border = behind.transpose(0, 2, 1) @ behind
    border[:, -1, -1] -= (d_plus + d_minus).sum(axis=(1, 2, 3))
    corner = np.arange(rows)
    border[:, corner, corner] += ~free.any(axis=2)

    def direction(r_plus, r_minus, r_f):
        pull = np.where(models.free, r_f - models.adjoint(r_plus - r_minus), 0.0)[:, first:].reshape(lanes, size, 1)
        base = factor @ pull
        right = -behind.transpose(0, 2, 1) @ base
        right[:, -1, 0] += 1.0 - (r_plus + r_minus).sum(axis=(1, 2, 3))
        multipliers = np.linalg.solve(border, right)
        df = np.zeros_like(r_f)
        moved = factor.transpose(0, 2, 1) @ (base + behind @ multipliers)
        df[:, first:] = moved.reshape(lanes, rows, m)
        de, change = multipliers[:, -1, 0], models.forward(df)
        wide = de[:, None, None, None]
        new_plus = np.where(models.is_row, r_plus - d_plus * (wide - change), 0.0)
        new_minus = np.where(models.is_row, r_minus - d_minus * (wide + change), 0.0)
        return df, change, de, new_plus, new_minus, np.where(models.free, r_f - d_f * df, 0.0)

    return direction


def _sum(array):
    return array.reshape(len(array), -1).sum(axis=1)


def _wide(numbers, like):
    return numbers.reshape(-1, *(1,) * (like.ndim - 1))


def _longest(values, changes):
    """Largest steps [P] in [0, 1 / _TO_BOUNDARY] that keep every value + step * change non-negative."""
    shrinking = [
        np.where(change < 0, -change / value, 0.0).reshape(len(value), -1).max(axis=1)
        for value, change in zip(values, changes, strict=True)
    ]
    return 1.0 / np.maximum(np.maximum.reduce(shrinking), _TO_BOUNDARY)
