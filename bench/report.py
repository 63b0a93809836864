"""Turns rows into tables, figures and words: `python -m bench.report`. Nothing is computed but means over rows.

Reads `<results>/raw/*.csv`; writes summaries (CSV), Table I (Markdown and LaTeX), figures (PNG and SVG), and all of it
in `report.md`. Says which figures that the README and the docs quote are out of date (`bench.quotations`).
"""

import argparse
import collections
import pathlib
import sys
from collections.abc import Callable, Sequence

import matplotlib
import pandas as pd

from bench import comparison, figures, learning_report, quotations, relations, summaries, tables
from bench.provenance import RESULTS
from bench.rows import Row, read_rows
from bench.summaries import CONFIDENCE

_WITHIN = 0.99  # of the expert's reward: enough
_HEAD = f"""# Results

Written by `python -m bench.report` from the rows in `raw/`. Intervals are {CONFIDENCE:.0%} confidence intervals of
means over draws, by Student's t; evaluation is exact, in trials of the demonstrations' length or the paper's. Ratios to
the expert are taken draw by draw."""
_FIGURE1_NOTE = """The paper prints no numbers for its Figure 1; what its text says of the curves is checked below. It
leaves open which features LPAL gets. Ours are the two that the reward is made of, on the road and finish, and with two
so telling features LPAL finds a fast lap whatever expectations it is given."""
_NORMALISATION_NOTE = """Eq. (6) adds up over time, as LPAL's flow constraints do. Divided by the demonstrations'
length, the expectations hardly count against occupancies that sum to 1 / (1 - discount): LPAL then spreads its time
evenly over the regions, which earns about the mean weight, 0.05 a step. The printed numbers are of that size."""

_RELATIONS_NOTE = """Percent of the expert's reward per step, in trials of the setting's length: on lakes the share of
time in the goal. Bold where it is further from Algorithm 1 at threshold 0 than both intervals together. Nothing is best
everywhere: what serves tracks, actions that are renamed, loses on grids and lakes.

`chosen, highest score` is `choose_generalization` with its default candidates, `chosen` the same with `caution=2`;
those with other voters are not among the candidates. What is likeliest is not what is worth most, most of all on lakes,
where a wrong step matters more in some states than in others, and few states are left out with a trajectory. Per
setting, the choice against the candidate with the best mean, in points:"""
_ROADS_NOTE = """A network of 1,110 directed links with a destination that absorbs; the expert takes the fewest links.
The label of an exit is the detour that it means in length, so that the smallest label alone, without a demonstration,
is nearly the expert: what labels add to the votes carries that prior. The candidates of `chosen` have them too. Per
number of trips, the choice against the candidate with the best mean, in points:"""
_TRANSFER_NOTE = """Both tracks are one model (`disjoint_union`), and all demonstrated states of the first one that are
similar vote in the second. k-NN finds no neighbour there and is uniform. LPAL fed with zeros needs no demonstration at
all: its two features nearly are the reward."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns 0, or 2 if there are no rows."""
    parser = argparse.ArgumentParser(prog="python -m bench.report", description=__doc__.splitlines()[0])
    parser.add_argument("--results", type=pathlib.Path, default=RESULTS, help="folder (default bench/results)")
    folder = parser.parse_args(arguments).results
    matplotlib.use("agg")
    matplotlib.rcParams["svg.hashsalt"] = "bench"  # the same rows give the same file
    parts = [part(rows, folder) for name, part in _PARTS.items() if (rows := _read(folder / "raw" / f"{name}.csv"))]
    if not parts:
        print(f"bench: error: no rows in {folder / 'raw'}: run python -m bench.reproduce first", file=sys.stderr)
        return 2
    (folder / "report.md").write_text("\n\n".join([_HEAD, *parts]) + "\n")
    print(folder / "report.md")
    for line in quotations.stale(folder) if folder.resolve() == RESULTS else []:
        print(f"out of date: {line}", file=sys.stderr)
    return 0


def _read(path: pathlib.Path) -> list[Row]:
    """The rows of a sweep with the smallest seed that it has; none if it was not run."""
    rows = read_rows(path) if path.exists() else []
    seed = min((row.seed for row in rows), default=None)
    return [row for row in rows if row.seed == seed]


