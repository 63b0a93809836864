"""Rows of the benchmarks of speed: measured section by section, kept as CSV. Never imports JAX."""

import argparse
import csv
import dataclasses
import functools
import json
import pathlib
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from importlib import metadata

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")  # Okabe and Ito
MARKERS = "osD^vP*X"


@dataclasses.dataclass(frozen=True)
class Kind:
    """One kind of benchmark.

    Attributes:
      title: for the command line's help.
      module: `python -m bench.MODULE SECTION [--quick]` prints the rows of a section, each a line "ROW {json}".
      sections: all of them, in the order of the file; quick: those of a quick run.
      fields: the columns.
      shown: the fields that are printed while it runs.
      report: (rows, path of the CSV) -> writes the table and the figure beside it.
      has_methods: whether the module takes `--methods` and `--limit`.
    """

    title: str
    module: str
    sections: tuple[str, ...]
    quick: tuple[str, ...]
    fields: tuple[str, ...]
    shown: tuple[str, ...]
    report: Callable[[list[dict], pathlib.Path], None]
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

    def stays(row):
        return row["section"] != section or (methods is not None and not matches(row.get("method") or "", methods))

    return [row for row in rows if stays(row)]


def matches(method: str, wanted: list[str] | None) -> bool:
    """Whether a method's name begins with one of those that are wanted (all, if None)."""
    return wanted is None or any(method.startswith(name) for name in wanted)


def number(row: dict, name: str) -> float | None:
    """A field as a number, None where it is empty."""
    return float(row[name]) if row.get(name) not in (None, "") else None


def is_ours(row: dict) -> bool:
    """Whether a row is of this library."""
    return row["method"].startswith("jaxhom")


def is_batch(row: dict) -> bool:
    """Whether a row is of lanes that are solved together."""
    return (number(row, "lanes") or 1) > 1


def is_settled(row: dict) -> bool:
    """Whether a row has a time, and its worst lane the accuracy that was asked for."""
    return row["status"] == "measured" and number(row, "settled") == 1.0


def print_section(section: Callable[..., Iterator[dict]], names: Iterable[str]) -> None:
    """The command line of a section's process: prints its rows as JSON lines."""
    parser = argparse.ArgumentParser(description=print_section.__doc__)
    parser.add_argument("section", choices=sorted(names))
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--methods", nargs="+")
    parser.add_argument("--limit", type=float)
    arguments = parser.parse_args()
    for row in section(arguments.section, arguments.quick, arguments.methods, arguments.limit):
        print_row(row)


def print_row(row: dict) -> None:
    """How a section's process hands over a row."""
    print("ROW " + json.dumps(row), flush=True)


@functools.cache
def versions(*packages: str) -> str:
    """Of those packages that are installed."""
    found = []
    for name in packages:
        try:
            found.append(f"{name} {metadata.version(name)}")
        except metadata.PackageNotFoundError:
            continue
    return "; ".join(found)


@functools.cache
def commit() -> str:
    """Short hash of the working tree's commit, with a + if files differ from it."""
    command = ["git", "describe", "--always", "--dirty=+", "--exclude=*"]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    return found.stdout.strip() or "unknown"


def _short(value):
    return float(f"{value:.6g}") if isinstance(value, float) else value
