"""Rows of the benchmarks of speed: measured section by section, kept as CSV. Never imports JAX."""

import argparse
import csv
import dataclasses
import json
import pathlib
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator

from bench.provenance import provenance as provenance  # what every row ends with


@dataclasses.dataclass(frozen=True)
class Kind:
    """One kind of benchmark.

    Attributes:
      title: for the command line's help.
      module: `python -m bench.MODULE SECTION [--quick]` prints the rows of a section, each a line "ROW {json}".
      sections: all of them, in the order of the file; quick: those of a quick run.
      fields: the columns.
      shown: the fields that are printed while it runs.
      table: rows -> Markdown. figure: rows -> a figure, or None if there is nothing to draw.
      has_methods: whether the user may choose methods and a limit.
    """

    title: str
    module: str
    sections: tuple[str, ...]
    quick: tuple[str, ...]
    fields: tuple[str, ...]
    shown: tuple[str, ...]
    table: Callable[[list[dict]], str]
    figure: Callable
    has_methods: bool = False


def measure(kind: Kind, section: str, options: list[str]) -> Iterator[dict]:
    """Rows of one section, measured in a process of its own; a section that fails is a row too."""
    command = [sys.executable, "-m", f"bench.{kind.module}", section, *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        for line in process.stdout:
            if line.startswith("ROW "):
                row = {"section": section} | json.loads(line.removeprefix("ROW "))
                print("  ", *(_short(row.get(name, "")) for name in kind.shown), file=sys.stderr, flush=True)
                yield row
    if process.returncode:
        yield {"section": section, "status": "failed", "note": f"exit code {process.returncode}"}


def print_section(section: Callable[..., Iterator[dict]], names: Iterable[str]) -> None:
    """The other side, the command line of a section's process: prints its rows."""
    parser = argparse.ArgumentParser(description=print_section.__doc__)
    parser.add_argument("section", choices=sorted(names))
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--methods", nargs="+")
    parser.add_argument("--limit", type=float)
    arguments = parser.parse_args()
    for row in section(arguments.section, arguments.quick, arguments.methods, arguments.limit):
        print("ROW " + json.dumps(row), flush=True)


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
    return [row for row in rows if row["section"] != section or (methods and not matches(row["method"] or "", methods))]


def matches(method: str, wanted: list[str] | None) -> bool:
    """Whether a method's name begins with one of those that are wanted (all, if None)."""
    return wanted is None or method.startswith(tuple(wanted))


def _short(value):
    return float(f"{value:.6g}") if isinstance(value, float) else value
