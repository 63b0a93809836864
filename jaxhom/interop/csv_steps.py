"""Demonstrations from text files with one step a line: any delimiter, compressed or not, columns by their usual names.

The file's first line names the columns; which are needed, and what else is understood, `demonstrations_from_csv` says.
Whatever is wrong is one `FileError` that names line and column. An episode of nothing but final observations is
dropped, and the report says so.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from jaxhom import checks
from jaxhom.interop.archives import FileError, errors_of
from jaxhom.interop.column_names import find_columns, listed
from jaxhom.interop.csv_rows import Table, read_table
from jaxhom.interop.import_reports import ImportReport
from jaxhom.interop.numbering import NO_ACTION, Numbering, indices_by_cell, number_in_order, numberings, parsed
from jaxhom.interop.state_sequences import inferred_actions
from jaxhom.interop.step_assembly import assembled
from jaxhom.interop.step_order import Refusal, put_in_order
from jaxhom.models.demonstrations import Demonstrations
from jaxhom.models.mdp import MDP

_FLAGS = {"1": 1, "true": 1, "yes": 1, "t": 1, "1.0": 1, "0": 0, "false": 0, "no": 0, "f": 0, "0.0": 0, "": 0}


def demonstrations_from_csv(
    path: str | os.PathLike,
    *,
    mdp: MDP | None = None,
    columns: Mapping[str, str] | None = None,
    to_states: Callable[[Any], Any] | None = None,
    ambiguous: str = "hide",
) -> tuple[Demonstrations, ImportReport]:
    """Reads a text file with one step a line, its fields between commas, semicolons, tabs, bars or blanks.

    The first line names the columns, in any order; blank lines are skipped, and so is what has no role. Roles are

    * `state` (also `s`, `obs`, `observation`) and `action` (`a`, `act`): whole numbers from 0 on, or names that the
      model has for them. An empty action marks the final observation of its episode: where it ended, its final state.
      With a model, a file without the column is one of states alone, and `demonstrations_from_states` reads it;
    * `episode` (`trajectory`, `traj`, `run`, ...; `id` if nothing else is one): any text; episodes may be interleaved.
      Without it, an episode ends where the following say so;
    * `step` (`t`, `time`, `timestep`), whole numbers: puts the lines of an episode in order. Without it, steps are in
      the order of the lines;
    * `next_state` (`next_obs`, `s'`, ...): what followed; `terminated` (`terminal`, `done`) and `truncated`
      (`timeout`): whether the step ended its episode, or the episode was cut off; `start`: whether it is the first.

    Args:
      path: the file, in UTF-8, compressed by gzip or not.
      mdp: a model in which every state and action must exist; by its names for them, if it has some.
      columns: what a column is called that goes by none of the usual names, by its role: `{"state": "position"}`.
      to_states: takes the fields of the states as an array and returns as many state indices. Tuples and lists of
        numbers, as Python writes them, become rows: [T, D].
      ambiguous: of a file without actions, as in `demonstrations_from_states`.

    Returns:
      The demonstrations, episodes in the order in which they begin, and the report: final observations, and episodes
      that hold nothing else.

    Raises:
      FileError: if the file is missing or no text, lacks a column, or has a wrong field (naming line and column); if
        lines contradict each other.
      ValueError: if `columns` names a role that there is none of.

    Outside jit, vmap and grad only: what is read is checked on the host.

    Example:
      >>> import pathlib, tempfile
      >>> path = pathlib.Path(tempfile.mkdtemp(), "walks.csv")
      >>> _ = path.write_text("episode;obs;act\\nmonday;0;1\\nmonday;1;1\\nmonday;2;\\n")
      >>> demonstrations, report = demonstrations_from_csv(path)
      >>> demonstrations.states.tolist(), demonstrations.final_states.tolist()
      ([[0, 1]], [2])
      >>> print(report)
      1 episodes, 2 steps; 1 final observations
    """
    table = read_table(path, columns)
    needed = ("state",) if mdp is not None else ("state", "action")  # a model finds the actions between states
    places = places_of(table, needed, columns)
    if not table.lines:
        raise FileError(f"{path}: there are no episodes")
    states, actions = numberings(mdp)
    values, names = _plain_columns(table, places)
    for role in ("state", "next_state"):
        if role in places:
            values[role] = _states(table, places[role], states, to_states)
    has_action = np.ones(len(table.lines), bool)
    if "action" in places:
        values["action"], has_action = _actions(table, places["action"], actions)
    try:
        rows = put_in_order(values, has_action)
    except Refusal as refusal:
        where = refusal.said("line", lambda row: table.lines[row])
        raise FileError(f"{path} {where}" if refusal.rows else f"{path} line 1: {refusal}") from None
    if "episode" not in values:
        names = range(len(rows.first))
    with errors_of(path):
        if mdp is None or "action" in values:
            demonstrations, report = assembled(rows, values, has_action, names)
        else:
            demonstrations, report = inferred_actions(mdp, rows.states(values, has_action), names, ambiguous)
    unread = [name.strip() for place, name in enumerate(table.header) if place not in places.values()]
    return demonstrations, dataclasses.replace(report, unread=tuple(unread))


def places_of(table: Table, needed: Sequence[str], columns: Mapping[str, str] | None = None) -> dict[str, int]:
    """Where the columns stand, by their roles.

    Raises:
      FileError: if one that is needed is missing, or two could be the same.
    """
    try:
        places = find_columns(table.header, columns)
    except ValueError as error:
        raise FileError(f"{table.path} line 1: {error}") from None
    for role in needed:
        if role not in places:
            found = listed(name.strip().lower() for name in table.header)
            raise FileError(
                f"{table.path} line 1: column {role!r} is missing; the first line must name the columns, got {found}"
            )
    return places


def column_of_indices(
    table: Table, place: int, numbering: Numbering, optional: frozenset[str] = frozenset()
) -> np.ndarray:
    """The indices in a column, [T]; -1 where it holds one of the texts that stand for none.

    Raises:
      FileError: naming the first line with something else.
    """
    cells = table.column(place)
    indices = indices_by_cell(cells, numbering.index_of_text)
    for row in np.flatnonzero(indices < 0):
        if cells[row].lower() not in optional:
            try:
                numbering.index_of_text(cells[row])
            except ValueError as error:
                raise table.refuse(int(row), place, error) from None
    return indices


def _states(table: Table, place: int, numbering: Numbering, to_states: Callable | None) -> np.ndarray:
    """The states in a column, [T]."""
    if to_states is None:
        return column_of_indices(table, place, numbering)
    values = to_states(parsed(table.column(place)))
    with errors_of(table.path):
        indices = numbering.indices("to_states: states", values)
        checks.require_shape("to_states: states", indices, f"({len(table.lines)},)", len(indices) == len(table.lines))
    return indices


def _actions(table: Table, place: int, numbering: Numbering) -> tuple[np.ndarray, np.ndarray]:
    """The actions in a column, [T], and where there is one, bool [T]."""
    indices = column_of_indices(table, place, numbering, NO_ACTION)
    return indices, indices >= 0


def _plain_columns(table: Table, places: Mapping[str, int]) -> tuple[dict[str, np.ndarray], Sequence[int | str]]:
    """The columns that hold neither states nor actions, episodes by number; and the names of these."""
    columns: dict[str, np.ndarray] = {}
    names: Sequence[Any] = ()
    if "episode" in places:
        cells = table.column(places["episode"])
        if "" in cells:
            raise table.refuse(cells.index(""), places["episode"], "is empty")
        (columns["episode"],), names = number_in_order([cells])
    if "step" in places:
        try:
            columns["step"] = column_of_indices(table, places["step"], Numbering("step", checks.LARGEST_INDEX))
        except FileError as error:
            raise FileError(f"{error}: the column numbers the steps of an episode; call it otherwise if not") from None
    for role in ("terminated", "truncated", "start"):
        if role in places:
            cells = [cell.lower() for cell in table.column(places[role])]
            flags = np.fromiter((_FLAGS.get(cell, -1) for cell in cells), np.int8, len(cells))
            if (flags < 0).any():
                row = int(flags.argmin())
                raise table.refuse(row, places[role], f"must be true or false, got {cells[row]!r}")
            columns[role] = flags == 1
    return columns, names
