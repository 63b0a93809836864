"""Texts in rows and columns, read a column at a time; what is wrong is named by its line."""

from __future__ import annotations

import csv
import dataclasses
import io
import os
from collections.abc import Hashable, Iterable
from typing import NoReturn

import numpy as np

from jaxhom import checks
from jaxhom.interop.archives import FileError
from jaxhom.interop.text_files import open_text

_END = "\N{OBJECT REPLACEMENT CHARACTER}"  # of a line, among words
_CHUNK = 100_000  # lines that are split at once


@dataclasses.dataclass(frozen=True, eq=False)
class TextTable:
    """The rows of a file.

    Attributes:
      path: the file.
      lines: on which line each row stands.
      columns: the fields, as texts; empty where a row has fewer than others.
      widths: int [rows], how many fields each row has.
    """

    path: str | os.PathLike
    lines: list[int]
    columns: list[list[str]]
    widths: np.ndarray

    @classmethod
    def of_words(cls, path: str | os.PathLike, comments: str = "#") -> TextTable:
        """Words with blanks between them; without blank lines, and those that begin with a letter of `comments`."""
        with open_text(path) as file:
            stripped = [line.strip() for line in file]
        kept = [number for number, line in enumerate(stripped, start=1) if not _is_left_out(line, comments)]
        columns, widths = _split([stripped[number - 1] for number in kept], None)
        return cls(path, kept, columns, widths)

    @classmethod
    def of_separated(cls, path: str | os.PathLike, comments: str = "") -> TextTable:
        """Fields, some in quotes perhaps, with commas, semicolons or tabs between them; lines as in `of_words`.

        Which it is is the one of which the first line has most.
        """
        with open_text(path, newline="") as file:
            text = file.read()
        plain = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
        kept = [number for number, line in enumerate(plain, start=1) if not _is_left_out(line, comments)]
        separator = max(",;\t", key=plain[kept[0] - 1].count) if kept else ","
        if '"' in text:
            lines, rows = _quoted(path, text, separator, comments)
            columns, widths = _filled_up(rows)
            return cls(path, lines, columns, widths)
        columns, widths = _split([plain[number - 1] for number in kept], separator)
        return cls(path, kept, columns, widths)

    def __len__(self) -> int:
        return len(self.lines)

    def row(self, number: int) -> list[str]:
        """The fields of one row."""
        return [column[number] for column in self.columns[: self.widths[number]]]

    def after(self, count: int) -> TextTable:
        """The table without its first rows."""
        columns = [column[count:] for column in self.columns]
        return TextTable(self.path, self.lines[count:], columns, self.widths[count:])

    def error(self, row: int, message: str) -> FileError:
        """What is wrong with a row."""
        return FileError(f"{self.path} line {self.lines[row]}: {message}")

    def require_width(self, least: int, most: int, expected: str) -> None:
        """Raises unless all rows have so many fields."""
        wrong = (self.widths < least) | (self.widths > most)
        if wrong.any():
            row = int(np.argmax(wrong))
            raise self.error(row, f"expected {expected}, got {' '.join(self.row(row))!r}")

    def whole_numbers(self, place: int, name: str, upper: int = checks.LARGEST_INDEX, lower: int = 0) -> np.ndarray:
        """int [rows]: a column of whole numbers in [lower, upper)."""
        numbers = self._numbers(place, name, int, "a whole number")
        wrong = (numbers < lower) | (numbers >= upper)
        if wrong.any():
            self._refuse(int(np.argmax(wrong)), place, name, f"must lie in [{lower}, {upper})")
        return numbers

    def numbers(self, place: int, name: str) -> np.ndarray:
        """float [rows]: a column of finite numbers."""
        numbers = self._numbers(place, name, float, "a number")
        wrong = ~np.isfinite(numbers)
        if wrong.any():
            self._refuse(int(np.argmax(wrong)), place, name, "must be finite")
        return numbers

    def _numbers(self, place: int, name: str, kind: type[int] | type[float], what: str) -> np.ndarray:
        texts = self.columns[place] if len(self) else []
        try:
            if any("_" in text for text in texts):  # which Python takes for nothing
                raise ValueError
            return np.array([kind(text) for text in texts], np.dtype(kind))
        except (ValueError, OverflowError):  # whole numbers of more than 64 bits are the latter
            row = next(row for row, text in enumerate(texts) if not _is(kind, text))
            self._refuse(row, place, name, f"must be {what}")

    def _refuse(self, row: int, place: int, name: str, message: str) -> NoReturn:
        raise self.error(row, f"{name} {message}, got {self.columns[place][row]!r}")


def numbered(values: Iterable[Hashable]) -> tuple[list, np.ndarray]:
    """Different values in the order in which they come, and by number, int [N], what was given."""
    numbers: dict[Hashable, int] = {}
    which = [numbers.setdefault(value, len(numbers)) for value in values]
    return [*numbers], np.array(which, int)


def _is_left_out(line: str, comments: str) -> bool:
    begin = line.lstrip()[:1]
    return not begin or begin in comments


def _split(lines: list[str], separator: str | None) -> tuple[list[list[str]], np.ndarray]:
    """Columns and widths of lines; all lines of a chunk are split at once where they have equally many fields."""
    width = len(lines[0].split(separator)) if lines else 0
    columns: list[list[str]] = [[] for _ in range(width)]
    end = f" {_END} " if separator is None else f"{separator}{_END}{separator}"
    for first in range(0, len(lines), _CHUNK):
        chunk = lines[first : first + _CHUNK]
        fields = end.join(chunk).split(separator)
        ends = fields[width :: width + 1]
        if len(fields) != (width + 1) * len(chunk) - 1 or ends != [_END] * (len(chunk) - 1):
            return _filled_up([line.split(separator) for line in lines])
        for place, column in enumerate(columns):
            column += fields[place :: width + 1]
    return columns, np.full(len(lines), width)


def _filled_up(rows: list[list[str]]) -> tuple[list[list[str]], np.ndarray]:
    """Columns and widths of rows that may be of different lengths."""
    widths = np.array([*map(len, rows)], int)
    width = int(widths.max(initial=0))
    return [[row[place] if place < len(row) else "" for row in rows] for place in range(width)], widths


def _quoted(path: str | os.PathLike, text: str, separator: str, comments: str) -> tuple[list[int], list[list[str]]]:
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=separator, strict=True)
    lines, rows = [], []
    try:
        for row in reader:
            if any(map(str.strip, row)) and not (row[0].strip() and _is_left_out(row[0], comments)):
                lines.append(reader.line_num)
                rows.append(row)
    except csv.Error as error:
        raise FileError(f"{path} line {reader.line_num}: {error}") from None
    return lines, rows


def _is(kind: type[int] | type[float], text: str) -> bool:
    try:
        number = kind(text)
        return "_" not in text and (kind is float or -(2**63) <= number < 2**63)
    except ValueError:
        return False
