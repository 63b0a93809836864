"""Figures that pages quote, made anew from the rows: a page that says something else is out of date.

Every passage is written here once more, with its numbers taken from `bench/results`; line breaks do not count.
`python -m bench.report` names the passages that are not on their pages, and so do the tests.
"""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Iterator

import numpy as np
import pandas as pd

from bench import comparison, relations, speed_quotations, summaries
from bench.guarantees import TRUE
from bench.provenance import RESULTS, ROOT
from bench.rows import read_rows
from bench.summaries import frame, mean_interval

_FEW, _TRACK = (1, 2, 5, 10, 20), (2, 5, 10, 20)  # demonstrations on grids and lakes, and on tracks
_LEARNERS = (("grid16", _FEW), ("wrong16", _FEW), ("tiles8", _FEW), ("tiles16", _FEW))
_LEARNERS_TRACKS = (("track_a", _TRACK), ("track_b", _TRACK))
_SAME = 0.5  # points: columns whose numbers differ by less are quoted as one


@dataclasses.dataclass(frozen=True)
class Quotation:
    """A passage that a page, a path in the checkout, has to contain."""

    page: str
    passage: str

    @property
    def is_up_to_date(self) -> bool:
        return _in_one_line(self.passage) in _in_one_line((ROOT / self.page).read_text())


def quotations(folder: pathlib.Path = RESULTS) -> list[Quotation]:
    """All passages, with the numbers of the rows in a folder."""
    made = [*_table1(folder), *_figure1(folder), *_relations(folder), *_learners(folder), *_guarantees(folder)]
    made += [*_queries(folder), *speed_quotations.passages(folder)]
    return [Quotation(page, passage) for page, passage in made]


def stale(folder: pathlib.Path = RESULTS) -> list[str]:
    """A line for each passage that is not on its page."""
    return [f"{one.page} does not say: {one.passage}" for one in quotations(folder) if not one.is_up_to_date]


def _in_one_line(text: str) -> str:
    return " ".join(text.split())


def _rows(folder: pathlib.Path, name: str) -> list:
    return read_rows(folder / "raw" / f"{name}.csv")


def _by_setting(rows: list) -> list[list]:
    """The rows of each domain and number of demonstrations."""
    found: dict = {}
    for row in rows:
        found.setdefault((row.domain, row.demonstrations), []).append(row)
    return list(found.values())


class _Summary:
    """A summary file, to take numbers from."""

    def __init__(self, folder: pathlib.Path, name: str) -> None:
        self._lines = pd.read_csv(folder / f"{name}.csv")

    def number(self, domain: str, demonstrations: int, method: str, metric: str = "ratio") -> float:
        lines = self._lines
        found = lines[
            (lines["domain"] == domain)
            & (lines["demonstrations"] == demonstrations)
            & (lines["method"] == method)
            & (lines["metric"] == metric)
        ]
        return float(found["mean"].iloc[0])

    def percent(self, domain: str, demonstrations: int, method: str, digits: int = 0) -> str:
        return f"{100.0 * self.number(domain, demonstrations, method):.{digits}f}"

    def column(self, domain: str, counts: tuple[int, ...], method: str) -> str:
        """Percent by number of demonstrations, as one number where they hardly differ."""
        found = 100.0 * np.array([self.number(domain, count, method) for count in counts])
        return f"{found.mean():.1f}" if np.ptp(found) < _SAME else " / ".join(f"{value:.0f}" for value in found)


