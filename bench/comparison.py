"""Our numbers against the paper's, in words.

The paper has one draw of the reward per row of Table I, and means over 1000 trials. A printed number can therefore
differ from our mean over draws for three reasons, which are told apart: its 1000 trials (`Row.sampled_error` says how
much they scatter), its one draw (our draws say how much they scatter), or another method.
"""

import dataclasses
import itertools
from collections.abc import Iterable, Sequence

import numpy as np

from bench.intervals import Interval, mean_interval
from bench.rows import Row
from bench.summaries import METRICS, grouped, paper_table1

_TWO_SIDED = 1.96
AGREES, ONE_DRAW, DIFFERS = "agrees", "one draw", "differs"


@dataclasses.dataclass(frozen=True)
class Cell:
    """A cell of Table I: the ratio to the expert, ours and the paper's.

    Attributes:
      reward, ratio: means over draws. paper_reward, paper_ratio: printed, NaN if it is not.
      verdict: "agrees" if the printed ratio lies in our interval, widened by the noise of 1000 trials; "one draw" if it
        does not, but lies among 95% of our draws; "differs" otherwise. Empty without a printed number.
    """

    grid: int
    regions: int
    method: str
    reward: Interval
    ratio: Interval
    paper_reward: float
    paper_ratio: float
    verdict: str


def compare_table1(rows: Iterable[Row]) -> list[Cell]:
    """The cells of Table I, in the order of the rows."""
    paper = paper_table1()
    cells = []
    for (domain, regions, method), group in grouped(rows, lambda row: (row.domain, row.regions, row.method)):
        grid = int(domain.removeprefix("grid"))
        ratios = np.array([row.reward_per_step / row.expert_reward for row in group])
        printed = paper.get((grid, regions, method), np.nan)
        printed_ratio = printed / paper.get((grid, regions, "expert"), np.nan)
        reward = mean_interval([row.reward_per_step for row in group])
        ratio = mean_interval(ratios)
        verdict = _verdict(printed_ratio, ratio, ratios, _gap_noise(group))
        cells.append(Cell(grid, regions, method, reward, ratio, printed, printed_ratio, verdict))
    return cells


def _gap_noise(group: Sequence[Row]) -> float:
    """What two means of 1000 trials leave open of their difference, at 95%, as a share of the expert's reward.

    0 where no trials were run.
    """
    errors = [row.sampled_error / row.expert_reward for row in group if row.sampled_error is not None]
    return _TWO_SIDED * float(np.sqrt(2) * np.mean(errors)) if errors else 0.0


def _verdict(printed: float, ratio: Interval, ratios: np.ndarray, noise: float) -> str:
    if not np.isfinite(printed) or ratio.count < 2:
        return ""
    if abs(printed - ratio.mean) <= np.hypot(ratio.half_width, noise):
        return AGREES
    low, high = np.quantile(ratios, (0.025, 0.975))
    return ONE_DRAW if low - noise <= printed <= high + noise else DIFFERS


@dataclasses.dataclass(frozen=True)
class Order:
    """Two methods in one row of Table I whose printed gap is larger than our interval of their difference.

    Attributes:
      better, worse: by the paper. printed: gap of the printed ratios.
      noise: what 1000 trials leave open of a gap, at 95%.
      ours: interval of better - worse, paired by draw.
    """

    grid: int
    regions: int
    better: str
    worse: str
    printed: float
    noise: float
    ours: Interval

    @property
    def is_reproduced(self) -> bool:
        return self.ours.mean > 0

    @property
    def is_reversed(self) -> bool:
        """Whether our interval lies on the other side of zero."""
        return self.ours.high < 0