def _table1(rows: list[Row], folder: pathlib.Path) -> str:
    cells = summaries.write("table1", rows, folder)
    reward, ratio = tables.table1_reward(cells), tables.table1_ratio(cells)
    markdown = "\n\n".join(
        part
        for part in [
            f"## Table I\n\n{_health(rows)}\n\nAverage reward per step ± half its interval (printed in the paper):",
            tables.to_markdown(*reward),
            "Percent of the expert's reward in the same draw (of the printed expert's); † where the paper's number is "
            "outside our interval, * where it is out of reach of single draws and of the noise of 1000 trials, too:",
            tables.to_markdown(*ratio),
            *comparison.table1_words(cells, comparison.compare_orders(rows)),
            comparison.control_words(rows),
        ]
        if part
    )
    (folder / "table1.md").write_text(markdown + "\n")
    (folder / "table1.tex").write_text(tables.to_latex(*reward) + "\n" + tables.to_latex(*ratio))
    return markdown


def _figure1(rows: list[Row], folder: pathlib.Path) -> str:
    lines = summaries.write("figure1", rows, folder)
    _save(figures.figure1(lines), folder / "figure1")
    words = comparison.figure1_words(comparison.compare_curves(rows))
    for track in dict.fromkeys(row.domain for row in rows):
        gap = comparison.largest_difference(rows, track, "soft_local_homomorphism_printed", "manhattan_knn")
        words.append(
            f"{figures.domain_name(track).capitalize()}: the program as printed differs from k-NN by at most {gap:.2g} "
            "in any metric of any draw."
        )
    listed = "\n".join(f"- {sentence}" for sentence in words)
    controls = comparison.control_words(rows)
    parts = ["## Figure 1", _health(rows), "![Figure 1](figure1.png)", _FIGURE1_NOTE, listed, controls]
    return "\n\n".join(part for part in parts if part)


def _question(name: str, title: str, draw: Callable, more: Callable[[pd.DataFrame], str] | None = None) -> Callable:
    """The part of a question: its title, its figure, and what `more` says of its lines."""

    def part(rows: list[Row], folder: pathlib.Path) -> str:
        lines = summaries.write(name, rows, folder)
        _save(draw(lines), folder / name)
        text = f"## {title}\n\n{_health(rows)}\n\n![{title}]({name}.png)"
        return text if more is None else f"{text}\n\n{more(lines)}"

    return part


def _enough_table(lines: pd.DataFrame) -> str:
    """For every domain and method, how many demonstrations are enough."""
    methods = [name for name in figures.STYLES if name != "expert" and name in set(lines["method"])]
    ratios = lines[lines["metric"] == "ratio"].sort_values("demonstrations", ascending=False)
    rows = [
        [figures.domain_name(domain), *(_needed(here[here["method"] == name]) for name in methods)]
        for domain in lines["domain"].unique()
        for here in [ratios[ratios["domain"] == domain]]
    ]
    return tables.to_markdown(["domain", *(figures.STYLES[name][0] for name in methods)], rows)


def _needed(lines: pd.DataFrame) -> str:
    """The smallest number from which on the mean stays within reach; in brackets the same for the whole interval."""
    counts, found = lines["demonstrations"], []
    for bound in ("mean", "ci_low"):
        reached = counts[(lines[bound] >= _WITHIN).cummin()]
        found.append(str(reached.min()) if len(reached) else f"> {counts.max()}")
    return found[0] if found[0] == found[1] else f"{found[0]} ({found[1]})"


def _compared(name: str, title: str, note: str) -> Callable:
    """The part of a comparison of relations: a heat map, and whether the choice is as good as the best."""

    def part(rows: list[Row], folder: pathlib.Path) -> str:
        lines = summaries.write(name, rows, folder)
        figure = figures.heat_map(lines, "homomorphism 0", "Algorithm 1 at threshold 0")
        _save(figure, folder / name)
        text = f"## {title}\n\n{_health(rows)}\n\n![{title}]({name}.png)\n\n{note}"
        if name not in relations.CANDIDATES:
            return text
        for chooser in ("chosen", "chosen, highest score"):
            words = comparison.choice_words(comparison.choice_gaps(rows, chooser, relations.CANDIDATES[name]))
            text += "\n".join([f"\n\n`{chooser}`:\n", *(f"- {sentence}" for sentence in words)])
        return text

    return part


