"""Models from tables with one transition a row, and from tables [S, A] of next states.

    state, action, next_state (or next), probability, reward          in any order, other columns are ignored
    idstatefrom, idaction, idstateto, probability, reward             as the robust-MDP collections have it

States and actions are numbers or texts. Those that are not numbered 0, 1, 2, ... without a gap get their values as
names; both are in ascending order, whatever that of the rows. Rows of one transition add up; without probabilities each
is certain. Pairs without rows are no actions, and states without any absorb.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Hashable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxhom import checks
from jaxhom.interop.archives import FileError, errors_of
from jaxhom.interop.imported_model import Entries, ImportedModel, model_of_entries
from jaxhom.interop.numbering import whole_number, whole_of
from jaxhom.interop.text_tables import TextTable

if TYPE_CHECKING:
    from jaxtyping import ArrayLike, Float

COLUMNS = {
    "state": ("state", "idstatefrom"),
    "action": ("action", "idaction"),
    "next_state": ("next_state", "next", "idstateto"),
    "probability": ("probability",),
    "reward": ("reward",),
}
_OPTIONAL = ("probability", "reward")
_TOO_LARGE = 2.0**53  # for whole numbers among floats


def from_table(
    table: Any, *, discount: Float[ArrayLike, ""], columns: Mapping[str, Hashable] | None = None
) -> ImportedModel:
    """Builds a model from a table (see the module's text).

    Args:
      table: the path of a file with a line of names and one transition a line, its fields separated by commas,
        semicolons or tabs, plain or compressed by gzip; or a data frame, or a mapping from names to columns; or
        integers [S, A], the next state of each pair, -1 where there is no action, as an array or a file without names.
      discount: scalar, strictly between 0 and 1.
      columns: what the table calls `state`, `action`, `next_state`, `probability` and `reward`, where it is neither
        this nor one of the names above.

    Returns:
      The model, its reward, None if the table has none, and the states without actions as `terminal`.

    Raises:
      FileError: naming the file, and the line and column of what is malformed; if a column is missing or named twice,
        or the probabilities of a pair do not sum to 1.
      ValueError: for the same, with the row, if the table is no file.

    Outside jit, vmap and grad only: what is read is checked on the host.

    Example:
      >>> rows = {"next": ["hall", "room", "hall"], "state": ["hall", "hall", "room"], "action": [0, 1, 0]}
      >>> flat = from_table(rows, discount=0.9)
      >>> flat.state_names, flat.mdp.allowed.tolist()
      (('hall', 'room'), [[True, True], [True, False]])
      >>> from_table([[1, -1], [0, 1]], discount=0.9).mdp.transition[1].tolist()
      [[1.0, 0.0], [0.0, 1.0]]
    """
    if columns is not None and not isinstance(columns, Mapping):
        raise ValueError(f"columns must be a mapping, got {checks.in_one_line(columns)}")
    if isinstance(table, str | os.PathLike):
        with errors_of(table):
            return _of_file(table, discount, dict(columns or {}))
    if isinstance(table, Mapping) or hasattr(table, "columns"):
        return _of_frame(table, discount, dict(columns or {}))
    return _of_next_states(checks.as_host_array("table", table), discount)


def _of_file(path: str | os.PathLike, discount, columns: dict[str, Hashable]) -> ImportedModel:
    table = TextTable.of_separated(path)
    if not len(table):
        raise FileError(f"{path} line 1: expected the names of the columns")
    header = [*map(str.strip, table.row(0))]
    table.require_width(len(header), len(header), f"{len(header)} fields, as many as the first line has")
    if all(map(_is_whole, header)):
        count = len(table)
        cells = [table.whole_numbers(n, f"column {n + 1}", upper=count, lower=-1) for n in range(len(header))]
        return _of_next_states(np.stack(cells, axis=1), discount)
    places, rows = _places(header, columns), table.after(1)

    def values(name: str) -> np.ndarray | list[Hashable]:
        texts = rows.columns[places[name]]
        try:
            return np.array([*map(_whole, texts)], np.int64)
        except (ValueError, OverflowError):
            stripped = [*map(str.strip, texts)]
        if "" in stripped:
            raise rows.error(stripped.index(""), f"column {name!r} is empty")
        return list(stripped)

    def numbers(name: str) -> np.ndarray:
        return rows.numbers(places[name], f"column {name!r}")

    return _of_columns(places, values, numbers, _ignored(header, places), discount)


def _whole(text: str) -> int:
    """3, and 3.0 as programs write columns of integers that are floats to them."""
    try:
        return whole_of(text)
    except ValueError:
        number = whole_number(text)
        if number is None or abs(number) >= _TOO_LARGE:
            raise
        return number


def _text_of_number(value: Hashable) -> str:
    """What a value is called beside whole numbers."""
    try:
        return str(_whole(str(value)))
    except (ValueError, OverflowError):
        return str(value)


def _is_whole(text: str) -> bool:
    return text.strip().removeprefix("-").isdecimal()


def _of_frame(frame: Any, discount, columns: dict[str, Hashable]) -> ImportedModel:
    header = [*(frame.keys() if isinstance(frame, Mapping) else frame.columns)]
    places = _places(header, columns)
    arrays = {name: checks.as_host_array(f"column {name!r}", frame[header[place]]) for name, place in places.items()}
    shape = arrays["state"].shape
    for name, array in arrays.items():
        expected = f"({shape[0]},)" if shape else "[N]"
        checks.require_shape(f"column {name!r}", array, expected, array.ndim == 1 and array.shape == shape[:1])

    def values(name: str) -> np.ndarray | list[Hashable]:
        array = arrays[name]
        if array.dtype.kind in "iuf":
            is_whole = np.isfinite(array) & (array == np.floor(array)) & (np.abs(array) < _TOO_LARGE)
            checks.require_all(f"column {name!r}", array, is_whole, "must be a whole number")
            return array.astype(np.int64)
        is_there = np.array([not _is_missing(value) for value in array.tolist()], bool)
        checks.require_all(f"column {name!r}", array, is_there, "is missing")
        return array.tolist()

    def numbers(name: str) -> np.ndarray:
        return checks.require_floats(f"column {name!r}", arrays[name]).astype(np.float64)

    return _of_columns(places, values, numbers, _ignored(header, places), discount)


def _is_missing(value: Any) -> bool:
    """Whether a cell is empty: None, NaN, or what pandas has for it."""
    is_nan = isinstance(value, float) and value != value
    return value is None or is_nan or type(value).__name__ in ("NAType", "NaTType")


def _places(header: list, columns: dict[str, Hashable]) -> dict[str, int]:
    """Where the columns stand that are there."""
    for name in columns:
        if name not in COLUMNS:
            raise ValueError(f"columns: no {name!r} among {', '.join(COLUMNS)}")
    places = {}
    lower = [name.lower() if isinstance(name, str) else name for name in header]
    for name, known in COLUMNS.items():
        found = [n for n, title in enumerate(lower) if title in known]
        if name in columns:
            found = [n for n, title in enumerate(header) if title == columns[name]]
        if len(found) > 1:
            raise ValueError(f"columns {' and '.join(repr(header[n]) for n in found)} could both be the {name}")
        if found:
            places[name] = found[0]
        elif name in columns or name not in _OPTIONAL:
            wanted = repr(columns[name]) if name in columns else " or ".join(map(repr, known))
            raise ValueError(f"column {wanted} is missing; it has {', '.join(map(repr, header)) or 'nothing'}")
    return places


def _ignored(header: list, places: dict[str, int]) -> list[str]:
    others = [str(name) for place, name in enumerate(header) if place not in places.values()]
    return [f"ignored: {', '.join(map(repr, others))}"] if others else []


def _of_columns(
    places: dict[str, int],
    values: Callable[[str], Any],
    numbers: Callable[[str], np.ndarray],
    remarks: list[str],
    discount,
) -> ImportedModel:
    """The model of columns that are given by name, as values or as numbers."""
    states, (state, next_state) = _codes(values("state"), values("next_state"))
    actions, (action,) = _codes(values("action"))
    if not len(state):
        raise ValueError("it has no rows")
    probability = numbers("probability") if "probability" in places else np.ones(len(state))
    reward = numbers("reward") if "reward" in places else None
    return model_of_entries(
        Entries(state, action, next_state, probability, reward),
        num_states=len(states),
        num_actions=len(actions),
        discount=discount,
        state_names=None if states == [*range(len(states))] else states,
        action_names=None if actions == [*range(len(actions))] else actions,
        remarks=remarks,
    )


def _codes(*columns: np.ndarray | list[Hashable]) -> tuple[list, list[np.ndarray]]:
    """The different values of columns, ascending, and each column by their numbers.

    Where one column is of whole numbers and another is not, 02 and 2.0 there are the number 2 of the first.
    """
    whole = [column for column in columns if isinstance(column, np.ndarray)]
    if len(whole) == len(columns):
        different, code = np.unique(np.concatenate(whole), return_inverse=True)
        return different.tolist(), np.split(code, np.cumsum([len(column) for column in whole])[:-1])
    text_of = _text_of_number if whole else str
    texts = [[text_of(value) for value in column] for column in columns]
    names = sorted({text for column in texts for text in column})
    number = {name: n for n, name in enumerate(names)}
    return names, [np.array([*map(number.__getitem__, column)], int) for column in texts]


def _of_next_states(table: np.ndarray, discount) -> ImportedModel:
    """The model of next states [S, A], -1 where there is no action."""
    good = table.ndim == 2 and table.size > 0
    checks.require_shape("table", table, "[S, A] (or it must have columns by name)", good)
    exists = checks.require_floats("table", table) != -1
    next_state = checks.require_integers("table", np.where(exists, table, 0), upper=len(table))
    state, action = np.nonzero(exists)
    entries = Entries(state, action, next_state[state, action], np.ones(len(state)))
    return model_of_entries(entries, num_states=len(table), num_actions=table.shape[1], discount=discount)
