"""Text tables as people keep them: fields between commas, semicolons, tabs, bars or blanks.

Which of these stands between the fields is told by the first line: it is the one that finds the most column names in
it.
"""

from __future__ import annotations

import csv
import itertools
import os
from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

from jaxhom.interop.archives import FileError
from jaxhom.interop.column_names import KNOWN, plain
from jaxhom.interop.text_files import open_text

_DELIMITERS = (",", ";", "\t", "|")
_AT_ONCE = 300  # rows before they become parts of columns: what outlives them, the garbage collector looks through


class Table(NamedTuple):
    """A text file's lines, blank ones left out.

    Attributes:
      path: the file.
      delimiter: what stands between its fields; None for blanks.
      header: the names of its columns, as they stand in the first line.
      columns: the fields of the other lines, column by column; None where a line ends before.
      lines: the numbers of these lines in the file.
    """

    path: str | os.PathLike
    delimiter: str | None
    header: list[str]
    columns: list[list[str | None]]
    lines: list[int]

    def column(self, place: int) -> list[str]:
        """The fields of a column, without the blanks around them.

        Raises:
          FileError: naming the first line that ends before it.
        """
        cells = self.columns[place]
        if None in cells:
            index = cells.index(None)
            width = sum(column[index] is not None for column in self.columns)
            message = f"{width} fields, but the first line names more columns"
            raise FileError(f"{self.path} line {self.lines[index]}: {message}")
        return [cell.strip() for cell in cells if cell is not None]

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
    with open_text(path, newline="") as file:
        blank = []
        first = file.readline()
        while first and not first.strip():
            blank.append(first)
            first = file.readline()
        delimiter = _delimiter(first, set(map(plain, (columns or {}).values())))
        rows = _rows(path, itertools.chain(blank, [first] if first else [], file), delimiter)
        _, header = next(rows, (1, []))
        if header and header[0].startswith("#"):  # as `numpy.savetxt` marks it
            header[0] = header[0][1:]
            header = header if header[0].strip() else header[1:]
        table = Table(path, delimiter, header, [[] for _ in header], [])
        while part := list(itertools.islice(rows, _AT_ONCE)):
            _append(table, part)
    return table


def _rows(path: str | os.PathLike, file: Iterable[str], delimiter: str | None) -> Iterator[tuple[int, list[str]]]:
    """The number and the fields of every line that is not blank."""
    if delimiter is None:
        yield from ((number, fields) for number, line in enumerate(file, 1) if (fields := line.split()))
        return
    reader = csv.reader(file, delimiter=delimiter, strict=True)
    try:
        for row in reader:
            if len(row) > 1 or (row and row[0].strip()):
                yield reader.line_num, row
    except csv.Error as error:
        raise FileError(f"{path} line {reader.line_num}: {error}") from None


def _append(table: Table, part: list[tuple[int, list[str]]]) -> None:
    """Adds rows to a table; raises at the first with more fields than columns, unless the rest are empty."""
    width = len(table.header)
    for line, row in part:
        if len(row) > width:
            _join_brackets(row, table.delimiter or " ")
        if len(row) > width and any(field.strip() for field in row[width:]):
            raise FileError(f"{table.path} line {line}: {len(row)} fields, but the first line names {width} columns")
    lines, rows = zip(*part, strict=True)
    table.lines.extend(lines)
    for column, cells in zip(table.columns, itertools.zip_longest(*rows), strict=False):
        column.extend(cells)
    for column in table.columns:  # those that all these rows end before
        column.extend([None] * (len(table.lines) - len(column)))


def _join_brackets(row: list[str], delimiter: str) -> None:
    """Makes one field of what stands between brackets: `(0,1)` is often written without quotes."""
    fields: list[str] = []
    depth = 0
    for field in row:
        if depth > 0:
            fields[-1] += delimiter + field
        else:
            fields.append(field)
        depth += sum(field.count(mark) for mark in "([{") - sum(field.count(mark) for mark in ")]}")
    if depth == 0:
        row[:] = fields


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
