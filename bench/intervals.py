"""Means over independent draws and their 95% confidence intervals, by Student's t.

A ratio to the expert is the mean over draws of each draw's own ratio: reward and expert share the draw, so what they
have in common cancels.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
import scipy.stats

CONFIDENCE = 0.95


@dataclasses.dataclass(frozen=True)
class Interval:
    """A mean of `count` draws between `low` and `high`; one draw has no interval (NaN)."""

    mean: float
    low: float
    high: float
    count: int

    @property
    def half_width(self) -> float:
        return 0.5 * (self.high - self.low)

    def contains(self, value: float) -> bool:
        return self.low <= value <= self.high


def mean_interval(values: Sequence[float]) -> Interval:
    """The mean's interval: mean +- t_{0.975, n - 1} s / sqrt(n)."""
    values = np.asarray(values, float)
    count = len(values)
    if count == 0:
        return Interval(np.nan, np.nan, np.nan, 0)
    half = np.nan
    if count > 1:
        quantile = scipy.stats.t.ppf(0.5 + CONFIDENCE / 2, count - 1)
        half = float(quantile * values.std(ddof=1) / np.sqrt(count))
    mean = float(values.mean())
    return Interval(mean, mean - half, mean + half, count)
