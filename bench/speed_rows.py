"""Rows of the benchmarks of speed: measured section by section, kept as CSV. Never imports JAX."""

import contextlib
import csv
import dataclasses
import pathlib
import sys
from collections.abc import Callable, Iterator

from bench.processes import NoAnswer, Worker
from bench.provenance import provenance as provenance  # what every row ends with


@dataclasses.dataclass(frozen=True)
class Kind:
    """One kind of benchmark.

    Attributes:
      title: for the command line's help.
      module: its `section(name, quick, methods, limit)` measures the rows of a section.
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


def measure(kind: Kind, section: str, options: dict) -> Iterator[dict]:
    """Rows of one section, measured in a process of its own; a section that fails is a row too."""
    arguments = {"name": section} | options
    with contextlib.closing(Worker(f"bench.{kind.module}", "section", arguments)) as worker:
        try:
            while (row := worker.receive()) is not None:
                print("  ", *(_short(row.get(name, "")) for name in kind.shown), file=sys.stderr, flush=True)
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
    return [row for row in rows if row["section"] != section or (methods and not matches(row["method"] or "", methods))]


def matches(method: str, wanted: list[str] | None) -> bool:
    """Whether a method's name begins with one of those that are wanted (all, if None)."""
    return wanted is None or method.startswith(tuple(wanted))


def _short(value):
    return float(f"{value:.6g}") if isinstance(value, float) else value
