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
import scipy

from jaxhom.similarity.free_bounds import rounded_down
from jaxhom.similarity.homomorphism_lp import HomomorphismProblem
from jaxhom.similarity.host_certificates import Certificate

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

_LEVELS = (0.25,)  # tried before the threshold, where they are well above: what is proved there serves more thresholds
_WELL_ABOVE = 2.0  # times the threshold
_BAND_SHARE = 0.5  # of the tolerance, above the threshold: different is what is proved to be beyond that
_LEAST_SHRINKAGE = 0.1  # of the widths, in a sweep: with less, they are left as they are
_CHUNK_ENTRIES = 2**18  # of the slacks of the pairs that are looked at together: they fit into the cache
_EPS = np.finfo(np.float64).eps


def bounds_by_intervals(
    problem: HomomorphismProblem, threshold: float, tolerance: float
) -> tuple[Float[np.ndarray, " P"], Float[np.ndarray, " P"]]:
    """Lower and upper bounds on the errors of P programs, 0 and infinity where nothing was found.

    A pair has either a lower bound above the threshold, or the error of a map, which need not be within it.

    Args:
      problem: NumPy arrays.
      threshold, tolerance: of the decision; an error between threshold and threshold + tolerance may count as either.
    """
    dtype = problem.source.dtype
    n, num_actions, _, count = problem.source.shape
    lower, upper = np.zeros(count, dtype), np.full(count, np.inf, dtype)
    base = threshold + _BAND_SHARE * tolerance
    levels = np.array([*(level for level in _LEVELS if level > _WELL_ABOVE * base), base])
    proved = rounded_down(levels, dtype)
    chunk = max(1, _CHUNK_ENTRIES // (2 * n * num_actions * (len(problem.target) + 2 * problem.num_labels)))
    for start in range(0, count, chunk):
        waiting = np.arange(start, min(start + chunk, count))
        boxes = _Boxes.whole(Certificate(problem, waiting))
        level = np.zeros(len(waiting), int)
        while waiting.size:
            before = boxes.widths()
            is_empty = boxes.shrink(levels[level])
            lower[waiting[is_empty]] = proved[level[is_empty]]
            is_still = ~is_empty & ~(boxes.widths() < (1.0 - _LEAST_SHRINKAGE) * before)
            is_last = is_still & (level == len(levels) - 1)
            if is_last.any():
                upper[waiting[is_last]] = boxes.part(is_last).errors_inside()
            level = level + is_still
            going = ~is_empty & ~is_last
            if not going.all():
                boxes, waiting, level = boxes.part(going), waiting[going], level[going]
    return lower, upper


class _Blocks(NamedTuple):
    """Blocks on the diagonal of a matrix of weights >= 0, one of a shape for every pair, compressed by columns.

    Attributes:
      weight: [E], positive. row: int [E], in the whole matrix. start: int [P * columns + 1], where columns begin.
      shape: rows and columns of a block.
    """

    weight: np.ndarray
    row: np.ndarray
    start: np.ndarray
    shape: tuple[int, int]

    @classmethod
    def of(cls, columns: Float[np.ndarray, "P columns rows"]) -> _Blocks:
        count, num_columns, num_rows = columns.shape
        pair, column, row = np.nonzero(columns)
        start = np.zeros(count * num_columns + 1, np.int64)
        np.cumsum(np.bincount(pair * num_columns + column, minlength=count * num_columns), out=start[1:])
        return cls(columns[pair, column, row], pair * num_rows + row, start, (num_rows, num_columns))

    def part(self, kept: Bool[np.ndarray, " P"]) -> _Blocks:
        """Those of some pairs."""
        rows, columns = self.shape
        (old,) = np.nonzero(kept)
        counts = np.diff(self.start).reshape(-1, columns)
        in_pair = counts.sum(axis=1)
        is_kept = np.repeat(kept, in_pair)
        moved = np.repeat((old - np.arange(len(old))) * rows, in_pair[old])
        start = np.append(0, np.cumsum(counts[old]))
        return _Blocks(self.weight[is_kept], self.row[is_kept] - moved, start, self.shape)

    def times(self, matrices: np.ndarray) -> np.ndarray:
        """Products with [P, columns, K]: [P, rows, K]."""
        count, columns, width = matrices.shape
        shape = (count * self.shape[0], count * columns)
        whole = scipy.sparse.csc_array((self.weight, self.row, self.start), shape=shape)
        return (whole @ matrices.reshape(-1, width)).reshape(count, -1, width)

    def least(self, slack: np.ndarray) -> np.ndarray:
        """Least of slack [P, rows, K] / weight over the entries of each column: [P, columns, K], infinite over none."""
        count, _, width = slack.shape
        found = np.full((len(self.start) - 1, width), np.inf)
        (filled,) = np.nonzero(np.diff(self.start))
        if filled.size:
            shares = slack.reshape(-1, width)[self.row] / self.weight[:, None]
            found[filled] = np.minimum.reduceat(shares, self.start[filled], axis=0)
        return found.reshape(count, -1, width)


class _Boxes(NamedTuple):
    """The boxes of P maps, and what shrinks them.

    Attributes:
      bounds: [P, n, 2, m], L and U.
      source: T, columns (i, a) by j. target: T' and labels, columns (a, k or label) by l.
      labels: [P, A, 2 L, n], what the sums of the labels' columns are to be.
      rounding: [P], what sums can be off by.
      certificate: of the pairs.
    """

    bounds: np.ndarray
    source: _Blocks
    target: _Blocks
    labels: np.ndarray
    rounding: np.ndarray
    certificate: Certificate

    @classmethod
    def whole(cls, certificate: Certificate) -> _Boxes:
        """All maps, and those alone."""
        (source, target, *labels), rows, columns = certificate.models, certificate.rows, certificate.columns
        (count, n), m = rows.shape, columns.shape[1]
        own, their = source[..., :0], target[..., :0]
        if labels[0] is not None:
            own, their = _from_both_ends(*labels, rows, columns)
        bounds = np.zeros((count, n, 2, m))
        bounds[:, :, 1] = rows[:, :, None] & columns[:, None]
        if certificate.anchored:
            bounds[:, 0] = np.eye(m)[0]
        return cls(
            bounds,
            _Blocks.of(source.transpose(0, 3, 1, 2).reshape(count, n, -1)),
            _Blocks.of(np.concatenate([target, their], axis=3).reshape(count, m, -1)),
            own.transpose(0, 2, 3, 1),
            8.0 * (n + m) ** 2 * _EPS * certificate.largest,
            certificate,
        )

    def part(self, kept: Bool[np.ndarray, " P"]) -> _Boxes:
        """Those of some pairs."""
        return _Boxes(*(leaf.part(kept) if hasattr(leaf, "part") else leaf[kept] for leaf in self))

    def widths(self) -> Float[np.ndarray, " P"]:
        """Sums of U - L."""
        return (self.bounds[:, :, 1] - self.bounds[:, :, 0]).sum(axis=(1, 2))

    def shrink(self, epsilon: Float[np.ndarray, " P"]) -> Bool[np.ndarray, " P"]:
        """One sweep for e <= epsilon, in place; which boxes are empty, rounding included."""
        bounds = self.bounds
        count, n, _, m = bounds.shape
        allowed = (epsilon + self.rounding)[:, None, None, None]
        ours = self.source.times(bounds.reshape(count, n, 2 * m)).reshape(count, n, -1, 2, m)
        theirs = self.target.times(bounds.transpose(0, 3, 2, 1).reshape(count, m, 2 * n))
        theirs = theirs.reshape(count, ours.shape[2], -1, 2, n)
        moved = theirs[:, :, :m].transpose(0, 4, 1, 3, 2)  # as `ours`
        # How far one sum is from being too small, and the other: the first lets entries of T f fall, and of f T' rise.
        slack = np.stack([ours[..., 1, :] - moved[..., 0, :], moved[..., 1, :] - ours[..., 0, :]], axis=3)
        slack += allowed[..., None]
        other = np.empty_like(theirs)
        other[:, :, :m] = slack[..., ::-1, :].transpose(0, 2, 4, 3, 1)
        other[:, :, m:, 0] = theirs[:, :, m:, 1] - self.labels + allowed
        other[:, :, m:, 1] = self.labels - theirs[:, :, m:, 0] + allowed
        is_empty = (other < 0.0).any(axis=(1, 2, 3, 4))
        room = self.target.least(other.reshape(count, -1, 2 * n)).reshape(count, m, 2, n).transpose(0, 3, 2, 1)
        room = np.minimum(room, self.source.least(slack.reshape(count, -1, 2 * m)).reshape(bounds.shape))
        low, high = bounds[:, :, 0], bounds[:, :, 1]
        new_low = np.maximum(low, high - room[:, :, 0] - 4.0 * _EPS)
        new_high = np.minimum(high, low + room[:, :, 1] + 4.0 * _EPS)
        sums, noise = (new_low.sum(axis=2), new_high.sum(axis=2)), 4.0 * m * m * _EPS
        is_row = self.certificate.rows
        is_empty |= (is_row & ((sums[0] > 1.0 + noise) | (sums[1] < 1.0 - noise))).any(axis=1)
        is_empty |= (new_low > new_high + noise).any(axis=(1, 2))
        np.maximum(new_low, np.where(is_row, 1.0 - sums[1] - noise, 0.0)[:, :, None] + new_high, out=low)
        np.minimum(new_high, np.where(is_row, 1.0 - sums[0] + noise, 0.0)[:, :, None] + new_low, out=high)
        return is_empty

    def errors_inside(self) -> Float[np.ndarray, " P"]:
        """Upper bounds from the maps that are at the same part of the way from L to U everywhere in a row."""
        low, high = self.bounds[:, :, 0], self.bounds[:, :, 1]
        width = high - low
        total = width.sum(axis=2, keepdims=True)
        way = np.divide(1.0 - low.sum(axis=2, keepdims=True), total, out=np.zeros_like(total), where=total > 0.0)
        return self.certificate.upper(low + way * width)


def _from_both_ends(ours, theirs, rows, columns) -> tuple[np.ndarray, np.ndarray]:
    """Labels [P, n, A, 2 L] and [P, m, A, 2 L], less the least of l', and the largest less labels; l' is then >= 0."""
    is_state = columns[:, :, None, None]
    least = np.where(is_state, theirs, np.inf).min(axis=1, keepdims=True)
    largest = np.where(is_state, theirs, -np.inf).max(axis=1, keepdims=True)

    def both(labels, is_real):
        return np.where(is_real, np.concatenate([labels - least, largest - labels], axis=3), 0.0)

    return both(ours, rows[:, :, None, None]), both(theirs, is_state)
