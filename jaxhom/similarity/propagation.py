"""Decisions about LP (9) by intervals: what e <= epsilon leaves of every entry of the map, without a solver.

Where e <= epsilon, some map f within bounds L <= f <= U, at first [0, 1] and the anchor, has for all i, a, k

    |sum_j T(i,a,j) f(j,k) - sum_l f(i,l) T'(l,a,k)| <= epsilon.

The bounds make an interval of either sum. What the other sum can be at most, less what the rest of this one is at
least, is left for any one entry: f(j,k) <= L(j,k) + slack(i,a,k) / T(i,a,j). Rows that sum to one bound it too. Sweeps
over all entries shrink the box. An empty one proves e > epsilon; a map inside, whose error is evaluated
(`host_certificates`), proves the other side if it is good enough. Deterministic models have nothing else at epsilon =
0: from the centre on each step names the image of a state. Labels are more columns, whose first sum is known. Shifted
to be nonnegative they are rows of T' like any others, and as rows sum to one both l' less its least and its largest
less l' can be asked for.

Everything is in float64, NumPy, with the nonzero entries of many pairs as one block-diagonal matrix.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jaxhom.similarity.blocks import Blocks
from jaxhom.similarity.host_certificates import Certificate
from jaxhom.similarity.model_pairs import ModelPairs
from jaxhom.solvers.outward import rounded_down

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

_LEVELS = (0.25,)  # tried before the threshold, where they are well above: what is proved there serves more thresholds
_WELL_ABOVE = 2.0  # times the threshold
_BAND_SHARE = 0.5  # of the tolerance, above the threshold: different is what is proved to be beyond that
_LEAST_SHRINKAGE = 0.1  # of the widths, in a sweep: with less, they are left as they are
_NARROW = 0.1  # of the tolerance: what is left of the widths then makes no difference
_CHUNK_ENTRIES = 2**17  # of the slacks of the pairs that are looked at together: they fit into the cache
_MAX_WORK = 2**28  # entries of models times entries of maps, of a pair: seconds for a sweep
_EPS = np.finfo(np.float64).eps


def bounds_by_intervals(
    models: ModelPairs, asked: Int[np.ndarray, " Q"], threshold: float, tolerance: float
) -> tuple[Float[np.ndarray, " Q"], Float[np.ndarray, " Q"]]:
    """Lower and upper bounds on the errors of some pairs of models, 0 and infinity where nothing was found.

    A pair has either a lower bound above the threshold, or the error of a map, which need not be within it.

    Args:
      models: the pairs.
      asked: which of them.
      threshold, tolerance: of the decision; an error between threshold and threshold + tolerance may count as either.
    """
    lower, upper = np.zeros(len(asked), models.dtype), np.full(len(asked), np.inf, models.dtype)
    base = threshold + _BAND_SHARE * tolerance
    levels = np.array([*(level for level in _LEVELS if level > _WELL_ABOVE * base), base])
    proved = rounded_down(levels, models.dtype)
    sides = _Sides.of(models)
    (affordable,) = np.nonzero(sides.work(models.pairs[asked]) <= _MAX_WORK)
    _, n, num_actions, _ = models.source.shape
    chunk = max(1, _CHUNK_ENTRIES // (2 * n * num_actions * (models.target.shape[1] + 2 * models.num_labels)))
    for start in range(0, len(affordable), chunk):
        waiting = affordable[start : start + chunk]
        boxes = sides.boxes(models.pairs[asked[waiting]])
        level = np.zeros(len(waiting), int)
        while waiting.size:
            slacks = boxes.slacks(levels[level])
            is_empty = (slacks[1] < 0.0).any(axis=(1, 2, 3))
            lower[waiting[is_empty]] = proved[level[is_empty]]
            waiting, level, boxes = waiting[~is_empty], level[~is_empty], boxes.part(~is_empty)
            if not waiting.size:
                break
            before = boxes.widths()
            is_empty = boxes.shrink(*(slack[~is_empty] for slack in slacks))
            lower[waiting[is_empty]] = proved[level[is_empty]]
            widths = boxes.widths()
            is_shrinking = (widths < (1.0 - _LEAST_SHRINKAGE) * before) & (widths > _NARROW * tolerance)
            is_still = ~is_empty & ~is_shrinking
            is_last = is_still & (level == len(levels) - 1)
            if is_last.any():
                last = waiting[is_last]
                maps = boxes.part(is_last).maps_inside()
                upper[last] = Certificate(models.problem(asked[last]), slice(None)).upper(maps)
            level = level + is_still
            going = ~is_empty & ~is_last
            waiting, level, boxes = waiting[going], level[going], boxes.part(going)
    return lower, upper


class _Sides(NamedTuple):
    """What boxes are made of, once for each model: blocks as `_Boxes` has them, and of labels the range in targets."""

    source: Blocks
    target: Blocks
    is_row: np.ndarray
    is_column: np.ndarray
    labels: np.ndarray
    least: np.ndarray
    largest: np.ndarray
    size: tuple[np.ndarray, np.ndarray]
    anchored: bool

    @classmethod
    def of(cls, models: ModelPairs) -> _Sides:
        """Of all models; labels that are not there are none."""
        source, target = models.source.astype(np.float64), models.target.astype(np.float64)
        ours, theirs = source[..., :0], target[..., :0]
        if models.source_labels is not None:
            ours, theirs = models.source_labels.astype(np.float64), models.target_labels.astype(np.float64)
        is_row, is_column = models.masks()
        is_state = is_column[:, :, None, None]
        least = np.where(is_state, theirs, np.inf).min(axis=1)
        largest = np.where(is_state, theirs, -np.inf).max(axis=1)
        shifted = np.where(is_state, _from_both_ends(theirs, least[:, None], largest[:, None]), 0.0)
        target = np.concatenate([target, shifted], axis=3)
        return cls(
            Blocks.of(source.transpose(0, 3, 1, 2).reshape(*source.shape[:2], -1)),
            Blocks.of(target.reshape(*target.shape[:2], -1)),
            is_row,
            is_column,
            ours,
            least,
            largest,
            tuple(np.abs(side).max(axis=(1, 2, 3), initial=0.0) for side in (ours, theirs)),
            models.anchored,
        )

    def work(self, pairs: Int[np.ndarray, "P 2"]) -> Int[np.ndarray, " P"]:
        """Multiplications for each pair in a sweep, about."""
        (one, other), n, m = pairs.T, self.is_row.shape[1], self.is_column.shape[1]
        return 2 * (self.source.num_entries()[one] * m + self.target.num_entries()[other] * n)

    def boxes(self, pairs: Int[np.ndarray, "P 2"]) -> _Boxes:
        """All maps of pairs of models, and those alone."""
        one, other = pairs.T
        is_row, is_column = self.is_row[one], self.is_column[other]
        (count, n), m = is_row.shape, is_column.shape[1]
        bounds = np.zeros((count, n, 2, m))
        bounds[:, :, 1] = is_row[:, :, None] & is_column[:, None]
        if self.anchored:
            bounds[:, 0] = np.eye(m)[0]
        labels = _from_both_ends(self.labels[one], self.least[other][:, None], self.largest[other][:, None])
        labels = np.where(is_row[:, :, None, None], labels, 0.0).transpose(0, 2, 3, 1)
        rounding = 8.0 * (n + m) ** 2 * _EPS * np.maximum(self.size[0][one] + self.size[1][other], 1.0)
        return _Boxes(bounds, self.source.part(one), self.target.part(other), labels, is_row, rounding)


class _Boxes(NamedTuple):
    """The boxes of P maps, and what shrinks them.

    Attributes:
      bounds: [P, n, 2, m], L and U.
      source: T, columns (i, a) by j. target: T' and labels, columns (a, k or label) by l.
      labels: [P, A, 2 L, n], what the sums of the labels' columns are to be.
      is_row: bool [P, n], the states of the sources.
      rounding: [P], what sums can be off by.
    """

    bounds: np.ndarray
    source: Blocks
    target: Blocks
    labels: np.ndarray
    is_row: np.ndarray
    rounding: np.ndarray

    def part(self, kept: Bool[np.ndarray, " P"]) -> _Boxes:
        """Those of some pairs."""
        (index,) = np.nonzero(kept)
        return _Boxes(*(leaf.part(index) if isinstance(leaf, Blocks) else leaf[index] for leaf in self))

    def widths(self) -> Float[np.ndarray, " P"]:
        """Sums of U - L."""
        return (self.bounds[:, :, 1] - self.bounds[:, :, 0]).sum(axis=(1, 2))

    def slacks(self, epsilon: Float[np.ndarray, " P"]) -> tuple[np.ndarray, np.ndarray]:
        """How far sums are from where e > epsilon, [P, n A, 2, m] and, with labels, [P, A (m + 2 L), 2, n].

        The first of two lets entries of the sum at hand fall, the second lets them rise: T f and f T' in turn.
        """
        count, n, _, m = self.bounds.shape
        allowed = (epsilon + self.rounding)[:, None, None, None]
        ours = self.source.times(self.bounds.reshape(count, n, 2 * m)).reshape(count, n, -1, 2, m)
        theirs = self.target.times(self.bounds.transpose(0, 3, 2, 1).reshape(count, m, 2 * n))
        theirs = theirs.reshape(count, ours.shape[2], -1, 2, n)
        moved = theirs[:, :, :m].transpose(0, 4, 1, 3, 2)  # as `ours`
        slack, other = np.empty_like(ours), np.empty_like(theirs)
        np.subtract(ours[..., 1, :] + allowed, moved[..., 0, :], out=slack[..., 0, :])
        np.subtract(moved[..., 1, :] + allowed, ours[..., 0, :], out=slack[..., 1, :])
        other[:, :, :m] = slack[..., ::-1, :].transpose(0, 2, 4, 3, 1)
        other[:, :, m:, 0] = theirs[:, :, m:, 1] - self.labels + allowed
        other[:, :, m:, 1] = self.labels - theirs[:, :, m:, 0] + allowed
        return slack.reshape(count, -1, 2, m), other.reshape(count, -1, 2, n)

    def shrink(self, slack: np.ndarray, other: np.ndarray) -> Bool[np.ndarray, " P"]:
        """Cuts off, in place, what slacks rule out; which boxes are empty then, rounding included."""
        low, high = self.bounds[:, :, 0], self.bounds[:, :, 1]
        m = low.shape[2]
        room = np.minimum(self.source.least(slack), self.target.least(other).transpose(0, 3, 2, 1))
        new_low = np.maximum(low, high - room[:, :, 0] - 4.0 * _EPS)
        new_high = np.minimum(high, low + room[:, :, 1] + 4.0 * _EPS)
        noise = 4.0 * m * m * _EPS
        lacks = np.where(self.is_row, 1.0 - new_high.sum(axis=2) - noise, 0.0)
        has_left = np.where(self.is_row, 1.0 - new_low.sum(axis=2) + noise, 0.0)
        np.maximum(new_low, lacks[:, :, None] + new_high, out=low)
        np.minimum(new_high, has_left[:, :, None] + new_low, out=high)
        return (lacks > 0.0).any(axis=1) | (has_left < 0.0).any(axis=1) | (new_low > new_high).any(axis=(1, 2))

    def maps_inside(self) -> Float[np.ndarray, "P n m"]:
        """Those that are at the same part of the way from L to U everywhere in a row."""
        low, high = self.bounds[:, :, 0], self.bounds[:, :, 1]
        width = high - low
        total = width.sum(axis=2, keepdims=True)
        way = np.divide(1.0 - low.sum(axis=2, keepdims=True), total, out=np.zeros_like(total), where=total > 0.0)
        return low + way * width


def _from_both_ends(labels, least, largest) -> np.ndarray:
    """[..., 2 L]: less the least of the target's, and the largest of the target's less them; those are then >= 0."""
    return np.concatenate([labels - least, largest - labels], axis=-1)
