"""Our numbers against the paper's, in words.

A printed number can differ from our mean over draws for three reasons, which are told apart: its 1000 trials (the noise
of which our sampled rows tell), its one draw (our draws say how much they scatter), or another method.
"""

import dataclasses
import itertools
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from bench.figures import domain_name
from bench.methods import CONTROLS
from bench.rows import Row
from bench.summaries import (
    AGREES,
    DIFFERS,
    METRICS,
    ONE_DRAW,
    Interval,
    frame,
    grouped,
    mean_interval,
    paper_table1,
    trial_noise,
)


@dataclasses.dataclass(frozen=True)
class Order:
    """Two methods in one row of Table I whose printed gap is larger than our interval of their difference.

    Attributes:
      better, worse: by the paper. printed: gap of the printed ratios.
      noise: what 1000 trials leave open of a gap, at 95%.
      ours: interval of better - worse, paired by draw; below zero the order is not the paper's.
    """

    grid: int
    regions: int
    better: str
    worse: str
    printed: float
    noise: float
    ours: Interval


def compare_orders(rows: Iterable[Row]) -> list[Order]:
    """Every pair of methods in every row where the paper's gap exceeds our interval's half-width."""
    paper, orders = paper_table1(), []
    for (domain, regions), group in grouped(frame(rows), "domain", "regions"):
        grid, noise = int(domain.removeprefix("grid")), trial_noise(group)
        printed = {method: paper.get((grid, regions, method)) for method in group["method"].unique()}
        ratios = group.pivot(index="draw", columns="method", values="ratio")
        for pair in itertools.combinations([name for name in printed if printed[name] is not None], 2):
            better, worse = sorted(pair, key=lambda name: -printed[name])
            ours = mean_interval((ratios[better] - ratios[worse]).dropna())
            gap = (printed[better] - printed[worse]) / paper[grid, regions, "expert"]
            if ours.count > 1 and gap > ours.half_width:
                orders.append(Order(grid, regions, better, worse, gap, noise, ours))
    return orders


def table1_words(cells: pd.DataFrame, orders: Sequence[Order]) -> list[str]:
    """Paragraphs (Markdown) about Table I, from `summaries.table1`."""
    counts = cells[(cells["verdict"] != "") & (cells["method"] != "expert")]["verdict"].value_counts()
    paragraphs = [
        f"Of {counts.sum()} printed ratios to the expert, {counts.get(AGREES, 0)} lie within our 95% interval, widened "
        f"by the noise of the paper's 1000 trials; {counts.get(ONE_DRAW, 0)} lie outside it but among 95% of our "
        f"single draws, of which the paper has one per row (†); {counts.get(DIFFERS, 0)} differ by more than that (*)."
    ]
    paragraphs += [_cell_words(method, cells[cells["method"] == method]) for method in cells["method"].unique()]
    lost = [order for order in orders if order.ours.mean <= 0]
    clear = [order for order in lost if order.printed > order.noise]
    paragraphs.append(
        f"Order of the methods: in {len(orders)} pairs of methods within a row the paper's gap exceeds our interval; "
        f"{len(orders) - len(lost)} of them are in the same order here. Of the other {len(lost)}, "
        f"{len(lost) - len(clear)} have a printed gap that the noise of 1000 trials explains."
    )
    for pair in dict.fromkeys((order.better, order.worse) for order in clear):
        listed = "; ".join(
            f"{_row_name(order)}: {100 * order.printed:+.1f}% printed, {_percent(*order.ours[1:])} here"
            f"{'' if order.ours.high < 0 else ' (not separated)'}"
            for order in clear
            if (order.better, order.worse) == pair
        )
        paragraphs.append(f"Not reproduced: {pair[0]} above {pair[1]}. {listed}.")
    return [text for text in paragraphs if text]


