"""How fast the library is, next to other solvers on the same instances.

    python -m bench.speed similarity | lpal | planning | first [--quick] [--sections NAME ...] [--methods NAME ...]

writes one row per measurement to `bench/results/speed_KIND.csv`, and from the rows alone a Markdown table and a log-log
figure beside it; `--report` makes these two again from the rows on disk without measuring anything. Where `--sections`
or `--methods` are given, the other rows on disk stay. This module never imports JAX: every section runs in a process of
its own (`bench.similarity_speed`, `bench.lpal_speed`, `bench.planning_speed`, `bench.first_speed`).
"""

import argparse
import contextlib
import csv
import dataclasses
import pathlib
import sys
from collections.abc import Callable, Iterator

from bench import first_report, speed_report
from bench.processes import NoAnswer, Worker
from bench.provenance import RESULTS, add_output, require_clean


@dataclasses.dataclass(frozen=True)
class Kind:
    """One kind of benchmark.

    Attributes:
      title: for the command line's help.
      sections: all of them, in the order of the file; quick: those of a quick run.
      fields: the columns.
      table: rows -> Markdown. figure: rows -> figure, None if there is nothing to draw.
      has_methods: whether the user may choose methods and a limit.
    """

    title: str
    sections: tuple[str, ...]
    quick: tuple[str, ...]
    fields: tuple[str, ...]
    table: Callable
    figure: Callable
    has_methods: bool = False


KINDS = {
    "similarity": Kind(
        title="local and global homomorphisms, against other LP solvers",
        sections=(
            *("peak", "brackets", "counts", "decisions", "gradients", "peers"),
            *("racetrack", "roads", "algorithm1", "global", "global_large"),
        ),
        quick=("brackets", "decisions", "gradients", "peers"),
        fields=(
            *("section", "work", "n", "m", "actions", "pairs", "method", "dtype", "device", "devices", "processes"),
            *("gap_asked", "gap_certified", "settled", "compile_s", "build_s", "seconds", "ms_per_pair"),
            *("gflops", "peak_fraction", "gbytes_per_s", "status", "note", "versions", "commit"),
        ),
        table=speed_report.similarity_table,
        figure=speed_report.similarity_figure,
    ),
    "lpal": Kind(
        title="LPAL, against other LP solvers",
        sections=(  # the instances, small ones first
            *("grid16", "grid16_exact", "grid16_monte_carlo", "grid24", "bumps24", "grid32", "grid48", "grid48_exact"),
            *("grid48_monte_carlo", "garnet", "racetrack_a", "racetrack_b", "bumps48", "grid100", "grid316"),
            "grid1000",
        ),
        quick=("grid16", "racetrack_b"),
        fields=(
            *("section", "instance", "S", "A", "K", "lanes", "method", "processes", "dtype", "device"),
            *("seconds", "compile_s", "build_s", "gap_asked", "gap_certified", "settled", "iterations"),
            *("status", "note", "versions", "commit"),
        ),
        table=speed_report.lpal_table,
        figure=speed_report.lpal_figure,
        has_methods=True,
    ),
    "planning": Kind(
        title="planning and occupancies, against MDP toolboxes and SciPy",
        sections=("grid16", "grid32", "grid48", "grid100", "grid316", "racetrack_a", "garnet_dense", "garnet_sparse"),
        quick=("grid16", "garnet_sparse"),
        fields=(
            *("section", "instance", "work", "S", "A", "lanes", "method", "processes", "dtype", "device"),
            *("seconds", "compile_s", "build_s", "error_asked", "error", "settled", "iterations"),
            *("status", "note", "versions", "commit"),
        ),
        table=speed_report.planning_table,
        figure=speed_report.planning_figure,
        has_methods=True,
    ),
    "first": Kind(
        title="what a fresh process waits for: steps, pairs, and the whole path as one program",
        sections=(
            "steps",
            *("pairs_2", "pairs_100", "pairs_1000", "pairs_10000"),
            *("decisions_2", "decisions_100", "decisions_1000", "decisions_10000"),
            *("pairs_mixed", "decisions_mixed"),
            *("draws_grid16", "draws_grid16_two_devices", "draws_racetrack_a"),
        ),
        quick=("pairs_2", "pairs_mixed", "draws_grid16"),
        fields=(
            *(
                "section",
                "instance",
                "method",
                "cache",
                "draws",
                "devices",
                "prepare_s",
                "first_s",
                "seconds",
                "peak_gb",
            ),
            *("settled", "status", "note", "versions", "commit"),
        ),
        table=first_report.table,
        figure=first_report.figure,
    ),
}


