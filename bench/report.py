"""Turns rows into tables, figures and words: `python -m bench.report`. Nothing is computed but means over rows.

Reads `<results>/raw/*.csv`; writes summaries (CSV), Table I (Markdown and LaTeX), figures (PNG and SVG), and all of it
in `report.md`.
"""

import argparse
import pathlib
import sys
from collections.abc import Callable, Sequence

import matplotlib

from bench import comparison, figures, summaries, tables
from bench.intervals import CONFIDENCE
from bench.rows import ROOT, Row, read_rows

_WITHIN = 0.99


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns 0, or 2 if there are no rows."""
    parser = argparse.ArgumentParser(prog="python -m bench.report", description=__doc__.splitlines()[0])
    results = ROOT / "bench" / "results"
    parser.add_argument("--results", type=pathlib.Path, default=results, help="folder (default bench/results)")
    folder = parser.parse_args(arguments).results
    matplotlib.use("agg")
    matplotlib.rcParams["svg.hashsalt"] = "bench"  # the same rows give the same file
    parts = [part(folder) for part in (_table1, _figure1, _threshold, _noise, _enough, _normalisation)]
    text = "\n\n".join(part for part in parts if part)
    if not text:
        print(f"bench: error: no rows in {folder / 'raw'}: run python -m bench.reproduce first", file=sys.stderr)
        return 2
    (folder / "report.md").write_text(f"{_HEAD}\n\n{text}\n")
    print(folder / "report.md")
    return 0


_HEAD = f"""# Results