def control_words(rows: Iterable[Row]) -> str:
    """What is earned without any demonstration, domain by domain over its settings; empty without such rows."""
    found = frame(rows)
    found = found[found["method"].isin(CONTROLS)]
    parts = []
    for (domain,), group in grouped(found, "domain"):
        means = 100.0 * group.pivot_table("ratio", ["regions", "demonstrations"], "method", observed=True)
        zeros, uniform = (_range(means[name]) if name in means else "no rows" for name in ("lpal_zeros", "uniform"))
        parts.append(f"{domain_name(domain)}: {zeros} and {uniform}")
    listed = "; ".join(parts)
    return (
        "Controls, fed with no demonstration at all, in percent of the expert's reward: LPAL fed with zeros, and a "
        f"uniform policy. {listed}."
        if parts
        else ""
    )


def _range(values: pd.Series) -> str:
    low, high = f"{values.min():.1f}", f"{values.max():.1f}"
    return low if low == high else f"{low} to {high}"


def _cell_words(method: str, cells: pd.DataFrame) -> str:
    """What to say of the cells of one method that differ by more than the interval; empty if none does."""
    meanings = {DIFFERS: "by more than draws and trials explain", ONE_DRAW: "but a single draw may differ as much"}
    parts = []
    for verdict, meaning in meanings.items():
        listed = "; ".join(
            f"{_row_name(cell)}: {100 * cell.paper_ratio:.1f}% printed, "
            f"{_percent(cell.ratio, cell.ratio_ci_low, cell.ratio_ci_high)} here"
            for cell in cells[cells["verdict"] == verdict].itertuples()
        )
        parts += [f"{meaning}: {listed}."] if listed else []
    return f"**{method}** differs from the paper, " + " It differs, ".join(parts) if parts else ""


def _row_name(cell) -> str:
    return f"{cell.grid}x{cell.grid} with {cell.regions} regions"


def _percent(mean: float, low: float, high: float) -> str:
    return f"{100 * mean:.1f}% [{100 * low:.1f}, {100 * high:.1f}]"


_SOFT, _LPAL_SOFT = "soft_local_homomorphism", "lpal_soft_local_homomorphism"
_BOTH = ("track_a", "track_b")
_PRINTED_ORDERS = [(_SOFT, "manhattan_knn", metric, _BOTH) for metric in METRICS] + [
    ("lpal_full_policy", _LPAL_SOFT, "reward_per_step", _BOTH),
    ("lpal_full_policy", "lpal_manhattan_knn", "reward_per_step", _BOTH),
    (_SOFT, _LPAL_SOFT, "reward_per_step", ("track_b",)),
    ("manhattan_knn", "lpal_manhattan_knn", "reward_per_step", ("track_b",)),
]
"""What section VI.B says of its Figure 1, whose numbers are not printed."""
_OUR_ORDERS = [
    (_SOFT, f"{_SOFT}_{relation}", metric, _BOTH)
    for relation in ("printed", "mutual")
    for metric in ("reward_per_step", "off_roads")
]
_METRIC_NAMES = {"reward_per_step": "reward per step", "steps": "steps", "off_roads": "off-roads per step"}


@dataclasses.dataclass(frozen=True)
class CurveOrder:
    """Whether one curve of Figure 1 is better than another, over all points of a track.

    Attributes:
      better, worse: methods. is_printed: whether the paper says so, or it is our question.
      ours: interval over draws of better - worse, averaged over the points; positive where `better` is (of steps and
        off-roads fewer are better).
      clear, reversed: at how many of `points` points the interval lies above, or below, zero.
    """

    track: str
    metric: str
    better: str
    worse: str
    is_printed: bool
    ours: Interval
    clear: int
    reversed: int
    points: int


def compare_curves(rows: Iterable[Row]) -> list[CurveOrder]:
    """The orders that the paper claims for Figure 1, then those between the relations."""
    tracks, orders = dict(list(frame(rows).groupby("domain"))), []
    for number, (better, worse, metric, names) in enumerate(_PRINTED_ORDERS + _OUR_ORDERS):
        for track in filter(tracks.__contains__, names):
            gaps = _gaps(tracks[track], metric, better, worse) * (1.0 if metric == "reward_per_step" else -1.0)
            if gaps.empty:
                continue
            intervals = [mean_interval(point.dropna()) for _, point in gaps.iterrows()]
            counts = sum(i.low > 0 for i in intervals), sum(i.high < 0 for i in intervals), len(intervals)
            ours = mean_interval(gaps.dropna(axis=1).mean())
            is_printed = number < len(_PRINTED_ORDERS)
            orders.append(CurveOrder(track, metric, better, worse, is_printed, ours, *counts))
    return orders