_LIMIT, _QUICK_LIMIT = 300.0, 60.0  # seconds for a row, so that all of them take hours and not days
# Fields that are printed while it runs, where a row has them.
_PRINTED = ("work", "method", "dtype", "n", "pairs", "lanes", "ms_per_pair", "seconds", "settled", "status", "note")


def run(arguments: argparse.Namespace) -> None:
    """Measures, writes rows after each of them, and reports."""
    kind, path, methods = KINDS[arguments.kind], arguments.output, arguments.methods
    if not arguments.report:
        wanted = arguments.sections or (kind.quick if arguments.quick else kind.sections)
        rows = read(path) if path.exists() and (arguments.sections or methods) else []
        limit = arguments.limit or (_QUICK_LIMIT if arguments.quick else _LIMIT)
        options = {"quick": arguments.quick, "methods": methods, "limit": limit}
        for section in wanted:
            print(section, file=sys.stderr, flush=True)
            rows = replace_rows(rows, section, methods)
            for row in measure(arguments.kind, section, options):
                rows.append(row)
                rows.sort(key=lambda row: kind.sections.index(row["section"]))
                write(path, rows, kind.fields)
    report(kind, path)


def report(kind: Kind, path: pathlib.Path) -> None:
    """The table and the figure, beside the CSV file."""
    rows = read(path)
    path.with_suffix(".md").write_text(kind.table(rows))
    figure = kind.figure(rows)
    if figure is not None:
        figure.savefig(path.with_suffix(".png"), dpi=130)


def measure(kind: str, section: str, options: dict) -> Iterator[dict]:
    """Rows of one section, measured in a process of its own; a section that fails is a row too."""
    arguments = {"name": section} | options
    with contextlib.closing(Worker(f"bench.{kind}_speed", "section", arguments)) as worker:
        try:
            while (row := worker.receive()) is not None:
                print(
                    "  ",
                    *(_short(row[name]) for name in _PRINTED if row.get(name) is not None),
                    file=sys.stderr,
                    flush=True,
                )
                yield {"section": section} | row
        except NoAnswer as error:
            yield {"section": section} | error.fields


def read(path: pathlib.Path) -> list[dict]:
    """Rows of a CSV file, all fields as text."""
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def write(path: pathlib.Path, rows: list[dict], fields: tuple[str, ...]) -> None:
    """Writes rows as CSV."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, fields)
        writer.writeheader()
        writer.writerows([{name: _short(value) for name, value in row.items()} for row in rows])


def replace_rows(rows: list[dict], section: str, methods: list[str] | None) -> list[dict]:
    """The rows that stay when a section is measured again: those of other sections, and of methods not asked for."""
    begins = tuple(methods or [""])
    return [row for row in rows if row["section"] != section or not row["method"].startswith(begins)]


def _short(value):
    return float(f"{value:.6g}") if isinstance(value, float) else value


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m bench.speed", description="Benchmarks of speed.")
    commands = parser.add_subparsers(dest="kind", required=True)
    for name, kind in KINDS.items():
        command = commands.add_parser(name, help=kind.title)
        command.add_argument("--quick", action="store_true", help="a few small instances, to see that it runs")
        command.add_argument("--sections", nargs="+", choices=kind.sections, help="only these; rows of others stay")
        command.add_argument("--report", action="store_true", help="table and figure from the rows on disk")
        add_output(command, RESULTS / f"speed_{name}.csv")
        command.set_defaults(methods=None, limit=None)
        if kind.has_methods:
            command.add_argument("--methods", nargs="+", help="only those whose names begin so; rows of others stay")
            command.add_argument("--limit", type=float, help="seconds that a measurement may take")
    options = parser.parse_args()
    if not options.report:
        require_clean(parser, options)
    run(options)


if __name__ == "__main__":
    main()
