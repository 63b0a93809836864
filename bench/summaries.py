"""Summary files: means over draws with confidence intervals, from raw rows.

`table1.csv`: grid, regions, method, draws, mean and its interval (average reward per step), ratio to the expert of the
same draw and its interval, and the paper's printed number. `figure1.csv`: track, demonstrations, method, metric, sets,
mean and its interval. The questions have a line per setting, method and metric.
"""

import csv
import pathlib
from collections.abc import Callable, Iterable, Sequence

from bench.intervals import mean_interval
from bench.rows import Row

PAPER = pathlib.Path(__file__).resolve().parent / "paper_table1.csv"
TABLE1_COLUMNS = (
    *("grid", "regions", "method", "draws", "mean", "ci_low", "ci_high"),
    *("ratio", "ratio_ci_low", "ratio_ci_high", "paper"),
)
FIGURE1_COLUMNS = ("track", "demonstrations", "method", "metric", "sets", "mean", "ci_low", "ci_high")
QUESTION_COLUMNS = (
    *("domain", "regions", "demonstrations", "distance", "threshold", "samples", "method"),
    *("metric", "draws", "mean", "ci_low", "ci_high"),
)
METRICS = ("reward_per_step", "steps", "off_roads")
"""What Figure 1 shows."""


def paper_table1() -> dict[tuple[int, int, str], float]:
    """The printed numbers of Table I: (grid, regions, method) -> average reward per step."""
    with PAPER.open(newline="") as file:
        lines = list(csv.DictReader(file))
    return {
        (int(line["grid"]), int(line["regions"]), method): float(value)
        for line in lines
        for method, value in line.items()
        if method not in ("grid", "regions")
    }


def summarise_table1(rows: Iterable[Row]) -> list[dict]:
    """One line per grid, number of regions and method."""
    paper = paper_table1()
    lines = []
    for (domain, regions, method), group in grouped(rows, lambda row: (row.domain, row.regions, row.method)):
        grid = int(domain.removeprefix("grid"))
        reward = mean_interval([row.reward_per_step for row in group])
        ratio = mean_interval([row.reward_per_step / row.expert_reward for row in group])
        values = (grid, regions, method, reward.count, reward.mean, reward.low, reward.high)
        values += (ratio.mean, ratio.low, ratio.high, paper.get((grid, regions, method), ""))
        lines.append(dict(zip(TABLE1_COLUMNS, values, strict=True)))
    return lines


def summarise_figure1(rows: Iterable[Row]) -> list[dict]:
    """One line per track, number of demonstrations, method and metric."""
    lines = []
    for (domain, count, method), group in grouped(rows, lambda row: (row.domain, row.demonstrations, row.method)):
        for metric in METRICS:
            interval = mean_interval([getattr(row, metric) for row in group])
            values = (domain.removeprefix("track_"), count, method, metric, interval.count)
            values += (interval.mean, interval.low, interval.high)
            lines.append(dict(zip(FIGURE1_COLUMNS, values, strict=True)))
    return lines


def summarise_question(rows: Iterable[Row]) -> list[dict]:
    """One line per setting, method and metric; "ratio" is the reward over the expert's in the same draw."""
    names = QUESTION_COLUMNS[:7]
    lines = []
    for key, group in grouped(rows, lambda row: tuple(getattr(row, name) for name in names)):
        metrics = {name: [getattr(row, name) for row in group] for name in METRICS}
        metrics["ratio"] = [row.reward_per_step / row.expert_reward for row in group]
        for metric, values in metrics.items():
            if None not in values:
                interval = mean_interval(values)
                line = (*key, metric, interval.count, interval.mean, interval.low, interval.high)
                lines.append(dict(zip(QUESTION_COLUMNS, line, strict=True)))
    return lines


def grouped(rows: Iterable[Row], key: Callable[[Row], tuple]) -> list[tuple[tuple, list[Row]]]:
    """Rows with numbers, grouped by `key`; keys in ascending order, but methods as they first occur."""
    groups, places = {}, {}
    for row in rows:
        places.setdefault(row.method, len(places))
        if not row.error:
            groups.setdefault(key(row), []).append(row)
    return sorted(groups.items(), key=lambda item: [places.get(part, part) for part in item[0]])


def write_csv(path: pathlib.Path, columns: Sequence[str], lines: Iterable[dict]) -> None:
    """Writes lines; numbers to six digits."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        for line in lines:
            writer.writerow([_rounded(line[name]) for name in columns])


def _rounded(value):
    return format(value, ".6g") if isinstance(value, float) else value