def compare_orders(rows: Iterable[Row]) -> list[Order]:
    """Every pair of methods in every row where the paper's gap exceeds our interval's half-width."""
    paper, orders = paper_table1(), []
    for (domain, regions), group in grouped(rows, lambda row: (row.domain, row.regions)):
        grid, noise = int(domain.removeprefix("grid")), _gap_noise(group)
        ratios = {}
        for row in group:
            ratios.setdefault(row.method, {})[row.draw] = row.reward_per_step / row.expert_reward
        for pair in itertools.combinations([name for name in ratios if (grid, regions, name) in paper], 2):
            better, worse = sorted(pair, key=lambda name: -paper[grid, regions, name])
            shared = sorted(ratios[better].keys() & ratios[worse].keys())
            ours = mean_interval([ratios[better][draw] - ratios[worse][draw] for draw in shared])
            gap = paper[grid, regions, better] - paper[grid, regions, worse]
            gap /= paper[grid, regions, "expert"]
            if ours.count > 1 and gap > ours.half_width:
                orders.append(Order(grid, regions, better, worse, gap, noise, ours))
    return orders


def table1_words(cells: Sequence[Cell], orders: Sequence[Order]) -> list[str]:
    """Paragraphs (Markdown) about Table I."""
    judged = [cell for cell in cells if cell.verdict and cell.method != "expert"]
    counts = {verdict: sum(cell.verdict == verdict for cell in judged) for verdict in (AGREES, ONE_DRAW, DIFFERS)}
    paragraphs = [
        f"Of {len(judged)} printed ratios to the expert, {counts[AGREES]} lie within our 95% interval, widened by the "
        f"noise of the paper's 1000 trials; {counts[ONE_DRAW]} lie outside it but among 95% of our single draws, of "
        f"which the paper has one per row (†); {counts[DIFFERS]} differ by more than that (*)."
    ]
    paragraphs += [_cell_words(method, cells) for method in dict.fromkeys(cell.method for cell in cells)]
    lost = [order for order in orders if not order.is_reproduced]
    clear = [order for order in lost if order.printed > order.noise]
    paragraphs.append(
        f"Order of the methods: in {len(orders)} pairs of methods within a row the paper's gap exceeds our interval; "
        f"{len(orders) - len(lost)} of them are in the same order here. Of the other {len(lost)}, "
        f"{len(lost) - len(clear)} have a printed gap that the noise of 1000 trials explains."
    )
    return [text for text in paragraphs + _order_words(clear) if text]


def _cell_words(method: str, cells: Sequence[Cell]) -> str:
    """What to say of the cells of one method that differ by more than the interval; empty if none does."""
    meanings = {DIFFERS: "by more than draws and trials explain", ONE_DRAW: "but a single draw may differ as much"}
    parts = []
    for verdict, meaning in meanings.items():
        listed = "; ".join(
            f"{cell.grid}x{cell.grid} with {cell.regions} regions: {100 * cell.paper_ratio:.1f}% printed, "
            f"{_percent(cell.ratio)} here"
            for cell in cells
            if (cell.method, cell.verdict) == (method, verdict)
        )
        parts += [f"{meaning}: {listed}."] if listed else []
    return f"**{method}** differs from the paper, " + " It differs, ".join(parts) if parts else ""


def _order_words(lost: Sequence[Order]) -> list[str]:
    """One sentence for every two methods whose order is not the paper's in some row."""
    paragraphs = []
    for pair in dict.fromkeys((order.better, order.worse) for order in lost):
        rows = [order for order in lost if (order.better, order.worse) == pair]
        listed = "; ".join(
            f"{order.grid}x{order.grid} with {order.regions} regions: {100 * order.printed:+.1f}% printed, "
            f"{_percent(order.ours)} here{'' if order.is_reversed else ' (not separated)'}"
            for order in rows
        )
        paragraphs.append(f"Not reproduced: {pair[0]} above {pair[1]}. {listed}.")
    return paragraphs


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


