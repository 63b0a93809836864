"""Models in PRISM's explicit format, as `prism -exportmodel` writes it and Storm reads it: several files of one name.

    .tra            transitions: `states choices transitions` on the first line, then `state choice next probability`,
                    with the action's label behind it, or not; chains have no choices. Storm's files begin with `mdp`
                    or `dtmc` instead
    .sta            variables, and their values in every state: `0:(1,false)`
    .lab            labels of states, `init` among them
    .srew, .trew    rewards of states and of transitions

States have as many choices as they have. Labels name the actions if every choice has one and no state has the same
twice; otherwise actions are the numbers of the choices.
"""

from __future__ import annotations

import os
import re
from collections.abc import Hashable, Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from jaxhom import checks
from jaxhom.interop.archives import FileError, errors_of
from jaxhom.interop.imported_model import Entries, ImportedModel, model_of_entries
from jaxhom.interop.numbering import whole_of
from jaxhom.interop.text_files import open_text, without_gz
from jaxhom.interop.text_tables import TextTable, numbered

if TYPE_CHECKING:
    from jaxtyping import ArrayLike, Float

_STATE = re.compile(r"(\d+)\s*:\s*\((.*)\)")
_LABEL = re.compile(r'(\d+)\s*=\s*"([^"]*)"')
_UNKNOWN = checks.LARGEST_INDEX  # number of states, where it is not told
_WORDS = {"true": True, "false": False}


def from_prism(path: str | os.PathLike, *, discount: Float[ArrayLike, ""]) -> ImportedModel:
    """Reads a model in PRISM's explicit format (see the module's text).

    Args:
      path: the files' name without suffix, or the `.tra` file. Which of the others there are is found out; each may be
        compressed by gzip (`.tra.gz`).
      discount: scalar, strictly between 0 and 1; PRISM has none.

    Returns:
      The model, its states named by the values of the variables (tuples) where there is a `.sta` file; its reward,
      r(state) + r(transition), where there are reward files; the labels. Episodes start in the states labelled `init`
      alike, or in state 0. Deadlocks absorb.

    Raises:
      FileError: if there is no `.tra` file, naming the line of what is malformed in one of the files, or the first
        choice whose probabilities do not sum to 1. Rates of continuous time are refused.

    Outside jit, vmap and grad only: what is read is checked on the host.

    Example:
      >>> import pathlib, tempfile
      >>> path = pathlib.Path(tempfile.mkdtemp(), "coin")
      >>> lines = ["2 3 4", "0 0 0 0.5 toss", "0 0 1 0.5 toss", "0 1 1 1 give", "1 0 1 1 toss"]
      >>> _ = path.with_suffix(".tra").write_text("\\n".join(lines))
      >>> coin = from_prism(path, discount=0.9)
      >>> coin.action_names, coin.mdp.allowed.tolist()
      (('toss', 'give'), [[True, True], [True, False]])
    """
    base = re.sub(r"\.tra$", "", without_gz(path))
    tra = _part(base, ".tra")
    if tra is None:
        raise FileError(f"{base}.tra: no such file")
    table, is_chain, num_states = _transitions(tra)
    state = table.whole_numbers(0, "state", num_states)
    choice = np.zeros(len(state), int) if is_chain else table.whole_numbers(1, "choice")
    next_state = table.whole_numbers(2 - is_chain, "next state", num_states)
    probability = table.numbers(3 - is_chain, "probability")
    count = int(max(state.max(initial=0), next_state.max(initial=0))) + 1 if num_states == _UNKNOWN else num_states
    remarks: list[str] = []
    names, labels = _state_names(base, count, remarks), _labels(base, count)
    reward = _reward(base, Entries(state, choice, next_state, probability), count, is_chain, remarks)
    action, action_names = (choice, None) if is_chain else _actions(table, state, choice, remarks)
    starts = labels.get("init", np.zeros(count, bool))
    if not starts.any():
        remarks.append("no state is labelled init: episodes start in state 0")
        starts[0] = True
    with errors_of(tra):
        return model_of_entries(
            Entries(state, action, next_state, probability, reward),
            num_states=count,
            num_actions=int(action.max(initial=0)) + 1 if action_names is None else len(action_names),
            discount=discount,
            initial=starts / starts.sum(),
            state_names=names,
            action_names=action_names,
            labels=labels,
            remarks=remarks,
        )


