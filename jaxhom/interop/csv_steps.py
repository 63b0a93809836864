"""Demonstrations from comma-separated files with one step a line, and answers about single states likewise.

The file's first line names the columns; which are needed, and what else is understood, `demonstrations_from_csv` and
`answers_from_csv` say. Whatever is wrong is one `FileError` that names line and column. An episode of nothing but final
observations is dropped, and the report says so.
"""

from __future__ import annotations

import csv
import itertools
import os
from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jaxhom.interop.files import FileError
from jaxhom.interop.import_reports import LARGEST_INDEX, ImportReport, with_report
from jaxhom.models.demonstrations import Demonstrations
from jaxhom.models.inputs import as_model
from jaxhom.models.mdp import MDP

if TYPE_CHECKING:
    from jaxtyping import Int

COLUMNS = ("episode", "state", "action")
ANSWER_COLUMNS = COLUMNS[1:]
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
    rows = _rows(path)
    _, header = next(rows)
    places, of_step = _places(path, header, COLUMNS), _place_of_step(path, header)
    for line, row in rows:
        _require_fields(path, line, row, header)
        episode, state, action = _step(path, line, row, places, limits)
        number = None if of_step is None else _step_number(path, line, header, row, of_step)
        lines.setdefault(episode, []).append(_Line(line, number, state, action))
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


def answers_from_csv(path: str | os.PathLike, *, mdp: MDP) -> tuple[Int[np.ndarray, " N"], Int[np.ndarray, " N"]]:
    """Reads what an expert said to do in single states: a comma-separated file with one answer a line.

    The first line names the columns. Needed are `state` and `action` (whole numbers from 0 on); others are ignored. A
    line with an empty action is a question that was not answered, and is skipped.

    Args:
      path: the file, in UTF-8.
      mdp: the model, in which every state and action must exist, and be allowed.

    Returns:
      states: [N], and actions: [N], as `Demonstrations.with_answers` takes them; in the order of the file.

    Raises:
      FileError: if the file is missing or no text, lacks a column, or has a wrong field (naming line and column).

    Outside jit, vmap and grad only: what is read is checked on the host.

    Example:
      >>> import jaxhom, pathlib, tempfile
      >>> path = pathlib.Path(tempfile.mkdtemp(), "answers.csv")
      >>> _ = path.write_text("state,action\\n5,1\\n7,\\n2,3\\n")
      >>> states, actions = answers_from_csv(path, mdp=jaxhom.gridworld(3).mdp)
      >>> states.tolist(), actions.tolist()
      ([5, 2], [1, 3])
    """
    mdp, allowed = as_model(mdp), np.asarray(as_model(mdp).allowed)
    rows, answers = _rows(path), []
    _, header = next(rows)
    places = _places(path, header, ANSWER_COLUMNS)
    for line, row in rows:
        _require_fields(path, line, row, header)
        state, text = _fields(path, line, row, places)
        number = _whole_number(path, line, "state", state, mdp.num_states)
        action = _whole_number(path, line, "action", text, mdp.num_actions) if text else None
        if action is not None and not allowed[number, action]:
            raise FileError(f"{path} line {line}, column 'action': {action} is not allowed in state {number}")
        answers += [] if action is None else [(number, action)]
    states, actions = np.array(answers, int).reshape(-1, 2).T
    return states, actions


def append_answer(path: str | os.PathLike, state: int, action: int) -> None:
    """Adds a line to a file of answers, in its columns; begins the file if there is none.

    Raises:
      FileError: if the file is no text or lacks a column.
      OSError: if it cannot be written.
    """
    header, is_new = list(ANSWER_COLUMNS), not os.path.exists(path) or not os.path.getsize(path)
    if not is_new:
        _, header = next(_rows(path))
    fields = [""] * len(header)
    for place, number in zip(_places(path, header, ANSWER_COLUMNS), (state, action), strict=True):
        fields[place] = str(number)
    with open(path, "a+b") as file:
        lines = [",".join(fields), ""]
        if is_new:
            lines = [",".join(header), *lines]
        elif file.seek(-1, os.SEEK_END) and file.read() not in (b"\n", b"\r"):
            lines = ["", *lines]
        file.write("\n".join(lines).encode())


def _rows(path: str | os.PathLike) -> Iterator[tuple[int, list[str]]]:
    """The number and the fields of the first line, empty if there is none, and of all others that are not blank."""
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file, strict=True)
            yield 1, next(reader, [])
            for row in reader:
                if row:
                    yield reader.line_num, row
    except UnicodeDecodeError as error:
        raise FileError(f"{path}: not a text file in UTF-8 ({error.reason})") from None
    except OSError as error:
        raise FileError(f"{path}: {error.strerror or error}") from None
    except csv.Error as error:
        raise FileError(f"{path} line {reader.line_num}: {error}") from None


def _places(path, header: list[str], columns: tuple[str, ...]) -> list[int]:
    """Where the columns stand that are needed."""
    names = [name.strip().lower() for name in header]
    for column in columns:
        if names.count(column) != 1:
            how = "is missing" if column not in names else "occurs twice"
            found = ", ".join(map(repr, names)) or "nothing"
            raise FileError(
                f"{path} line 1: column {column!r} {how}; the first line must name the columns, got {found}"
            )
    return [names.index(column) for column in columns]


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
    episode, state_text, action = _fields(path, line, row, places)
    if not episode:
        raise FileError(f"{path} line {line}, column 'episode': is empty")
    state = _whole_number(path, line, "state", state_text, limits[0])
    return episode, state, _whole_number(path, line, "action", action, limits[1]) if action else None


def _fields(path, line: int, row: list[str], places: list[int]) -> list[str]:
    """The texts at the given places."""
    if len(row) <= max(places):
        raise FileError(f"{path} line {line}: {len(row)} fields, but the first line names more columns")
    return [row[place].strip() for place in places]


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