def _table1(folder: pathlib.Path) -> Iterator[tuple[str, str]]:
    rows = _rows(folder, "table1")
    cells = summaries.table1(rows)
    printed = cells[(cells["verdict"] != "") & (cells["method"] != "expert")]
    counts = printed["verdict"].value_counts()
    yield (
        "README.md",
        f"Of its {len(printed)} ratios to the expert, {counts.get(summaries.AGREES, 0)} lie in our 95% intervals and "
        f"{counts.get(summaries.ONE_DRAW, 0)} more among our single draws.",
    )
    orders = comparison.compare_orders(rows)
    kept = sum(order.ours.mean > 0 for order in orders)
    yield "README.md", f"is the paper's in {kept} of the {len(orders)} pairs whose printed gap exceeds our interval"
    carlo = 100.0 * cells[cells["method"] == "monte_carlo"][["ratio", "paper_ratio"]]
    low, high = carlo.min().round(), carlo.max().round()
    yield (
        "README.md",
        f"({low['ratio']:.0f} to {high['ratio']:.0f}% of the expert's reward; "
        f"{low['paper_ratio']:.0f} to {high['paper_ratio']:.0f}% as printed)",
    )
    zeros, uniform = (
        100.0 * cells[cells["method"] == method]["ratio"].agg(["min", "max"]) for method in ("lpal_zeros", "uniform")
    )
    yield (
        "README.md",
        f"Fed with zeros, LPAL earns {zeros['min']:.0f} to {zeros['max']:.0f}% of it, and a uniform policy "
        f"{uniform['min']:.0f} to {uniform['max']:.0f}%",
    )


def _figure1(folder: pathlib.Path) -> Iterator[tuple[str, str]]:
    found = frame(_rows(folder, "figure1"))

    def ahead(track: str, count: int) -> str:
        here = found[(found["domain"] == track) & (found["demonstrations"] == count)]
        rewards = here.pivot(index="draw", columns="method", values="reward_per_step")
        gap = mean_interval(rewards["soft_local_homomorphism"] - rewards["manhattan_knn"])
        return f"{gap.mean:.2f} [{gap.low:.2f}, {gap.high:.2f}]"

    yield (
        "README.md",
        f"With two demonstrations on racetrack (a), Algorithm 1 earns {ahead('track_a', 2)} more per step than k-NN; "
        f"with ten on (b), {ahead('track_b', 10)} more.",
    )


def _relations(folder: pathlib.Path) -> Iterator[tuple[str, str]]:
    tracks, roads, transfer = (_Summary(folder, name) for name in ("relations", "roads", "transfer"))
    three = ("homomorphism 0", "isomorphic 0", "lax 0")
    one, isomorphic, lax = (tracks.percent("track_a", 2, name) for name in three)
    corner = [tracks.percent("track_corner", 2, name) for name in three]
    yield (
        "README.md",
        f"With two demonstrations on racetrack (a), Algorithm 1 reaches {one}% of the expert's reward, isomorphic "
        f'models alone {isomorphic}%, and "lax", which renames the voters\' actions, {lax}%; on the small corner track '
        f"{corner[0]}, {corner[1]} and {corner[2]}%.",
    )
    candidates = relations.CANDIDATES["relations"]
    gaps = comparison.choice_gaps(_rows(folder, "relations"), "chosen, highest score", candidates)
    behind, ahead = sum(gap.is_behind for gap in gaps), np.array([gap.ahead.mean for gap in gaps])
    yield (
        "README.md",
        f"is {-ahead.mean():.1f} points behind the best candidate on average, and in {behind} of {len(gaps)} settings "
        "by more than one interval",
    )
    yield (
        "docs/relations.md",
        f"on {len(gaps)} settings of tracks, grids and lakes the choice lies {-ahead.mean():.1f} points below the best "
        f"candidate on average, between {-ahead.max():.1f} and {-ahead.min():.0f}.",
    )
    uniform = roads.percent("road", 2, "uniform elsewhere")
    yield "README.md", f"better than a uniform policy ({uniform}% of the expert's time at the destination)"
    kernel, label = roads.percent("road", 2, "random_walk 0.1, labels"), roads.percent("road", 2, "smallest label", 1)
    yield (
        "README.md",
        f"at threshold 0.1 reaches {kernel}%; the smallest label alone, without any demonstration, {label}%",
    )
    lax, uniform = (transfer.percent("track_b", 2, name) for name in ("lax 0", "uniform"))
    zeros = transfer.percent("track_b", 2, "LPAL, zeros", 1)
    yield (
        "README.md",
        f'"lax" carries over {lax}% where a uniform policy has {uniform}%; LPAL, fed with zeros, {zeros}%',
    )


