"""Maps of racetracks as text: one letter per cell, with or without the planning community's header.

    X x # o O   wall, obstacle       S s         road on the start line          (o: see below)
    @           out of bounds        F G g       finish line
    space . P p road, pothole

The first lines may give the size, in one of the forms in which `.track` files are passed around; the map that follows
must have that size:

    dim: 12 35      rows and columns
    12,35           rows and columns
    35 12           width and height, on one line or on two: in such files o is slippery road, here like all other road

Without a header short rows are filled up with wall. Beyond the map is wall. Blank lines at the end are no rows.
"""

import io
import os
import pathlib
import re
from collections.abc import Iterable, Sequence
from importlib import resources

SHIPPED = ("a", "b")

_LETTERS = {
    **dict.fromkeys("Xx#oO@", "#"),
    **dict.fromkeys(" .Pp", "."),
    **dict.fromkeys("Ss", "S"),
    **dict.fromkeys("GgF", "F"),
}
_ROWS_FIRST = re.compile(r"\s*(?:dim:\s*(\d+)\s+(\d+)|(\d+)\s*,\s*(\d+))\s*", re.ASCII | re.IGNORECASE)
_WIDTH_FIRST = re.compile(r"\s*(\d+)\s+(\d+)\s*", re.ASCII)
_HEADER = re.compile(r"\s*(?:dim\b|\d)", re.ASCII | re.IGNORECASE)


def read_map(track: str | os.PathLike | Iterable[str]) -> tuple[str, ...]:
    """Reads a map and returns its rows in the letters `#.SF`, all of the same length.

    Args:
      track: the name of a shipped track ("a" or "b"); or the path of a file; or a map, as text with line breaks or as
        lines.

    Raises:
      ValueError: on an unknown letter (naming its line and column, counted from 1, the header included), on a header
        that is malformed or disagrees with the map, and on a map without road or without finish line.
      FileNotFoundError: if `track` is text without line breaks, and neither a shipped track nor a file.
    """
    lines = _lines(track)
    while lines and not lines[-1]:
        lines.pop()
    size, first, letters = _header(lines)
    rows = [_row(text, line, letters) for line, text in enumerate(lines[first:], start=first + 1)]
    if size is None:
        width = max(map(len, rows), default=0)
        rows = [row.ljust(width, "#") for row in rows]
    else:
        _require_size(rows, *size, first)
    if not any(letter in row for row in rows for letter in ".S"):
        raise ValueError(f"track has no road cell (space, . or S) in its {len(rows)} rows")
    if not any("F" in row for row in rows):
        raise ValueError(f"track has no finish cell (F or G) in its {len(rows)} rows")
    return tuple(rows)


def _lines(track) -> list[str]:
    """The lines of a shipped track, a file, a text or a sequence of lines, without their line breaks."""
    if isinstance(track, str | os.PathLike):
        text = track if isinstance(track, str) and ("\n" in track or "\r" in track) else _file_text(track)
        return [line.rstrip("\n") for line in io.StringIO(text, newline=None)]
    try:
        lines = list(track)
    except TypeError:
        raise ValueError(f"track must be a name, a path or a map, got {type(track).__name__}") from None
    for number, line in enumerate(lines, start=1):
        if not isinstance(line, str):
            raise ValueError(f"track line {number} must be text, got {type(line).__name__}")
    return [line.rstrip("\r\n") for line in lines]


def _file_text(track: str | os.PathLike) -> str:
    """The contents of a shipped track or of a file."""
    if isinstance(track, str) and track in SHIPPED:
        return (resources.files("jaxhom.domains") / "tracks" / f"{track}.track").read_text(encoding="utf-8")
    if not os.path.isfile(track):
        shipped = ", ".join(SHIPPED)
        raise FileNotFoundError(f"track {str(track)!r} is neither shipped ({shipped}) nor a file")
    try:
        return pathlib.Path(track).read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"track {str(track)!r} is not a text file: {error.reason} at byte {error.start}") from None


def _header(lines: Sequence[str]) -> tuple[tuple[int, int] | None, int, dict[str, str]]:
    """(rows, columns) as a header has them, None without one, the number of its lines, and what the letters mean."""
    if not lines or not _HEADER.match(lines[0]):
        return None, 0, _LETTERS
    if match := _ROWS_FIRST.fullmatch(lines[0]):
        rows, columns = (int(number) for number in match.groups() if number)
        return (rows, columns), 1, _LETTERS
    for used in (1, 2):
        if match := _WIDTH_FIRST.fullmatch(" ".join(lines[:used])):
            return (int(match[2]), int(match[1])), used, {**_LETTERS, "o": ".", "O": "."}
    raise ValueError(
        "track line 1: a header must be `dim: rows columns`, `rows,columns`, or width and height on one line or on two"
    )


def _row(text: str, line: int, letters: dict[str, str]) -> str:
    """One line of a map in the letters `#.SF`."""
    for column, letter in enumerate(text, start=1):
        if letter not in letters:
            raise ValueError(
                f"track line {line}, column {column}: unknown letter {letter!r}; "
                "use X, x, #, o or @ (wall), space, . or p (road), S or s (start), F, G or g (finish)"
            )
    return "".join(letters[letter] for letter in text)


def _require_size(rows: Sequence[str], height: int, width: int, header_lines: int) -> None:
    """Raises unless the map is as large as its header says: it may have been cut off or lost its last blanks."""
    if len(rows) != height:
        raise ValueError(f"track has {len(rows)} rows, but its header says {height} rows of {width} columns")
    for line, row in enumerate(rows, start=header_lines + 1):
        if len(row) != width:
            raise ValueError(
                f"track line {line} has {len(row)} columns, but its header says {height} rows of {width} columns"
            )