def _part(base: str, suffix: str) -> str | None:
    """The file of one name and a suffix, compressed or not; None if there is none."""
    return next((path for path in (base + suffix, f"{base}{suffix}.gz") if os.path.exists(path)), None)


def _transitions(path: str) -> tuple[TextTable, bool, int]:
    """The rows behind the header, whether they have no choices, and the number of states where it is told."""
    table = TextTable.of_words(path)
    if not len(table):
        raise FileError(f"{path}: it is empty")
    header, rows = table.row(0), table.after(1)
    kind = header[0].lower()
    if kind in ("ctmc", "ctmdp", "ma", "smg", "pomdp"):
        raise table.error(0, f"models of the kind {header[0]!r} are not read, only mdp and dtmc")
    if kind in ("mdp", "dtmc"):
        is_chain, num_states, num_rows = kind == "dtmc", _UNKNOWN, None
    else:
        if len(header) not in (2, 3) or not all(word.isdecimal() for word in header):
            told = "`states choices transitions`, `states transitions`, `mdp` or `dtmc`"
            raise table.error(0, f"expected {told}, got {' '.join(header)!r}")
        is_chain, num_states, num_rows = len(header) == 2, int(header[0]), int(header[-1])
        if not 0 < num_states < _UNKNOWN:
            raise table.error(0, f"there must be one state at least, got {num_states}")
    expected = "`state next probability`" if is_chain else "`state choice next probability`"
    rows.require_width(4 - is_chain, 5 - is_chain, expected)
    if num_rows is not None and len(rows) != num_rows:
        raise FileError(f"{path}: {len(rows)} transitions, but its first line says {num_rows}")
    if not len(rows) and num_states == _UNKNOWN:
        raise FileError(f"{path}: it has no transitions, and does not say how many states there are")
    return rows, is_chain, num_states


def _actions(
    table: TextTable, state: np.ndarray, choice: np.ndarray, remarks: list[str]
) -> tuple[np.ndarray, list[str] | None]:
    """int [N] actions, and their names where labels can be these."""
    if not (table.widths == 5).any():
        return choice, None
    names, action = numbered(table.columns[4])
    by_choice = {*zip(state.tolist(), choice.tolist(), action.tolist(), strict=True)}
    choices = {*zip(state.tolist(), choice.tolist(), strict=True)}
    by_label = {*zip(state.tolist(), action.tolist(), strict=True)}
    if "" in names or not len(by_choice) == len(choices) == len(by_label):
        remarks.append("choices are numbered: their labels are not one for each choice of a state")
        return choice, None
    return action, names


def _state_names(base: str, num_states: int, remarks: list[str]) -> list[Hashable] | None:
    """Tuples of the variables' values, None without the file."""
    path = _part(base, ".sta")
    if path is None:
        return None
    with open_text(path) as file:
        lines = [(number, line.strip()) for number, line in enumerate(file, start=1) if line.strip()]
    names: dict[int, Hashable] = {}
    for number, line in lines[1:]:
        match = _STATE.fullmatch(line)
        if match is None or int(match[1]) != len(names):
            raise FileError(f"{path} line {number}: expected `{len(names)}:(values)`, got {line!r}")
        names[len(names)] = tuple(map(_value, match[2].split(",")))
    if len(names) != num_states:
        raise FileError(f"{path}: {len(names)} states, but the model has {num_states}")
    remarks.append(f"names of states are the values of {lines[0][1]}")
    return [*names.values()]


