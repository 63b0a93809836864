"""How fast the library is, next to other solvers on the same instances.

    python -m bench.speed similarity | lpal | planning [--quick] [--sections NAME ...] [--methods NAME ...]

writes one row per measurement to `bench/results/speed_KIND.csv`, and from the rows alone a Markdown table and a log-log
figure beside it; `--report` makes these two again from the rows on disk without measuring anything. Where `--sections`
or `--methods` are given, the other rows on disk stay. This module never imports JAX: every section runs in a process of
its own (`bench.similarity_speed`, `bench.lpal_speed`, `bench.planning_speed`).
"""

import argparse
import pathlib
import sys

from bench import lpal_report, planning_report, similarity_report, speed_rows
from bench.provenance import RESULTS

KINDS = {"similarity": similarity_report.KIND, "lpal": lpal_report.KIND, "planning": planning_report.KIND}


def run(arguments: argparse.Namespace) -> None:
    """Measures, writes rows after each of them, and reports."""
    kind, path, methods = KINDS[arguments.kind], arguments.output, arguments.methods
    if not arguments.report:
        wanted = arguments.sections or (kind.quick if arguments.quick else kind.sections)
        rows = speed_rows.read(path) if path.exists() and (arguments.sections or methods) else []
        options = {"quick": arguments.quick, "methods": methods, "limit": arguments.limit}
        for section in wanted:
            print(section, file=sys.stderr, flush=True)
            rows = speed_rows.replace_rows(rows, section, methods)
            for row in speed_rows.measure(kind, section, options):
                rows.append(row)
                rows.sort(key=lambda row: kind.sections.index(row["section"]))
                speed_rows.write(path, rows, kind.fields)
    report(kind, path)


def report(kind: speed_rows.Kind, path: pathlib.Path) -> None:
    """The table and the figure, beside the CSV file."""
    rows = speed_rows.read(path)
    path.with_suffix(".md").write_text(kind.table(rows))
    figure = kind.figure(rows)
    if figure is not None:
        figure.savefig(path.with_suffix(".png"), dpi=130)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m bench.speed", description="Benchmarks of speed.")
    commands = parser.add_subparsers(dest="kind", required=True)
    for name, kind in KINDS.items():
        command = commands.add_parser(name, help=kind.title)
        command.add_argument("--quick", action="store_true", help="a few small instances, to see that it runs")
        command.add_argument("--sections", nargs="+", choices=kind.sections, help="only these; rows of others stay")
        command.add_argument("--report", action="store_true", help="table and figure from the rows on disk")
        command.add_argument("--output", type=pathlib.Path, default=RESULTS / f"speed_{name}.csv")
        command.set_defaults(methods=None, limit=None)
        if kind.has_methods:
            command.add_argument("--methods", nargs="+", help="only those whose names begin so; rows of others stay")
            command.add_argument("--limit", type=float, help="seconds that a measurement may take")
    run(parser.parse_args())


if __name__ == "__main__":
    main()
