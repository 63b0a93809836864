"""Bounds on the errors of LP (9) that cost no iterations: they decide many pairs that are clearly different.

Of each model a few numbers are enough, its `Profile`; many pairs of few models are compared without their tensors.

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

if TYPE_CHECKING:
    from jaxtyping import Float

_MAX_EXPECTATIONS = 512  # per model: with many actions, those of two steps ahead are left out
_CHUNK_ENTRIES = 2**21  # of expectations that are compared at a time
_EPS = np.finfo(np.float64).eps


class Profile(NamedTuple):
    """What bounds need of P models, in float64; V numbers of states are expected A times.

    Attributes:
      stays, leaves, arrives: [P, A], of the centre: T(0,a,0), sum_{j != 0} T(0,a,j), and max_{k != 0} T(0,a,k).
      labels: [P, A, L], of the centre.
      expects: [P, A, V], what the centre expects of labels, and of what is expected of them a step later.
      num_successors: [P, A], of the centre.
      keeps: [P, V], c, as far as the target has a say.
      width, size: [P, V], how far the numbers are apart, and the largest of them.
      rows: [P], largest sum of a row, at least 1.
      rounding: [P], of probabilities, in the type of the models: equal ones may differ by it in theirs. That of labels
        is this times `largest`, [P].
    """

    stays: np.ndarray
    leaves: np.ndarray
    arrives: np.ndarray
    labels: np.ndarray
    expects: np.ndarray
    num_successors: np.ndarray
    keeps: np.ndarray
    width: np.ndarray
    size: np.ndarray
    rows: np.ndarray
    rounding: np.ndarray
    largest: np.ndarray

    @classmethod
    def of(cls, models: Float[np.ndarray, "P n A n"], labels: Float[np.ndarray, "P n A L"] | None = None) -> Profile:
        """Profiles of models whose padding, if any, is zero."""
        rounding, models = (models.shape[1] + 8.0) * np.finfo(models.dtype).eps, models.astype(np.float64)
        count, n, num_actions, _ = models.shape
        labels = np.zeros((count, n, num_actions, 0)) if labels is None else labels.astype(np.float64)
        kept = labels.reshape(count, n, -1)
        keeps = np.ones((count, kept.shape[2]))
        if num_actions * kept.shape[2] * (1 + num_actions) <= _MAX_EXPECTATIONS:
            ahead = (models.reshape(count, -1, n) @ kept).reshape(count, n, -1)
            later = np.tile(keeps + np.abs(kept).sum(axis=1), num_actions)
            kept, keeps = np.concatenate([kept, ahead], axis=2), np.append(keeps, later, axis=1)
        centre = models[:, 0]
        away = centre[:, :, 1:]
        return cls(
            stays=centre[:, :, 0],
            leaves=away.sum(axis=2),
            arrives=away.max(axis=2, initial=-1.0),
            labels=labels[:, 0],
            expects=centre @ kept,
            num_successors=(centre > 0.0).sum(axis=2),
            keeps=keeps,
            width=kept.max(axis=1) - kept.min(axis=1),
            size=np.abs(kept).max(axis=1, initial=0.0),
            rows=np.maximum(models.sum(axis=3).max(axis=(1, 2)), 1.0),
            rounding=np.full(count, rounding),
            largest=np.abs(labels).max(axis=(1, 2, 3), initial=0.0),
        )

    def of_models(self, index) -> Profile:
        """Those of some of the models."""
        return Profile(*(leaf[index] for leaf in self))


def lower_bounds_without_iterations(models: ModelPairs) -> Float[np.ndarray, " P"]:
    """Lower bounds on the anchored errors of P pairs of models, in their type."""
    sides = Profile.of(models.source, models.source_labels), Profile.of(models.target, models.target_labels)
    bounds = np.zeros(len(models.pairs), models.dtype)
    chunk = max(1, _CHUNK_ENTRIES // max(1, *(leaf[:1].size for leaf in sides[0])))
    for start in range(0, len(bounds), chunk):
        part = slice(start, start + chunk)
        chosen = (side.of_models(index) for side, index in zip(sides, models.pairs[part].T, strict=True))
        bounds[part] = rounded_down(_lower_bounds(*chosen), models.dtype)
    return bounds


def rounded_down(bounds: np.ndarray, dtype) -> np.ndarray:
    """Lower bounds in another type, none of them larger than before."""
    rounded = bounds.astype(dtype)
    return np.where(rounded > bounds, np.nextafter(rounded, rounded.dtype.type(0)), rounded)


def _lower_bounds(source: Profile, target: Profile) -> Float[np.ndarray, " P"]:
    """Lower bounds on the anchored errors of P pairs, from profiles [P] of both sides; float64, rounding included."""
    rounding = source.rounding + target.rounding
    staying = (source.stays - target.stays).max(axis=1)
    leaving = (target.arrives - source.leaves).max(axis=1)
    bound = np.maximum(staying, leaving) - rounding
    apart = np.abs(source.labels - target.labels).max(axis=(1, 2), initial=0.0)
    bound = np.maximum(bound, apart * (1.0 - 4.0 * _EPS))
    if source.expects.shape[2]:
        uneven = np.abs(source.stays + source.leaves - target.stays - target.leaves)[:, :, None]
        difference = np.abs(source.expects - target.expects) - uneven * target.size[:, None]
        difference -= (4.0 * rounding * np.maximum(source.largest, target.largest))[:, None, None]
        factor = target.keeps[:, None] + target.num_successors[:, :, None] * target.width[:, None]
        bound = np.maximum(bound, (difference / factor).max(axis=(1, 2)) / source.rows**2 * (1.0 - 8.0 * _EPS))
    return np.maximum(bound, 0.0)


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