def _value(text: str) -> Hashable:
    text = text.strip()
    try:
        return _WORDS[text] if text in _WORDS else whole_of(text)
    except ValueError:
        return text


def _labels(base: str, num_states: int) -> dict[str, np.ndarray]:
    """bool [S] by name: of lines `state: labels` behind `0="init" 1="deadlock"`, or of Storm's own form."""
    path = _part(base, ".lab")
    if path is None:
        return {}
    with open_text(path) as file:
        lines = [(number, line.split()) for number, line in enumerate(file, start=1) if line.strip()]
    if lines and lines[0][1][0] == "#DECLARATION":
        ends = [place for place, (_, words) in enumerate(lines) if words == ["#END"]]
        if not ends:
            raise FileError(f"{path}: no #END of its #DECLARATION")
        names = {name: name for _, words in lines[1 : ends[0]] for name in words}
        lines = lines[ends[0] + 1 :]
    else:
        names = dict(_LABEL.findall(" ".join(lines[0][1]))) if lines else {}
        lines = lines[1:]
    labels = {name: np.zeros(num_states, bool) for name in names.values()}
    for number, (first, *rest) in lines:
        state = first.removesuffix(":")
        if not state.isdecimal() or int(state) >= num_states:
            raise FileError(f"{path} line {number}: must begin with a state below {num_states}, got {first!r}")
        for word in rest:
            if word not in names:
                raise FileError(f"{path} line {number}: no label {word!r} among {', '.join(names)}")
            labels[names[word]][int(state)] = True
    return labels


def _reward(base: str, entries: Entries, num_states: int, is_chain: bool, remarks: list[str]) -> np.ndarray | None:
    """float [N], one per transition; of the first structure where there are several. None without files.

    Lines about the same state or transition add up.
    """
    name = next((n for n in (base, f"{base}1") if _part(n, ".srew") or _part(n, ".trew")), None)
    if name is None:
        return None
    if name != base and (_part(f"{base}2", ".srew") or _part(f"{base}2", ".trew")):
        remarks.append("the first of several reward structures is used")
    reward = np.zeros(len(entries.state))
    if (path := _part(name, ".srew")) is not None:
        table = _rewards(path, 2, num_states, "`state reward`")
        by_state = np.zeros(num_states)
        np.add.at(by_state, table.whole_numbers(0, "state", num_states), table.numbers(1, "reward"))
        reward += by_state[entries.state]
    if (path := _part(name, ".trew")) is not None:
        width = 4 - is_chain
        table = _rewards(path, width, num_states, "`state next reward`" if is_chain else "`state choice next reward`")
        rewarded = [table.whole_numbers(place, "number") for place in range(width - 1)]
        there = (entries.state, entries.next_state) if is_chain else (entries.state, entries.action, entries.next_state)
        place_of = {transition: n for n, transition in enumerate(_rows(there))}
        values = table.numbers(width - 1, "reward")
        for row, transition in enumerate(_rows(rewarded)):
            if transition not in place_of:
                raise table.error(row, f"there is no transition {' '.join(map(str, transition))}")
            reward[place_of[transition]] += values[row]
    return reward


def _rows(columns: Sequence[np.ndarray]) -> Iterator[tuple[int, ...]]:
    return zip(*(column.tolist() for column in columns), strict=True)


def _rewards(path: str, width: int, num_states: int, expected: str) -> TextTable:
    """The rows of a file of rewards behind its header: the number of states, and perhaps, last, that of the rows."""
    table = TextTable.of_words(path)
    if not len(table) or table.row(0)[0] != str(num_states):
        raise FileError(f"{path}: the first line must begin with the number of states, {num_states}")
    header, rows = table.row(0), table.after(1)
    if len(header) > 1 and header[-1] != str(len(rows)):
        raise FileError(f"{path}: {len(rows)} rewards, but its first line says {header[-1]}")
    rows.require_width(width, width, expected)
    return rows