_SOFT, _LPAL_SOFT = "soft_local_homomorphism", "lpal_soft_local_homomorphism"
_PRINTED_ORDERS = [(_SOFT, "manhattan_knn", metric, ("track_a", "track_b")) for metric in METRICS] + [
    ("lpal_full_policy", _LPAL_SOFT, "reward_per_step", ("track_a", "track_b")),
    ("lpal_full_policy", "lpal_manhattan_knn", "reward_per_step", ("track_a", "track_b")),
    (_SOFT, _LPAL_SOFT, "reward_per_step", ("track_b",)),
    ("manhattan_knn", "lpal_manhattan_knn", "reward_per_step", ("track_b",)),
]
"""What section VI.B says of its Figure 1, whose numbers are not printed."""
_OUR_ORDERS = [
    (_SOFT, f"{_SOFT}_{relation}", metric, ("track_a", "track_b"))
    for relation in ("printed", "mutual")
    for metric in ("reward_per_step", "off_roads")
]
_METRIC_NAMES = {"reward_per_step": "reward per step", "steps": "steps", "off_roads": "off-roads per step"}


def compare_curves(rows: Iterable[Row]) -> list[CurveOrder]:
    """The orders that the paper claims for Figure 1, then those between the relations."""
    values = {}  # (track, method, metric) -> {(demonstrations, draw): value}
    for row in rows:
        for metric in METRICS if not row.error else ():
            curve = values.setdefault((row.domain, row.method, metric), {})
            curve[row.demonstrations, row.draw] = getattr(row, metric)
    orders = []
    for better, worse, metric, tracks in _PRINTED_ORDERS + _OUR_ORDERS:
        is_printed = (better, worse, metric, tracks) in _PRINTED_ORDERS
        for track in tracks:
            one, other = (values.get((track, method, metric), {}) for method in (better, worse))
            sign = 1.0 if metric == "reward_per_step" else -1.0
            gaps = {key: sign * (one[key] - other[key]) for key in one.keys() & other.keys()}
            if gaps:
                orders.append(CurveOrder(track, metric, better, worse, is_printed, *_over_points(gaps)))
    return orders


def _over_points(gaps: dict[tuple[int, int], float]) -> tuple[Interval, int, int, int]:
    """Interval of the mean over points, points clearly above zero, below zero, all; from (point, draw) -> gap."""
    points, draws = ({}, {})
    for (point, draw), gap in sorted(gaps.items()):
        points.setdefault(point, []).append(gap)
        draws.setdefault(draw, []).append(gap)
    whole = [np.mean(found) for found in draws.values() if len(found) == len(points)]
    intervals = [mean_interval(found) for found in points.values()]
    above, below = sum(i.low > 0 for i in intervals), sum(i.high < 0 for i in intervals)
    return mean_interval(whole), above, below, len(points)


def figure1_words(orders: Sequence[CurveOrder]) -> list[str]:
    """A sentence per order; what is not reproduced says so."""
    sentences = []
    for order in orders:
        sign = 1.0 if order.metric == "reward_per_step" else -1.0
        gap = f"{sign * order.ours.mean:+.3g} ± {order.ours.half_width:.2g}"
        verdict = ""
        if order.is_printed:
            verdict = "open: " if order.ours.low <= 0 <= order.ours.high else "reproduced: "
            verdict = "**not reproduced**: " if order.ours.high < 0 else verdict
        sentences.append(
            f"{_track_name(order.track)}, {verdict}{order.better} better than {order.worse} in "
            f"{_METRIC_NAMES[order.metric]}: {gap} on average over {order.points} points, clear at {order.clear}, "
            f"the other way round at {order.reversed}."
        )
    return sentences


def largest_difference(rows: Iterable[Row], track: str, one: str, other: str) -> float:
    """The largest difference of any metric, draw and number of demonstrations between two methods on a track."""
    values = {}
    for row in rows:
        if row.domain == track and not row.error and row.method in (one, other):
            values.setdefault((row.demonstrations, row.draw), {})[row.method] = row
    pairs = [pair for pair in values.values() if len(pair) == 2]
    gaps = [abs(getattr(p[one], metric) - getattr(p[other], metric)) for p in pairs for metric in METRICS]
    return max(gaps, default=np.nan)


def _track_name(domain: str) -> str:
    return f"Racetrack ({domain.removeprefix('track_')})"


def _percent(interval: Interval) -> str:
    return f"{100 * interval.mean:.1f}% [{100 * interval.low:.1f}, {100 * interval.high:.1f}]"
