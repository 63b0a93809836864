"""Bounds of LP (9) from a map and a dual point, evaluated in float64 with NumPy whatever the iteration ran in.

An iteration in float32 finds a map and a dual point that are good to some seven digits, but its own bounds are widened
by the rounding of sums that grow with the models. The points prove more than that: `certified_bounds` makes them
feasible, evaluates their products in float64 and rounds outwards. `homomorphism_lp` has the notation.
"""

from __future__ import annotations

import numpy as np

from jaxhom.similarity.homomorphism_lp import HomomorphismProblem

_CHUNK_ENTRIES = 2**22  # 32 MB in float64
_EPS = np.finfo(np.float64).eps


def certified_bounds(problem: HomomorphismProblem, f: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bounds [P] that points prove, in the points' dtype.

    Args:
      problem: P programs, NumPy arrays, lanes last.
      f: [n, m, P], nearly maps. y: [n, A, m + L, P], any.
    """
    count = f.shape[-1]
    chunk = max(1, _CHUNK_ENTRIES // max(1, sum(a[..., 0].size for a in (problem.source, problem.target, f, y))))
    lower, upper = np.zeros(count, f.dtype), np.zeros(count, f.dtype)
    for start in range(0, count, chunk):
        part = slice(start, start + chunk)
        points = _lanes_first(f[..., part]), _lanes_first(y[..., part])
        lower[part], upper[part] = Certificate(problem, part).bounds(*points)
    return lower, upper


class Certificate:
    """What points prove of some lanes of a problem.

    Args:
      problem: NumPy arrays, lanes last.
      lanes: which ones.

    Attributes:
      models: T, T', l and l' of the lanes, these first, in float64; the last two None without labels.
      dtype: of the problem's models.
      anchored: whether the centre is mapped to the centre.
      rows: bool [P, n], the states of each source. columns: bool [P, m], those of each target.
      largest: [P], as `HomomorphismProblem.largest`.
    """

    def __init__(self, problem: HomomorphismProblem, lanes: slice | np.ndarray):
        arrays = (problem.source, problem.target, problem.source_labels, problem.target_labels)
        self.models = tuple(None if a is None else _lanes_first(a[..., lanes]) for a in arrays)
        self.dtype, self.anchored = problem.source.dtype, problem.anchored
        self.rows = np.arange(self.models[0].shape[1]) < problem.source_size[lanes, None]
        self.columns = np.arange(self.models[1].shape[1]) < problem.target_size[lanes, None]
        self.largest = np.broadcast_to(_largest(*self.models[2:]), len(self.rows))

    def part(self, index) -> Certificate:
        """That of some of the lanes."""
        new = object.__new__(Certificate)
        new.models = tuple(None if leaf is None else leaf[index] for leaf in self.models)
        new.dtype, new.anchored = self.dtype, self.anchored
        new.rows, new.columns, new.largest = self.rows[index], self.columns[index], self.largest[index]
        return new

    def feasible(self, f: np.ndarray) -> np.ndarray:
        """The maps [P, n, m] that points f nearly are."""
        f = np.where(self.rows[:, :, None] & self.columns[:, None], np.maximum(f, 0.0), 0.0)
        f /= np.where(self.rows, f.sum(axis=2), 1.0)[:, :, None]
        if self.anchored:
            f[:, 0] = np.eye(f.shape[2])[0]
        return f

    def upper(self, f: np.ndarray) -> np.ndarray:
        """Upper bounds [P] that f [P, n, m], nearly maps, prove; float64."""
        error = np.abs(forward(*self.models, self.feasible(f))).max(axis=(1, 2, 3))
        n, m = f.shape[1:]
        return (error + 2.0 * (n + m + 4) * _EPS * self.largest) * (1.0 + np.finfo(self.dtype).eps)

    def bounds(self, f: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds [P], from f [P, n, m], nearly maps, and y [P, n, A, m + L], any; float64."""
        rows, columns = self.rows, self.columns
        y = y / np.maximum(np.abs(y).sum(axis=(1, 2, 3)), 1.0)[:, None, None, None]
        slopes = np.where(columns[:, None], adjoint(*self.models, y), np.inf)
        lowest = slopes.min(axis=2)
        if self.anchored:
            lowest[:, 0] = slopes[:, 0, 0]
        value = np.where(rows, lowest, 0.0).sum(axis=1)
        (_, n, num_actions, width), m = y.shape, f.shape[2]
        terms = num_actions * (n + 2 * width) + 2 * n + 2 * m + 8  # as in `HomomorphismProblem.rounding`, with room
        rounding = terms * _EPS * self.largest
        outward = np.finfo(self.dtype).eps  # of the conversion to the dtype of the models
        return np.maximum(value - rounding, 0.0) * (1.0 - outward), self.upper(f)


def forward(source, target, source_labels, target_labels, f) -> np.ndarray:
    """K f of P programs, lanes first: [P, n, A, m + L]."""
    count, n, num_actions, _ = source.shape
    m = target.shape[1]
    moved = source.reshape(count, n * num_actions, n) @ f
    moved = moved.reshape(count, n, num_actions, m)
    product = moved - (f @ target.reshape(count, m, num_actions * m)).reshape(moved.shape)
    if source_labels is None:
        return product
    kept = f.sum(axis=2)[:, :, None, None] * source_labels
    arriving = (f @ target_labels.reshape(count, m, -1)).reshape(kept.shape)
    return np.concatenate([product, kept - arriving], axis=3)


def adjoint(source, target, source_labels, target_labels, y) -> np.ndarray:
    """K^T y of P programs, lanes first: [P, n, m]."""
    count, n, num_actions, _ = source.shape
    m = target.shape[1]
    on_states, on_labels = y[..., :m], y[..., m:]
    flat = source.reshape(count, n * num_actions, n).transpose(0, 2, 1)
    product = flat @ on_states.reshape(count, n * num_actions, m)
    flat = target.reshape(count, m, num_actions * m).transpose(0, 2, 1)
    product = product - on_states.reshape(count, n, num_actions * m) @ flat
    if source_labels is None:
        return product
    kept = (source_labels * on_labels).sum(axis=(2, 3))[:, :, None]
    flat = target_labels.reshape(count, m, -1).transpose(0, 2, 1)
    return product + kept - on_labels.reshape(count, n, -1) @ flat


def _largest(source_labels, target_labels):
    """As `HomomorphismProblem.largest`."""
    if source_labels is None:
        return 1.0
    size = (np.abs(labels).max(axis=(1, 2, 3), initial=0.0) for labels in (source_labels, target_labels))
    return np.maximum(sum(size), 1.0)


def _lanes_first(array: np.ndarray) -> np.ndarray:
    return np.moveaxis(array, -1, 0).astype(np.float64)
