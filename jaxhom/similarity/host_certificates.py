"""Bounds of LP (9) from a map and a dual point, evaluated in float64 with NumPy whatever the iteration ran in.

An iteration in float32 finds a map and a dual point that are good to some seven digits, but its own bounds are widened
by the rounding of sums that grow with the models. The points prove more than that: `certified_bounds` makes them
feasible, evaluates their products in float64 and rounds outwards. `homomorphism_lp` has the notation.
"""

import numpy as np

from jaxhom.similarity.homomorphism_lp import HomomorphismProblem

_CHUNK_ENTRIES = 2**22  # 32 MB in float64


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
        lower[part], upper[part] = _bounds(problem, part, _lanes_first(f[..., part]), _lanes_first(y[..., part]))
    return lower, upper


def _bounds(problem: HomomorphismProblem, part: slice, f, y) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of some lanes; f [P, n, m] and y [P, n, A, m + L] in float64."""
    rows = np.arange(f.shape[1]) < problem.source_size[part, None]
    columns = np.arange(f.shape[2]) < problem.target_size[part, None]
    f = np.where(rows[:, :, None] & columns[:, None], np.maximum(f, 0.0), 0.0)
    f /= np.where(rows, f.sum(axis=2), 1.0)[:, :, None]
    if problem.anchored:
        f[:, 0] = np.eye(f.shape[2])[0]
    y = y / np.maximum(np.abs(y).sum(axis=(1, 2, 3)), 1.0)[:, None, None, None]
    labels = (problem.source_labels, problem.target_labels)
    models = [None if a is None else _lanes_first(a[..., part]) for a in (problem.source, problem.target, *labels)]
    error, largest = np.abs(forward(*models, f)).max(axis=(1, 2, 3)), _largest(*models[2:])
    slopes = np.where(columns[:, None], adjoint(*models, y), np.inf)
    lowest = slopes.min(axis=2)
    if problem.anchored:
        lowest[:, 0] = slopes[:, 0, 0]
    value = np.where(rows, lowest, 0.0).sum(axis=1)
    (_, n, num_actions, columns), m = y.shape, f.shape[2]
    terms = num_actions * (n + 2 * columns) + 2 * n + 2 * m + 8  # as in `HomomorphismProblem.rounding`, with room
    rounding = terms * np.finfo(np.float64).eps * largest
    outward = np.finfo(problem.source.dtype).eps  # of the conversion to the dtype of the models
    upper = (error + rounding) * (1.0 + outward)
    return np.maximum(value - rounding, 0.0) * (1.0 - outward), upper


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
