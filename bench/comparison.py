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
        f"which the paper has one per row; {counts[DIFFERS]} differ by more than that."
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
    """What to say of the cells of one method that differ; empty if none does."""
    wrong = [cell for cell in cells if cell.method == method and cell.verdict == DIFFERS]
    if not wrong:
        return ""
    listed = "; ".join(
        f"{cell.grid}x{cell.grid} with {cell.regions} regions: {100 * cell.paper_ratio:.1f}% printed, "
        f"{_percent(cell.ratio)} here"
        for cell in wrong
    )
    return f"**{method}** differs by more than draws and trials explain. {listed}."


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


def figure1_words(rows: Iterable[Row]) -> list[str]:
    """Sentences on Algorithm 1 against k-NN, and on what the printed program does, per track."""
    rows = list(rows)
    sentences = []
    for track in dict.fromkeys(row.domain for row in rows):
        counts = sorted({row.demonstrations for row in rows if row.domain == track})
        for other, name in _COMPARED.items():
            parts = []
            for metric in ("reward_per_step", "off_roads"):
                difference = _paired(rows, track, counts[0], "soft_local_homomorphism", other, metric)
                if difference.count:
                    parts.append(f"{_METRIC_NAMES[metric]} {_signed(difference)}")
            if parts:
                sentences.append(
                    f"{_track_name(track)}, {counts[0]} demonstrations: Algorithm 1 (anchored) against {name}: "
                    f"{', '.join(parts)}."
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


_COMPARED = {
    "manhattan_knn": "k-NN",
    "soft_local_homomorphism_printed": "the program as printed",
    "soft_local_homomorphism_mutual": "similarity in both directions",
}
_METRIC_NAMES = {"reward_per_step": "reward per step", "steps": "steps", "off_roads": "off-roads per step"}


def _paired(rows, track: str, count: int, one: str, other: str, metric: str) -> Interval:
    values = {one: {}, other: {}}
    for row in rows:
        if (row.domain, row.demonstrations) == (track, count) and row.method in values and not row.error:
            values[row.method][row.draw] = getattr(row, metric)
    shared = sorted(values[one].keys() & values[other].keys())
    return mean_interval([values[one][draw] - values[other][draw] for draw in shared])


def _track_name(domain: str) -> str:
    return f"Racetrack ({domain.removeprefix('track_')})"


def _percent(interval: Interval) -> str:
    return f"{100 * interval.mean:.1f}% [{100 * interval.low:.1f}, {100 * interval.high:.1f}]"


def _signed(interval: Interval) -> str:
    return f"{interval.mean:+.3g} [{interval.low:+.3g}, {interval.high:+.3g}]"
