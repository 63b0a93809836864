"""Text tables as people keep them: fields between commas, semicolons, tabs, bars or blanks, columns by many names.

Which of these stands between the fields is told by the first line: it is the one that finds the most column names in
it.
"""

from __future__ import annotations

import csv
import os
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from jaxhom.interop.column_names import KNOWN, plain
from jaxhom.interop.files import FileError
from jaxhom.interop.text_files import open_text

_DELIMITERS = (",", ";", "\t", "|")


class Table(NamedTuple):
    """A text file's lines, blank ones left out.

    Attributes:
      path: the file.
      delimiter: what stands between its fields; None for blanks.
      header: the names of its columns, as they stand in the first line.
      rows: the fields of the other lines.
      lines: their numbers in the file.
    """

    path: str | os.PathLike
    delimiter: str | None
    header: list[str]
    rows: list[list[str]]
    lines: Sequence[int]

    def column(self, place: int) -> list[str]:
        """The fields of a column, without the blanks around them.

        Raises:
          FileError: naming the first line that ends before it.
        """
        try:
            return [row[place].strip() for row in self.rows]
        except IndexError:
            index = next(i for i, row in enumerate(self.rows) if len(row) <= place)
            message = f"{len(self.rows[index])} fields, but the first line names more columns"
            raise FileError(f"{self.path} line {self.lines[index]}: {message}") from None

    def refuse(self, index: int, place: int, reason: object) -> FileError:
        """The error about a field."""
        return FileError(f"{self.path} line {self.lines[index]}, column {self.header[place].strip()!r}: {reason}")


def read_table(path: str | os.PathLike, columns: Mapping[str, str] | None = None) -> Table:
    """Reads a text file whose first line names its columns.

    Args:
      path: the file, in UTF-8, compressed by gzip or not.
      columns: what the caller says that columns are called, by their roles.

    Raises:
      FileError: if it is missing, no text, or no table, naming the line.
    """
    lines: list[int] = []
    rows: list[list[str]] = []
    with open_text(path, newline="") as file:
        first = file.readline()
        delimiter = _delimiter(first, set(map(plain, (columns or {}).values())))
        if delimiter is None:
            for number, line in enumerate([first, *file], 1):
                if fields := line.split():
                    rows.append(fields)
                    lines.append(number)
        else:
            reader = csv.reader(_chain(first, file), delimiter=delimiter, strict=True)
            try:
                for row in reader:
                    if row:
                        rows.append(row)
                        lines.append(reader.line_num)
            except csv.Error as error:
                raise FileError(f"{path} line {reader.line_num}: {error}") from None
    header = rows[0] if rows else []
    if header and header[0].startswith("#"):  # as `numpy.savetxt` marks it
        header[0] = header[0][1:]
        header = header if header[0].strip() else header[1:]
    table = Table(path, delimiter, header, rows[1:], lines[1:])
    _require_fields(table)
    return table


def _delimiter(line: str, given: set[str]) -> str | None:
    """What stands between the fields of a file, by its first line; None for blanks."""
    known = given | KNOWN

    def found(delimiter: str | None) -> int:
        try:
            fields = line.lstrip("#").split() if delimiter is None else next(csv.reader([line], delimiter=delimiter))
        except (csv.Error, StopIteration):
            return 0
        return len(known.intersection(map(plain, fields)))

    return max((*_DELIMITERS, None), key=found)  # the first of the best: a comma if nothing is found


def _chain(first: str, rest: Iterable[str]) -> Iterable[str]:
    if first:
        yield first
    yield from rest


def _require_fields(table: Table) -> None:
    """Raises at the first line with more fields than columns, unless the rest are empty."""
    width = len(table.header)
    for row, line in zip(table.rows, table.lines, strict=True):
        if len(row) > width and any(field.strip() for field in row[width:]):
            raise FileError(f"{table.path} line {line}: {len(row)} fields, but the first line names {width} columns")