Written by `python -m bench.report` from the rows in `raw/`. Intervals are {CONFIDENCE:.0%} confidence intervals of
means over draws, by Student's t; evaluation is exact, in trials of the demonstrations' length or the paper's. Ratios to
the expert are taken draw by draw."""


def _table1(folder: pathlib.Path) -> str:
    rows = _read(folder, "table1")
    if not rows:
        return ""
    lines = summaries.summarise_table1(rows)
    summaries.write_csv(folder / "table1.csv", summaries.TABLE1_COLUMNS, lines)
    cells = comparison.compare_table1(rows)
    reward, ratio = tables.table1_reward(cells), tables.table1_ratio(cells)
    markdown = "\n\n".join(
        [
            f"## Table I\n\n{_health(rows)}\n\nAverage reward per step ± half its interval (printed in the paper):",
            tables.to_markdown(*reward),
            "Percent of the expert's reward in the same draw (of the printed expert's); † where the paper's number is "
            "outside our interval, * where it is out of reach of single draws and of the noise of 1000 trials, too:",
            tables.to_markdown(*ratio),
            *comparison.table1_words(cells, comparison.compare_orders(rows)),
        ]
    )
    (folder / "table1.md").write_text(markdown + "\n")
    (folder / "table1.tex").write_text(tables.to_latex(*reward) + "\n" + tables.to_latex(*ratio))
    return markdown


def _figure1(folder: pathlib.Path) -> str:
    rows = _read(folder, "figure1")
    if not rows:
        return ""
    lines = summaries.summarise_figure1(rows)
    summaries.write_csv(folder / "figure1.csv", summaries.FIGURE1_COLUMNS, lines)
    _save(figures.figure1(lines), folder / "figure1")
    words = comparison.figure1_words(comparison.compare_curves(rows))
    for track in dict.fromkeys(row.domain for row in rows):
        gap = comparison.largest_difference(rows, track, "soft_local_homomorphism_printed", "manhattan_knn")
        words.append(
            f"{figures.domain_name(track).capitalize()}: the program as printed differs from k-NN by at most {gap:.2g} "
            "in any metric of any draw."
        )
    listed = "\n".join(f"- {sentence}" for sentence in words)
    return f"## Figure 1\n\n{_health(rows)}\n\n![Figure 1](figure1.png)\n\n{_FIGURE1_NOTE}\n\n{listed}"


_FIGURE1_NOTE = """The paper prints no numbers for its Figure 1; what its text says of the curves is checked below. It
leaves open which features LPAL gets. Ours are the two that the reward is made of, on the road and finish, and with two
so telling features LPAL finds a fast lap whatever expectations it is given."""


def _threshold(folder: pathlib.Path) -> str:
    title = "Error threshold and distance: what do they do to off-roads, with two demonstrations?"
    return _question(folder, "threshold", title, figures.threshold_figure)


def _noise(folder: pathlib.Path) -> str:
    title = "A model estimated from n transitions per state and action: does a larger threshold forgive it?"
    return _question(folder, "noise", title, figures.noise_figure)


def _enough(folder: pathlib.Path) -> str:
    title = f"How many demonstrations until the mean reward is within {1 - _WITHIN:.0%} of the expert's?"
    text = _question(folder, "enough", title, figures.enough_figure)
    if not text:
        return ""
    lines = summaries.summarise_question(_read(folder, "enough"))
    methods = [name for name in figures.STYLES if name != "expert" and any(line["method"] == name for line in lines)]
    domains = list(dict.fromkeys(line["domain"] for line in lines))
    rows = [[figures.domain_name(domain), *(_needed(lines, domain, name) for name in methods)] for domain in domains]
    header = ["domain", *(figures.STYLES[name][0] for name in methods)]
    return f"{text}\n\n{tables.to_markdown(header, rows)}"


def _normalisation(folder: pathlib.Path) -> str:
    title = "Monte Carlo in Table I: discounted sums, or averages per step?"
    text = _question(folder, "normalisation", title, figures.normalisation_figure)
    return text and f"{text}\n\n{_NORMALISATION_NOTE}"


_NORMALISATION_NOTE = """Eq. (6) adds up over time, as LPAL's flow constraints do. Divided by the demonstrations'
length, the expectations hardly count against occupancies that sum to 1 / (1 - discount): LPAL then spreads its time
evenly over the regions, which earns about the mean weight, 0.05 a step. The printed numbers are of that size."""


def _needed(lines: Sequence[dict], domain: str, method: str) -> str:
    """The smallest number from which on the mean stays within reach; in brackets the same for the whole interval."""
    here = [line for line in lines if (line["domain"], line["method"], line["metric"]) == (domain, method, "ratio")]
    here.sort(key=lambda line: -line["demonstrations"])
    found = []
    for bound in ("mean", "ci_low"):
        reached = [line["demonstrations"] for line in _leading(here, lambda line, b=bound: line[b] >= _WITHIN)]
        found.append(str(min(reached)) if reached else f"> {here[0]['demonstrations']}")
    return found[0] if found[0] == found[1] else f"{found[0]} ({found[1]})"


def _leading(lines: Sequence[dict], is_good: Callable[[dict], bool]) -> list[dict]:
    """The lines before the first that is not good."""
    bad = [i for i, line in enumerate(lines) if not is_good(line)]
    return list(lines[: bad[0]] if bad else lines)


def _question(folder: pathlib.Path, name: str, title: str, draw: Callable) -> str:
    rows = _read(folder, name)
    if not rows:
        return ""
    lines = summaries.summarise_question(rows)
    summaries.write_csv(folder / f"{name}.csv", summaries.QUESTION_COLUMNS, lines)
    _save(draw(lines), folder / name)
    return f"## {title}\n\n{_health(rows)}\n\n![{title}]({name}.png)"


def _read(folder: pathlib.Path, name: str) -> list[Row]:
    """The rows of a sweep with the smallest seed that it has; none if it was not run."""
    path = folder / "raw" / f"{name}.csv"
    rows = read_rows(path) if path.exists() else []
    seed = min((row.seed for row in rows), default=None)
    return [row for row in rows if row.seed == seed]


def _health(rows: Sequence[Row]) -> str:
    """How the rows were made and how they ended, in a sentence."""
    good = [row for row in rows if not row.error]
    settings = {row.key[:8] for row in rows}
    draws = max((row.draw + 1 for row in rows), default=0)
    solved = [row for row in good if row.status not in ("", "none")]
    unsolved = sum(row.status != "SOLVED" for row in solved)
    gaps = [row.certificate for row in solved if row.certificate is not None]
    hours = sum(row.seconds or 0.0 for row in rows) / 3600
    commits = ", ".join(sorted({row.commit for row in rows if row.commit}))
    return (
        f"{len(rows)} rows: {len(settings)} settings, up to {draws} draws each; {len(rows) - len(good)} failed; "
        f"{unsolved} of {len(solved)} solver runs short of their tolerance, largest certificate "
        f"{max(gaps, default=float('nan')):.1e} per step; {hours:.2f} h of solver time; commit {commits}."
    )


def _save(figure, stem: pathlib.Path) -> None:
    figure.savefig(stem.with_suffix(".png"), dpi=130)
    figure.savefig(stem.with_suffix(".svg"), metadata={"Date": None})
    matplotlib.pyplot.close(figure)


if __name__ == "__main__":
    sys.exit(main())
