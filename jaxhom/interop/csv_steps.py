"""Demonstrations from comma-separated files with one step a line.

The file's first line names the columns; which are needed, and what else is understood, `demonstrations_from_csv` says.
Whatever is wrong is one `FileError` that names line and column. An episode of nothing but final observations is
dropped, and the report says so.
"""

from __future__ import annotations

import csv
import itertools
import os
from typing import NamedTuple

import numpy as np

from jaxhom.interop.files import FileError
from jaxhom.interop.import_reports import LARGEST_INDEX, ImportReport, with_report
from jaxhom.models.demonstrations import Demonstrations
from jaxhom.models.mdp import MDP

COLUMNS = ("episode", "state", "action")
STEP_COLUMNS = ("step", "t", "time", "timestep")


class _Line(NamedTuple):
    """One step of a file."""

    line: int
    number: int | None
    state: int
    action: int | None


def demonstrations_from_csv(path: str | os.PathLike, *, mdp: MDP | None = None) -> tuple[Demonstrations, ImportReport]:
    """Reads a comma-separated file with one step a line.

    The first line names the columns. Needed are `episode` (any text), `state` and `action` (whole numbers from 0 on);
    others are ignored. Lines of one episode are in the order of their column `step` (or `t`, `time`, `timestep`; whole
    numbers), or, without one, in the order of the steps as they stand; episodes may be interleaved. Blank lines are
    skipped. An empty action marks the final observation of its episode: where it ended, its final state.

    Args:
      path: the file, in UTF-8.
      mdp: a model in which every state and action must exist.

    Returns:
      The demonstrations, episodes in the order in which they begin, and the report: final observations, and episodes
      that hold nothing else.

    Raises:
      FileError: if the file is missing or no text, lacks a column, or has a wrong field (naming line and column).

    Outside jit, vmap and grad only: what is read is checked on the host.

    Example:
      >>> import pathlib, tempfile
      >>> path = pathlib.Path(tempfile.mkdtemp(), "walks.csv")
      >>> _ = path.write_text("episode,state,action\\nmonday,0,1\\nmonday,1,1\\nmonday,2,\\n")
      >>> demonstrations, report = demonstrations_from_csv(path)
      >>> demonstrations.states.tolist(), demonstrations.final_states.tolist()
      ([[0, 1]], [2])
      >>> print(report)
      1 episodes, 2 steps; 1 final observations
    """
    limits = (LARGEST_INDEX,) * 2 if mdp is None else (mdp.num_states, mdp.num_actions)
    lines: dict[str, list[_Line]] = {}
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file, strict=True)
            header = next(reader, [])
            places, of_step = _places(path, header), _place_of_step(path, header)
            for row in reader:
                if row:
                    _require_fields(path, reader.line_num, row, header)
                    episode, state, action = _step(path, reader.line_num, row, places, limits)
                    number = None if of_step is None else _step_number(path, reader.line_num, header, row, of_step)
                    lines.setdefault(episode, []).append(_Line(reader.line_num, number, state, action))
    except UnicodeDecodeError as error:
        raise FileError(f"{path}: not a text file in UTF-8 ({error.reason})") from None
    except OSError as error:
        raise FileError(f"{path}: {error.strerror or error}") from None
    except csv.Error as error:
        raise FileError(f"{path} line {reader.line_num}: {error}") from None
    kept, dropped, final = [], [], 0
    for episode, unsorted in lines.items():
        steps = _in_order(path, unsorted)
        actions = [step.action for step in steps if step.action is not None]
        if not actions:
            dropped.append((episode, "it has no actions"))
            continue
        final += len(steps) - len(actions)
        kept.append((np.array([step.state for step in steps]), np.array(actions)))
    try:
        return with_report(kept, dropped, final)
    except ValueError as error:
        raise FileError(f"{path}: {error}") from None


def _places(path, header: list[str]) -> list[int]:
    """Where the columns stand that are needed."""
    names = [name.strip().lower() for name in header]
    for column in COLUMNS:
        if names.count(column) != 1:
            how = "is missing" if column not in names else "occurs twice"
            found = ", ".join(map(repr, names)) or "nothing"
            raise FileError(
                f"{path} line 1: column {column!r} {how}; the first line must name the columns, got {found}"
            )
    return [names.index(column) for column in COLUMNS]


def _place_of_step(path, header: list[str]) -> int | None:
    """Where the steps' numbers stand, if there are any."""
    places = [place for place, name in enumerate(header) if name.strip().lower() in STEP_COLUMNS]
    if len(places) > 1:
        names = " and ".join(repr(header[place].strip()) for place in places)
        raise FileError(f"{path} line 1: columns {names} could both number the steps: keep one")
    return places[0] if places else None


def _require_fields(path, line: int, row: list[str], header: list[str]) -> None:
    if any(field.strip() for field in row[len(header) :]):
        raise FileError(f"{path} line {line}: {len(row)} fields, but the first line names {len(header)} columns")


def _step(path, line: int, row: list[str], places: list[int], limits: tuple[int, int]) -> tuple[str, int, int | None]:
    """Episode, state and action of one line; None for an empty action."""
    if len(row) <= max(places):
        raise FileError(f"{path} line {line}: {len(row)} fields, but the first line names more columns")
    episode, state_text, action = (row[place].strip() for place in places)
    if not episode:
        raise FileError(f"{path} line {line}, column 'episode': is empty")
    state = _whole_number(path, line, "state", state_text, limits[0])
    return episode, state, _whole_number(path, line, "action", action, limits[1]) if action else None


def _step_number(path, line: int, header: list[str], row: list[str], place: int) -> int:
    """The number of one line's step."""
    column, text = header[place].strip(), row[place].strip() if place < len(row) else ""
    try:
        return _whole_number(path, line, column, text, LARGEST_INDEX)
    except FileError as error:
        raise FileError(f"{error}: the column numbers the steps of an episode; call it otherwise if not") from None


def _whole_number(path, line: int, column: str, text: str, limit: int) -> int:
    is_plain = text.isascii() and text.isdigit() and len(text) < 16
    number = int(text) if is_plain else _whole_float(text)
    if number is None:
        raise FileError(f"{path} line {line}, column {column!r}: must be a whole number, got {text!r}")
    if not 0 <= number < limit:
        raise FileError(f"{path} line {line}, column {column!r}: must lie in [0, {limit}), got {text}")
    return int(number)


def _whole_float(text: str) -> float | None:
    """3.0 and the like, as programs write the integers of a column with empty fields; None for anything else."""
    try:
        number = float(text)
    except ValueError:
        return None
    return number if number.is_integer() and "_" not in text else None


def _in_order(path, lines: list[_Line]) -> list[_Line]:
    """The lines of one episode by their step numbers, if they have some."""
    if lines[0].number is not None:
        lines = sorted(lines, key=lambda line: line.number or 0)
        for former, line in itertools.pairwise(lines):
            if former.number == line.number:
                numbers = f"lines {former.line} and {line.line}"
                raise FileError(f"{path} {numbers}: step {line.number} occurs twice in its episode")
    for former, line in itertools.pairwise(lines):
        if former.action is None:
            raise FileError(
                f"{path} line {line.line}: a step after its episode's final observation (a line without action)"
            )
    return lines
