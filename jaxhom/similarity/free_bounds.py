"""Bounds on the errors of LP (9) that cost no iterations: they decide many pairs that are clearly different.

Of each model a few numbers are enough: many pairs of few models are compared without the tensors of each pair.

*The centre.* It is mapped to the centre, so (K f)(0,a,0) >= T(0,a,0) - T'(0,a,0): the maps of the other states only add
to it. And off the centre (K f)(0,a,k) <= sum_{j != 0} T(0,a,j) - T'(0,a,k): what leaves is all that can arrive. Labels
of the centre meet those of the centre alone.

*What lies ahead.* Let g, g' be numbers of the states of both models that a map keeps up to a few errors, |g - f g'| <=
c e, as it keeps labels with c = 1. Then it keeps their expectations after an action as well:

    T_a g - f T'_a g' = T_a (g - f g') + (K f)_a g',

where the first part is at most c e, and the second sum_k |g'(k)| e. At the centre, the second one is a difference of
two distributions: what the target's has in excess is at most e in each of its N successors, so the second part is at
most N e times the range of g' (and |g'| times the difference of the sums, if they differ). What centres expect of the
labels one and two steps ahead thus bounds e from below.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jaxhom.similarity.model_pairs import ModelPairs
from jaxhom.solvers.outward import rounded_down

if TYPE_CHECKING:
    from jaxtyping import Float

_MAX_EXPECTATIONS = 512  # per model: with many actions, those of two steps ahead are left out
_CHUNK_ENTRIES = 2**21  # of expectations that are compared at a time
_EPS = np.finfo(np.float64).eps


def lower_bounds_without_iterations(models: ModelPairs) -> Float[np.ndarray, " P"]:
    """Lower bounds on the anchored errors of P pairs of models, in their type."""
    parts = [(_Centre.of, _centres_apart)]
    if models.num_labels:
        parts.append((_Expectations.of, _expectations_apart))
    labels = models.source_labels, models.target_labels
    bounds = np.zeros(len(models.pairs), models.dtype)
    # Rows that are equal but for the rounding of the models' type are the same.
    rounding = (models.source.shape[1] + models.target.shape[1] + 16.0) * np.finfo(models.dtype).eps
    for profile_of, apart in parts:
        sides = [profile_of(*side) for side in zip((models.source, models.target), labels, strict=True)]
        chunk = max(1, _CHUNK_ENTRIES // max(1, sum(leaf[:1].size for leaf in sides[0])))
        for start in range(0, len(bounds), chunk):
            part = slice(start, start + chunk)
            one, other = (
                type(side)(*(leaf[index] for leaf in side))
                for side, index in zip(sides, models.pairs[part].T, strict=True)
            )
            bounds[part] = np.maximum(bounds[part], rounded_down(apart(one, other, rounding), models.dtype))
    return bounds


class _Centre(NamedTuple):
    """Of the centres of P models, [P, A] in float64: T(0,a,0), sum_{j != 0} T(0,a,j), and max_{k != 0} T(0,a,k)."""

    stays: np.ndarray
    leaves: np.ndarray
    arrives: np.ndarray

    @classmethod
    def of(cls, models: np.ndarray, labels: np.ndarray | None) -> _Centre:
        del labels
        centre = models[:, 0].astype(np.float64)
        return cls(centre[:, :, 0], centre[:, :, 1:].sum(axis=2), centre[:, :, 1:].max(axis=2, initial=-1.0))


def _centres_apart(source: _Centre, target: _Centre, rounding: float) -> Float[np.ndarray, " P"]:
    staying, leaving = source.stays - target.stays, target.arrives - source.leaves
    return np.maximum(staying, leaving).max(axis=1) - rounding


class _Expectations(NamedTuple):
    """What the centres of P models expect, in float64: of V numbers of states, after each of A actions.

    Attributes:
      labels: [P, A, L], of the centre itself.
      expects: [P, A, V], of labels, and of what is expected of them a step later.
      sums: [P, A], of the centre's rows. num_successors: [P, A], their entries.
      keeps: [P, V], c, as far as the target has a say.
      width, size: [P, V], how far the numbers are apart, and the largest of them.
      rows: [P], largest sum of a row, at least 1.
      largest: [P], of the labels.
    """

    labels: np.ndarray
    expects: np.ndarray
    sums: np.ndarray
    num_successors: np.ndarray
    keeps: np.ndarray
    width: np.ndarray
    size: np.ndarray
    rows: np.ndarray
    largest: np.ndarray

    @classmethod
    def of(cls, models: np.ndarray, labels: np.ndarray) -> _Expectations:
        """Of models whose padding, if any, is zero."""
        models, labels = models.astype(np.float64), labels.astype(np.float64)
        count, n, num_actions, _ = models.shape
        kept = labels.reshape(count, n, -1)
        keeps = np.ones((count, kept.shape[2]))
        if num_actions * kept.shape[2] * (1 + num_actions) <= _MAX_EXPECTATIONS:
            ahead = (models.reshape(count, -1, n) @ kept).reshape(count, n, -1)
            later = np.tile(keeps + np.abs(kept).sum(axis=1), num_actions)
            kept, keeps = np.concatenate([kept, ahead], axis=2), np.append(keeps, later, axis=1)
        centre = models[:, 0]
        return cls(
            labels=labels[:, 0],
            expects=centre @ kept,
            sums=centre.sum(axis=2),
            num_successors=(centre > 0.0).sum(axis=2),
            keeps=keeps,
            width=kept.max(axis=1) - kept.min(axis=1),
            size=np.abs(kept).max(axis=1),
            rows=np.maximum(models.sum(axis=3).max(axis=(1, 2)), 1.0),
            largest=np.abs(labels).max(axis=(1, 2, 3)),
        )


def _expectations_apart(source: _Expectations, target: _Expectations, rounding: float) -> Float[np.ndarray, " P"]:
    apart = np.abs(source.labels - target.labels).max(axis=(1, 2)) * (1.0 - 4.0 * _EPS)
    uneven = np.abs(source.sums - target.sums)[:, :, None]
    difference = np.abs(source.expects - target.expects) - uneven * target.size[:, None]
    difference -= (4.0 * rounding * np.maximum(source.largest, target.largest))[:, None, None]
    factor = target.keeps[:, None] + target.num_successors[:, :, None] * target.width[:, None]
    ahead = (difference / factor).max(axis=(1, 2)) / source.rows**2 * (1.0 - 8.0 * _EPS)
    return np.maximum(apart, ahead)


def upper_bounds_without_iterations(models: ModelPairs) -> Float[np.ndarray, " P"]:
    """|K f| <= 1 for every map f, and what labels differ by is within their range."""
    bound = np.ones(len(models.pairs), models.dtype)
    if models.source_labels is None:
        return bound
    labels, pairs = (models.source_labels, models.target_labels), models.pairs.T
    highest = (side.max(axis=(1, 2, 3), initial=0.0)[index] for side, index in zip(labels, pairs, strict=True))
    lowest = (side.min(axis=(1, 2, 3), initial=0.0)[index] for side, index in zip(labels, pairs, strict=True))
    width = np.maximum(*highest) - np.minimum(*lowest)
    return np.maximum(bound, width * (1.0 + 4.0 * np.finfo(models.dtype).eps)).astype(models.dtype)
