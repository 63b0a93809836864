"""Means over draws with 95% confidence intervals, by Student's t, from raw rows.

A ratio to the expert is the mean over draws of each draw's own ratio: reward and expert share the draw, so what they
have in common cancels. `table1` has a line per grid, number of regions and method, with the paper's printed number;
`lines` has one per setting, method and metric.
"""

import dataclasses
import pathlib
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
import scipy.stats

from bench.rows import Row
from bench.settings import WEIGHT_SUMS

PAPER = pathlib.Path(__file__).resolve().parent / "paper_table1.csv"
CONFIDENCE = 0.95
METRICS = ("reward_per_step", "steps", "off_roads")
"""What Figure 1 shows."""
TABLE1_COLUMNS = (
    *("grid", "regions", "method", "draws", "mean", "ci_low", "ci_high"),
    *("ratio", "ratio_ci_low", "ratio_ci_high", "paper"),
)
QUESTION_KEY = ("domain", "regions", "demonstrations", "distance", "threshold", "samples", "method")
_INTERVAL = ("mean", "ci_low", "ci_high")
_TWO_SIDED = 1.96
AGREES, ONE_DRAW, DIFFERS = "agrees", "one draw", "differs"


class Interval(NamedTuple):
    """A mean of `count` draws between `low` and `high`; one draw has no interval (NaN)."""

    count: int
    mean: float
    low: float
    high: float

    @property
    def half_width(self) -> float:
        return 0.5 * (self.high - self.low)


def mean_interval(values: Sequence[float]) -> Interval:
    """The mean's interval: mean +- t_{0.975, n - 1} s / sqrt(n)."""
    values = np.asarray(values, float)
    count, mean, half = len(values), float(values.mean()) if len(values) else np.nan, np.nan
    if count > 1:
        half = float(scipy.stats.t.ppf(0.5 + CONFIDENCE / 2, count - 1) * scipy.stats.sem(values))
    return Interval(count, mean, mean - half, mean + half)


def frame(rows: Iterable[Row]) -> pd.DataFrame:
    """The rows with numbers, with the ratio to the expert; methods are ordered as they first occur."""
    found = pd.DataFrame([vars(row) for row in rows])
    found["method"] = pd.Categorical(found["method"], found["method"].unique(), ordered=True)
    numbers = [*METRICS, "expert_reward", "sampled_error", "loss_bound", "certificate"]
    found = found[found["error"] == ""].astype(dict.fromkeys(numbers, float))
    return found.assign(ratio=found["reward_per_step"] / found["expert_reward"])


def grouped(rows: pd.DataFrame, *names: str):
    """(key, rows), keys in ascending order."""
    return rows.groupby(list(names), observed=True)


def paper_table1() -> dict[tuple[int, int, str], float]:
    """The printed numbers of Table I: (grid, regions, method) -> average reward per step."""
    printed = pd.read_csv(PAPER, index_col=["grid", "regions"])
    return {(*row, method): value for method, column in printed.items() for row, value in column.items()}


def table1(rows: Iterable[Row]) -> pd.DataFrame:
    """One line per cell of Table I: `TABLE1_COLUMNS`, the paper's ratio to its expert, and a verdict on it.

    The paper has one draw of the reward per row, and means over 1000 trials. Its ratio "agrees" if it lies in our
    interval, widened by the noise of 1000 trials; else it is "one draw" if it lies among 95% of our draws, as widely;
    else it "differs". The verdict is empty without a printed number.
    """
    paper, found = paper_table1(), []
    for (domain, regions, method), group in grouped(frame(rows), "domain", "regions", "method"):
        grid = int(domain.removeprefix("grid"))
        reward, ratio = mean_interval(group["reward_per_step"]), mean_interval(group["ratio"])
        printed = paper.get((grid, regions, method), np.nan)
        printed_ratio = printed / paper.get((grid, regions, "expert"), np.nan)
        verdict = _verdict(printed_ratio, ratio, group)
        found.append((grid, regions, method, *reward, *ratio[1:], printed, printed_ratio, verdict))
    return pd.DataFrame(found, columns=[*TABLE1_COLUMNS, "paper_ratio", "verdict"])


def trial_noise(rows: pd.DataFrame) -> float:
    """What two means of 1000 trials leave open of their difference, at 95%, as a share of the expert's reward.

    0 where no trials were run.
    """
    errors = (rows["sampled_error"] / rows["expert_reward"]).dropna()
    return _TWO_SIDED * float(np.sqrt(2) * errors.mean()) if len(errors) else 0.0


def _verdict(printed: float, ratio: Interval, rows: pd.DataFrame) -> str:
    if not np.isfinite(printed) or ratio.count < 2:
        return ""
    noise = trial_noise(rows)
    if abs(printed - ratio.mean) <= np.hypot(ratio.half_width, noise):
        return AGREES
    low, high = np.quantile(rows["ratio"], (0.025, 0.975))
    return ONE_DRAW if low - noise <= printed <= high + noise else DIFFERS


def figure1(rows: Iterable[Row]) -> pd.DataFrame:
    """One line per track, number of demonstrations, method and metric."""
    found = lines(rows, ("domain", "demonstrations", "method"), METRICS).rename(
        columns={"domain": "track", "draws": "sets"}
    )
    return found.assign(track=found["track"].str.removeprefix("track_"))


def question(rows: Iterable[Row]) -> pd.DataFrame:
    """One line per setting, method and metric."""
    return lines(rows, QUESTION_KEY, (*METRICS, "ratio"))


def guarantees(rows: Iterable[Row]) -> pd.DataFrame:
    """One line per setting, method and metric: bounds and true losses per step; on tracks in weights of sum 1."""
    return lines(map(_in_units, rows), QUESTION_KEY, ("certificate", "loss_bound", "ratio"))


def _in_units(row: Row) -> Row:
    if row.loss_bound is None or row.certificate is None:
        return row
    scale = 1.0 / WEIGHT_SUMS.get(row.domain, 1.0)
    return dataclasses.replace(row, loss_bound=scale * row.loss_bound, certificate=scale * row.certificate)


def write(name: str, rows: Iterable[Row], folder: pathlib.Path) -> pd.DataFrame:
    """Writes the summary file of a sweep, numbers to six digits, and returns its lines."""
    found = {"table1": table1, "figure1": figure1, "guarantees": guarantees}.get(name, question)(rows)
    columns = list(TABLE1_COLUMNS) if name == "table1" else None
    found.to_csv(folder / f"{name}.csv", columns=columns, index=False, float_format="%.6g", lineterminator="\n")
    return found


def lines(rows: Iterable[Row], by: Sequence[str], metrics: Sequence[str]) -> pd.DataFrame:
    """One line per group and metric, where all rows of the group have it."""
    found = [
        (*key, metric, *mean_interval(group[metric]))
        for key, group in grouped(frame(rows), *by)
        for metric in metrics
        if group[metric].notna().all()
    ]
    return pd.DataFrame(found, columns=[*by, "metric", "draws", *_INTERVAL])
