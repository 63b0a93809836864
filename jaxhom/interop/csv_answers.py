"""Answers about single states in text files, one a line: read, and added to.

Columns, delimiters and names of states and actions are as in `csv_steps`.
"""

from __future__ import annotations

import csv
import io
import os
from typing import TYPE_CHECKING

import numpy as np

from jaxhom.interop.archives import FileError
from jaxhom.interop.csv_rows import read_table
from jaxhom.interop.csv_steps import column_of_indices, places_of
from jaxhom.interop.numbering import NO_ACTION, numberings
from jaxhom.models.inputs import as_model
from jaxhom.models.mdp import MDP
from jaxhom.models.names import described

if TYPE_CHECKING:
    from jaxtyping import Int

_COLUMNS = ("state", "action")


def answers_from_csv(path: str | os.PathLike, *, mdp: MDP) -> tuple[Int[np.ndarray, " N"], Int[np.ndarray, " N"]]:
    """Reads what an expert said to do in single states: a text file with one answer a line.

    The first line names the columns. Needed are `state` and `action` (whole numbers from 0 on, or the model's names);
    others are ignored. A line with an empty action is a question that was not answered, and is skipped.

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
    mdp, table = as_model(mdp), read_table(path)
    places = places_of(table, _COLUMNS)
    of_states, of_actions = numberings(mdp)
    states = column_of_indices(table, places["state"], of_states)
    actions = column_of_indices(table, places["action"], of_actions, NO_ACTION)
    is_bad = (actions >= 0) & ~np.asarray(mdp.allowed)[states, actions]
    if is_bad.any():
        row = int(is_bad.argmax())
        action, state = described(actions[row], mdp.action_names), described(states[row], mdp.state_names)
        raise table.refuse(row, places["action"], f"{action} is not allowed in state {state}")
    return states[actions >= 0], actions[actions >= 0]


def append_answer(path: str | os.PathLike, state: int, action: int, *, mdp: MDP) -> None:
    """Adds a line to a file of answers, in its columns; begins the file if there is none.

    State and action are written as `answers_from_csv` reads them with the same model: by name where a name is a number.

    Raises:
      FileError: if the file is no text, compressed, or lacks a column, or has others that blanks cannot leave empty.
      OSError: if it cannot be written.
    """
    header, delimiter, is_new = list(_COLUMNS), ",", not os.path.exists(path) or not os.path.getsize(path)
    places = dict(zip(_COLUMNS, range(2), strict=True))
    if not is_new:
        table = read_table(path)
        header, delimiter, places = table.header, table.delimiter or " ", places_of(table, _COLUMNS)
        if delimiter == " " and len(header) > len(_COLUMNS):
            raise FileError(f"{path}: an answer has no more than {' and '.join(_COLUMNS)} to write between blanks")
    fields = [""] * len(header)
    of_states, of_actions = numberings(mdp)
    fields[places["state"]], fields[places["action"]] = of_states.text_of(state), of_actions.text_of(action)
    with open(path, "a+b") as file:
        if file.seek(0) == 0 and file.read(2) == b"\x1f\x8b":
            raise FileError(f"{path}: it is compressed, and nothing can be added to it")
        lines = [_line(fields, delimiter), ""]
        if is_new:
            lines = [_line(header, delimiter), *lines]
        elif file.seek(-1, os.SEEK_END) and file.read() not in (b"\n", b"\r"):
            lines = ["", *lines]
        file.write("\n".join(lines).encode())


def _line(fields: list[str], delimiter: str) -> str:
    written = io.StringIO()
    csv.writer(written, delimiter=delimiter, lineterminator="").writerow(fields)
    return written.getvalue()