def _gaps(rows: pd.DataFrame, metric: str, one: str, other: str) -> pd.DataFrame:
    """one - other, numbers of demonstrations by rows, draws by columns."""
    values = rows.pivot(index=["demonstrations", "draw"], columns="method", values=metric)
    values = values.reindex(columns=[one, other])
    return (values[one] - values[other]).dropna().unstack()


def figure1_words(orders: Sequence[CurveOrder]) -> list[str]:
    """A sentence per order; what is not reproduced says so."""
    sentences = []
    for order in orders:
        sign = 1.0 if order.metric == "reward_per_step" else -1.0
        gap = f"{sign * order.ours.mean:+.3g} ± {order.ours.half_width:.2g}"
        verdict = "" if not order.is_printed else "reproduced: " if order.ours.low > 0 else "open: "
        verdict = "**not reproduced**: " if order.is_printed and order.ours.high < 0 else verdict
        sentences.append(
            f"Racetrack ({order.track.removeprefix('track_')}), {verdict}{order.better} better than {order.worse} in "
            f"{_METRIC_NAMES[order.metric]}: {gap} on average over {order.points} points, clear at {order.clear}, "
            f"the other way round at {order.reversed}."
        )
    return sentences


def largest_difference(rows: Iterable[Row], track: str, one: str, other: str) -> float:
    """The largest difference of any metric, draw and number of demonstrations between two methods on a track."""
    found = frame(rows)
    found = found[found["domain"] == track]
    gaps = [_gaps(found, metric, one, other).abs().to_numpy() for metric in METRICS]
    return float(np.nanmax(np.concatenate(gaps))) if all(gap.size for gap in gaps) else np.nan


class ChoiceGap(NamedTuple):
    """How far a choice is from the candidate with the best mean in one setting, in points, in the choice's draws.

    Attributes:
      own: mean of the choice. best: the candidate's name; its_own: its interval. ahead: of choice - candidate.
      is_behind: by more than one interval.
    """

    domain: str
    demonstrations: int
    draws: int
    own: float
    best: str
    its_own: Interval
    ahead: Interval
    is_behind: bool


def choice_gaps(rows: Iterable[Row], chooser: str, chosen_from: Sequence[str]) -> list[ChoiceGap]:
    """For every setting that the chooser has rows of."""
    gaps = []
    for (domain, count), group in grouped(frame(rows), "domain", "demonstrations"):
        ratios = 100.0 * group.pivot(index="draw", columns="method", values="ratio")
        if chooser not in ratios:  # its rows failed, or were not asked for
            continue
        ratios = ratios[ratios[chooser].notna()]
        candidates = ratios[[name for name in chosen_from if name in ratios and name != "expert"]]
        best = candidates.mean().idxmax()
        own, ahead = mean_interval(candidates[best]), mean_interval((ratios[chooser] - candidates[best]).dropna())
        is_behind = ahead.high < 0.0 and ahead.mean < -own.half_width
        gaps.append(ChoiceGap(domain, count, len(ratios), ratios[chooser].mean(), best, own, ahead, is_behind))
    return gaps


def choice_words(gaps: Sequence[ChoiceGap]) -> list[str]:
    """How often and how far a choice is behind, then a sentence per setting."""
    words = [
        f"{gap.domain}, {gap.demonstrations} demonstrations, {gap.draws} draws: {gap.own:.1f} against "
        f"{gap.its_own.mean:.1f} +- {gap.its_own.half_width:.1f} of {gap.best}, {gap.ahead.mean:+.1f} "
        f"({gap.ahead.low:+.1f} to {gap.ahead.high:+.1f}): "
        f"{'behind by more than one interval' if gap.is_behind else 'within one interval'}."
        for gap in gaps
    ]
    average = f"{np.mean([gap.ahead.mean for gap in gaps]):+.1f} points on average" if gaps else "none has rows"
    behind = sum(gap.is_behind for gap in gaps)
    return [f"{behind} of {len(gaps)} settings are behind by more than one interval; {average}.", *words]
