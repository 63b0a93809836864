"""Bounds on the errors of LP (9) that cost no iterations: they decide many pairs that are clearly different."""

from __future__ import annotations

import numpy as np


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


def upper_bounds_without_iterations(source, source_labels, target_labels) -> np.ndarray:
    """[P]: |K f| <= 1 for every map f, and what labels differ by is within their range."""
    bound = np.ones(len(source), source.dtype)
    if source_labels is None:
        return bound
    axes = (1, 2, 3)
    highest = (labels.max(axis=axes, initial=0.0) for labels in (source_labels, target_labels))
    lowest = (labels.min(axis=axes, initial=0.0) for labels in (source_labels, target_labels))
    width = np.maximum(*highest) - np.minimum(*lowest)
    return np.maximum(bound, width * (1.0 + 4.0 * np.finfo(source.dtype).eps)).astype(source.dtype)