def _learners(folder: pathlib.Path) -> Iterator[tuple[str, str]]:
    summary = _Summary(folder, "learners")

    draws = {len({row.draw for row in rows}) for rows in _by_setting(_rows(folder, "learners"))}
    for page in ("README.md", "docs/which_method.md"):
        yield page, f"means of {' to '.join(map(str, sorted(draws)))} draws"

    def line(name: str, method: str) -> str:
        columns = [summary.column(domain, counts, method) for domain, counts in (*_LEARNERS, *_LEARNERS_TRACKS)]
        return f"| {name} | {' | '.join(columns)} |"

    shown = {
        "nothing: LPAL with zeros": "LPAL, zeros",
        "demonstrations: k-NN": "k-NN",
        "demonstrations: Algorithm 1": "Algorithm 1",
        "demonstrations: max. causal entropy": "max. causal entropy",
    }
    more = {
        "nothing: uniform": "uniform",
        "Algorithm 1: max. causal entropy": "max. causal entropy, Algorithm 1",
        "Algorithm 1: LPAL": "LPAL, Algorithm 1",
        "Algorithm 1: inverse LP": "inverse LP, Algorithm 1",
        "Monte Carlo: LPAL": "LPAL, Monte Carlo",
        "Monte Carlo: max. causal entropy": "max. causal entropy, Monte Carlo",
    }
    for name, method in shown.items():
        yield "README.md", line(name, method)
    for name, method in {**shown, **more}.items():
        yield "docs/which_method.md", line(name, method)


def _guarantees(folder: pathlib.Path) -> Iterator[tuple[str, str]]:
    summary, rows = _Summary(folder, "guarantees"), _rows(folder, "guarantees")
    draws = max(row.draw for row in rows) + 1
    loss, own, worst, robust = (
        summary.number("track_a", 2, method, metric)
        for method, metric in (
            ("Algorithm 1, true weights", "loss_bound"),
            ("Algorithm 1, true weights", "certificate"),
            ("Algorithm 1, worst weights", "certificate"),
            ("robust policy, worst weights", "certificate"),
        )
    )
    compared = sum(row.method.endswith(TRUE) for row in rows)
    yield "README.md", f"was never below the true loss, in {compared:,} rows ({draws} draws)."
    yield (
        "README.md",
        f"On racetrack (a) with two demonstrations Algorithm 1 loses {loss:.3f} a step (weights of sum 1), the bound "
        f"says {own:.3f} at the true weights and {worst:.3f} for any; `robust_policy` loses {robust:.3f} at most",
    )


def _queries(folder: pathlib.Path) -> Iterator[tuple[str, str]]:
    summary = _Summary(folder, "queries")
    last = [f"{name}, round 4" for name in ("visits", "demonstrations", "random states", "bound")]
    track, lake = (
        [summary.percent(domain, 2, method) for method in ("no questions", *last)] for domain in ("track_a", "tiles16")
    )
    yield (
        "README.md",
        f"four rounds of 20 states take Algorithm 1 from {track[0]} to {track[1]}%, where four more demonstrations "
        f"reach {track[2]}%, and 80 states at random {track[3]}%; on the large lake from {lake[0]} to {lake[1]}%, "
        f"against {lake[2]} and {lake[3]}%. By their contribution to the bound states are chosen less well ({track[4]} "
        f"and {lake[4]}%)",
    )
    yield (
        "docs/which_method.md",
        f"four rounds of 20 take Algorithm 1 on racetrack (a) from {track[0]} to {track[1]} % of the expert, four "
        f"demonstrations more to {track[2]} %.",
    )
