"""Texts in rows and columns, read a column at a time; what is wrong is named by its line."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Callable, Iterable
from typing import NoReturn

import numpy as np

from jaxhom.interop.files import FileError
from jaxhom.interop.text_files import open_text


@dataclasses.dataclass(frozen=True, eq=False)
class TextTable:
    """The rows of a file.

    Attributes:
      path: the file.
      lines: on which line each row stands.
      rows: the fields of each.
    """

    path: str | os.PathLike
    lines: list[int]
    rows: list[list[str]]

    @classmethod
    def of_words(cls, path: str | os.PathLike, comment: str = "#") -> TextTable:
        """Words with blanks between them, without blank lines and those that begin with `comment`."""
        with open_text(path) as file:
            split = [line.split() for line in file]
        kept = [n for n, words in enumerate(split) if words and not words[0].startswith(comment)]
        return cls(path, [n + 1 for n in kept], [split[n] for n in kept])

    def after(self, count: int) -> TextTable:
        """The table without its first rows."""
        return TextTable(self.path, self.lines[count:], self.rows[count:])

    def error(self, row: int, message: str) -> FileError:
        """What is wrong with a row."""
        return FileError(f"{self.path} line {self.lines[row]}: {message}")

    def require_width(self, least: int, most: int, expected: str) -> None:
        """Raises unless all rows have so many fields."""
        for row, fields in enumerate(self.rows):
            if not least <= len(fields) <= most:
                raise self.error(row, f"expected `{expected}`, got {' '.join(fields)!r}")

    def whole_numbers(self, place: int, name: str, upper: int = 2**31 - 1) -> np.ndarray:
        """int [rows]: a column of whole numbers in [0, upper)."""
        numbers = self._column(place, name, int, "a whole number")
        wrong = (numbers < 0) | (numbers >= upper)
        if wrong.any():
            self._refuse(int(np.argmax(wrong)), place, name, f"must lie in [0, {upper})")
        return numbers

    def numbers(self, place: int, name: str) -> np.ndarray:
        """float [rows]: a column of finite numbers."""
        numbers = self._column(place, name, float, "a number")
        wrong = ~np.isfinite(numbers)
        if wrong.any():
            self._refuse(int(np.argmax(wrong)), place, name, "must be finite")
        return numbers

    def texts(self, place: int) -> list[str]:
        """A column as it stands."""
        return [fields[place] for fields in self.rows]

    def _column(self, place: int, name: str, kind: Callable, what: str) -> np.ndarray:
        texts = self.texts(place)
        try:
            return np.array([*map(kind, texts)], kind)
        except (ValueError, OverflowError):  # whole numbers of more than 64 bits are the latter
            row = next(row for row, text in enumerate(texts) if not _is(kind, text))
            self._refuse(row, place, name, f"must be {what}")

    def _refuse(self, row: int, place: int, name: str, message: str) -> NoReturn:
        raise self.error(row, f"{name} {message}, got {self.rows[row][place]!r}")


def _is(kind: Callable, text: str) -> bool:
    try:
        return math.isinf(kind(text)) or abs(kind(text)) < 2**63 or kind is float
    except ValueError:
        return False


def numbered(values: Iterable) -> tuple[list, dict]:
    """Different values in the order in which they come, and the number of each."""
    numbers: dict = {}
    for value in values:
        numbers.setdefault(value, len(numbers))
    return [*numbers], numbers