def _learners(rows: list[Row], folder: pathlib.Path) -> str:
    lines = summaries.write("learners", rows, folder)
    _save(figures.heat_map(lines, "Algorithm 1", "Algorithm 1"), folder / "learners")
    title = "Learners: weights from demonstrations, from expectations, and from nothing"
    text = f"## {title}\n\n{_health(rows)}\n\n![{title}](learners.png)"
    return f"{text}\n\n{learning_report.LEARNERS_NOTE}\n\n{learning_report.learners_table(lines)}"


def _guarantees(rows: list[Row], folder: pathlib.Path) -> str:
    lines = summaries.write("guarantees", rows, folder)
    _save(learning_report.guarantees_figure(lines), folder / "guarantees")
    title = "Guarantees: how much can be lost, and how much was"
    text = f"## {title}\n\n{_health(rows)}\n\n![{title}](guarantees.png)\n\n{learning_report.GUARANTEES_NOTE}"
    return f"{text}\n\n{learning_report.guarantees_words(rows, lines)}"


_PARTS = {
    "table1": _table1,
    "figure1": _figure1,
    "threshold": _question(
        "threshold",
        "Error threshold and distance: what do they do to off-roads, with two demonstrations?",
        figures.threshold_figure,
    ),
    "noise": _question(
        "noise",
        "A model estimated from n transitions per state and action: does a larger threshold forgive it?",
        figures.noise_figure,
    ),
    "enough": _question(
        "enough",
        f"How many demonstrations until the mean reward is within {1 - _WITHIN:.0%} of the expert's?",
        figures.enough_figure,
        _enough_table,
    ),
    "normalisation": _question(
        "normalisation",
        "Monte Carlo in Table I: discounted sums, or averages per step?",
        figures.normalisation_figure,
        lambda lines: _NORMALISATION_NOTE,
    ),
    "relations": _compared("relations", "Relations: what makes states similar, who votes", _RELATIONS_NOTE),
    "roads": _compared("roads", "Roads: labels that say how much of a detour an exit is", _ROADS_NOTE),
    "transfer": _compared("transfer", "Transfer: racetrack (a) demonstrated, (b) learned", _TRANSFER_NOTE),
    "learners": _learners,
    "guarantees": _guarantees,
    "queries": _question(
        "queries",
        "Queries: which single states to ask the expert about",
        learning_report.queries_figure,
        lambda lines: f"{learning_report.QUERIES_NOTE}\n\n{learning_report.queries_words(lines)}",
    ),
}


def _health(rows: Sequence[Row]) -> str:
    """How the rows were made and how they ended, in a sentence."""
    good = [row for row in rows if not row.error]
    settings = {row.key[:8] for row in rows}
    draws = max(row.draw + 1 for row in rows)
    solved = [row for row in good if row.status not in ("", "none")]
    unsolved = sum(row.status != "SOLVED" for row in solved)
    gaps = [row.certificate for row in solved if row.certificate is not None]
    hours, by_method = sum(row.seconds or 0.0 for row in rows) / 3600, collections.Counter()
    for row in rows:
        by_method[row.method] += (row.seconds or 0.0) / 3600
    longest = ", ".join(f"{name} {part / hours:.0%}" for name, part in by_method.most_common(3) if hours)
    commits = ", ".join(sorted({row.commit for row in rows if row.commit}))
    return (
        f"{len(rows)} rows: {len(settings)} settings, up to {draws} draws each; {len(rows) - len(good)} failed; "
        f"{unsolved} of {len(solved)} solver runs short of their tolerance, largest certificate "
        f"{max(gaps, default=float('nan')):.1e} per step; {hours:.2f} h of solver time ({longest}); commit {commits}."
    )


def _save(figure, stem: pathlib.Path) -> None:
    figure.savefig(stem.with_suffix(".png"), dpi=130)
    figure.savefig(stem.with_suffix(".svg"), metadata={"Date": None})
    matplotlib.pyplot.close(figure)


if __name__ == "__main__":
    sys.exit(main())
