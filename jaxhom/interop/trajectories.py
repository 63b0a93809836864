"""Demonstrations from the data of other libraries, from flat arrays of steps and from CSV files.

Recorded episodes hold one observation more than actions: the last is where the episode ended, and no action was taken
there. It becomes the episode's final state. Observations must be state indices, whole numbers from 0 on,
each alone or in an array of one ([H, 1]); for anything else (one-hot vectors, tuples, coordinates) `to_states` says
which state it is.

An episode that cannot be used is dropped and the report says why; if nothing is left, that is an error. None of the
libraries is imported: what counts is what the objects hold.
"""

import csv
import dataclasses
import itertools
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from jaxhom import checks
from jaxhom.interop.files import FileError
from jaxhom.models.demonstrations import Demonstrations
from jaxhom.models.mdp import MDP
from jaxhom.models.trajectories import require_no_steps

COLUMNS = ("episode", "state", "action")
STEP_COLUMNS = ("step", "t", "time", "timestep")
_FIELDS = (("obs", "acts"), ("observations", "actions"))
# Under which names an end is recorded, and that it was a cut.
_TERMINATED = ("terminal", "terminated", "terminations", "terminals", "dones", "done")
_CUT = ("truncated", "truncations", "truncation", "timeouts", "timeout")
_NEXT = ("next_obs", "next_observations")
_LARGEST_INDEX = 2**31 - 1


@dataclasses.dataclass(frozen=True)
class ImportReport:
    """What was read and what was dropped; `str` gives it in words.

    Attributes:
      episodes: episodes that were kept, M.
      steps: steps in them.
      final_observations: how many of them end with an observation after the last action, their final state.
      dropped: pairs (episode, reason): the position, counted from 0, or the CSV file's name of an episode that was
        dropped altogether.
    """

    episodes: int
    steps: int
    final_observations: int
    dropped: tuple[tuple[int | str, str], ...]

    def __str__(self) -> str:
        lines = [f"{self.episodes} episodes, {self.steps} steps; {self.final_observations} final observations"]
        lines += [f"episode {episode} dropped: {reason}" for episode, reason in self.dropped]
        return "\n".join(lines)


def demonstrations_from_episodes(
    episodes: Iterable, *, to_states: Callable | None = None
) -> tuple[Demonstrations, ImportReport]:
    """Reads episodes of `imitation`, of Minari, or as pairs of arrays.

    Args:
      episodes: M of them, or a data set with `iterate_episodes()` (Minari's). An episode is an object or a mapping with
        `obs` and `acts` (imitation's trajectories) or `observations` and `actions` (Minari's), or a pair
        (observations, actions). H actions go with H + 1 observations, or with H if the last is missing. One that has
        `terminal` or `terminations` says by it whether it terminated, unless `truncations`, `timeouts` or its `infos`
        say that it was cut off; others count as cut off.
      to_states: takes the observations of one episode as they are stored and returns as many state indices; for
        one-hot vectors `lambda observations: observations.argmax(axis=-1)`.

    Returns:
      The demonstrations, and what was dropped: episodes that are empty, have another number of observations, or hold
      observations or actions that are no indices.

    Raises:
      ValueError: if there is no episode; something is not an episode, or several episodes in a row (transitions, with
        an end in between); nothing tells (states, actions) from two steps (state, action); or none can be used (with
        the first reason).
    """
    if _is_one(episodes):
        raise ValueError(
            "episodes has observations and actions itself: pass a list of episodes, or, if these are flattened "
            "transitions, use demonstrations_from_transitions"
        )
    kept, ended, dropped, final, pairs = [], [], [], 0, []
    for position, episode in enumerate(_iterate(episodes)):
        observations, actions = _fields(position, episode)
        _require_one_episode(position, episode)
        pairs += [(position, episode)] if isinstance(episode, tuple | list) else []
        try:
            states, actions = _indices(observations, actions, to_states)
        except ValueError as error:
            dropped.append((position, str(error)))
            continue
        final += len(states) - len(actions)
        kept.append((states, actions))
        ended.append(_has_terminated(position, episode))
    require_no_steps(pairs, "episode")
    return _finish(kept, dropped, final, ended)


_FLAT = "{}: if these are flattened transitions of several episodes, demonstrations_from_transitions finds them again"


def _field(episode, *names: str):
    """The first of the named fields that an episode has, else None."""
    for name in names:
        value = episode.get(name) if isinstance(episode, Mapping) else getattr(episode, name, None)
        if value is not None and not callable(value):
            return value
    return None


def _is_one(episodes) -> bool:
    """Whether something is one episode or set of transitions rather than a sequence of episodes."""
    return not callable(getattr(episodes, "iterate_episodes", None)) and all(
        _field(episodes, *names) is not None for names in zip(*_FIELDS, strict=True)
    )


def _require_one_episode(position: int, episode) -> None:
    """Raises if an episode has an end before its last step, or a step that does not begin where the former led to."""
    for name in (*_TERMINATED, *_CUT):
        if _flags_of(position, episode, name)[:-1].any():
            raise ValueError(_FLAT.format(f"episode {position} ends before its last step ({name})"))
    before, after = _field(episode, "obs", "observations"), _field(episode, *_NEXT)
    if after is not None and np.shape(before) == np.shape(after) and not np.all(_continues(before, after)):
        raise ValueError(_FLAT.format(f"episode {position} jumps: a next observation is not that of the next step"))


def _continues(before, after) -> np.ndarray:
    """bool [T - 1], whether each step's next observation is that of the following step."""
    same = np.asarray(after)[:-1] == np.asarray(before)[1:]
    return same.reshape(len(same), -1).all(axis=1)


def _has_terminated(position: int, episode) -> bool:
    """Whether an episode says that it ended in a terminal state, and nothing (imitation's `infos`) that it was cut."""
    infos = _field(episode, "infos")
    last = infos[-1] if isinstance(infos, Sequence | np.ndarray) and np.size(infos) else None
    was_cut = isinstance(last, Mapping) and last.get("TimeLimit.truncated", False)
    ended, cut = (
        next((flags[-1] for name in names if (flags := _flags_of(position, episode, name)).size), False)
        for names in (_TERMINATED, _CUT)
    )
    return bool(ended and not cut and not was_cut)


def _flags_of(position: int, episode, name: str) -> np.ndarray:
    """The flags of an episode under one name, bool [any number]; empty where it has none."""
    found = _field(episode, name)
    if found is None:
        return np.zeros(0, bool)
    name = f"episode {position}: {name}"
    flags = np.ravel(checks.as_host_array(name, found))
    return _flags(name, flags, len(flags))


def demonstrations_from_steps(
    episode, observations, actions, *, to_states: Callable | None = None
) -> tuple[Demonstrations, ImportReport]:
    """Reads flat arrays with one step an entry, as offline data sets hold them.

    Args:
      episode: [T], which episode each step belongs to: any numbers or texts. Steps of one episode are in their order;
        episodes may be interleaved. From flags that mark last steps: `numpy.cumsum(done) - done`.
      observations: [T, ...], one observation per step.
      actions: [T] or [T, 1].
      to_states: as in `demonstrations_from_episodes`.

    Returns:
      The demonstrations, episodes in the order in which they begin (as the report counts them), and the report.

    Raises:
      ValueError: if the arrays differ in length, there is no step, or no episode can be used.
    """
    episode = checks.as_host_array("episode", episode)
    checks.require_shape("episode", episode, "[T] with T >= 1", episode.ndim == 1 and episode.size > 0)
    if episode.dtype.hasobject:
        raise ValueError(f"episode must hold numbers or texts, got dtype {episode.dtype}")
    arrays = {"observations": observations, "actions": actions}
    arrays = {name: checks.as_host_array(name, array) for name, array in arrays.items()}
    for name, array in arrays.items():
        good = array.ndim >= 1 and len(array) == len(episode)
        checks.require_shape(name, array, f"({len(episode)}, ...) like episode", good)
    _, first, group = np.unique(episode, return_index=True, return_inverse=True)
    group = np.argsort(np.argsort(first))[group]  # numbered in the order in which they begin
    order = np.argsort(group, kind="stable")
    cuts = np.flatnonzero(np.diff(group[order])) + 1
    pieces = (np.split(array[order], cuts) for array in arrays.values())
    return demonstrations_from_episodes(zip(*pieces, strict=True), to_states=to_states)


def demonstrations_from_transitions(
    observations, actions, next_observations, dones, *, truncated=None, to_states: Callable | None = None
) -> tuple[Demonstrations, ImportReport]:
    """Reads flattened transitions, as `imitation` and offline data sets hold them, and finds the episodes again.

    An episode ends after a step with `done`, where it terminated, and wherever the next observation is not the one of
    the following step: truncated episodes carry no `done`, and would be joined with what comes after them. What cannot
    be seen is an episode that was cut off in the very state in which the next begins; `truncated` tells.

    Args:
      observations: [T, ...], one per step, in order.
      actions: [T] or [T, 1].
      next_observations: [T, ...], what followed each step.
      dones: bool [T], whether the step ended its episode in a terminal state.
      truncated: bool [T], whether the episode was cut off after the step, where that was recorded (`timeouts`). A step
        with both flags was cut off.
      to_states: as in `demonstrations_from_episodes`.

    Returns:
      The demonstrations, with `final_states` and `terminated`, and the report.

    Raises:
      ValueError: if the arrays differ in length, there is no step, flags are none, or no episode can be used.
    """
    arrays = {"observations": observations, "next_observations": next_observations, "actions": actions}
    arrays = {name: checks.as_host_array(name, array) for name, array in arrays.items()}
    length = len(np.atleast_1d(arrays["observations"]))
    for name, array in arrays.items():
        good = array.ndim >= 1 and len(array) == length > 0
        checks.require_shape(name, array, f"({length}, ...) like observations, T >= 1", good)
    before, after, actions = arrays.values()
    checks.require_shape("next_observations", after, f"{before.shape} like observations", after.shape == before.shape)
    truncated = _flags("truncated", np.zeros(length, bool) if truncated is None else truncated, length)
    dones = _flags("dones", dones, length)
    ends = np.flatnonzero(np.append((dones | truncated)[:-1] | ~_continues(before, after), True))
    starts = np.append(0, ends[:-1] + 1)
    episodes = [
        {
            "observations": np.concatenate([before[first : last + 1], after[last : last + 1]]),
            "actions": actions[first : last + 1],
            "terminated": bool(dones[last] and not truncated[last]),
        }
        for first, last in zip(starts, ends, strict=True)
    ]
    return demonstrations_from_episodes(episodes, to_states=to_states)


def _flags(name: str, values, length: int) -> np.ndarray:
    """bool [T], from booleans or zeros and ones."""
    flags = checks.as_host_array(name, values)
    checks.require_shape(name, flags, f"({length},) like observations", flags.shape == (length,))
    if flags.dtype.kind not in "biuf":
        raise ValueError(f"{name} must be bool, got dtype {flags.dtype}")
    checks.require_all(name, flags, (flags == 0) | (flags == 1), "must be True or False")
    return flags.astype(bool)


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
    """
    limits = (_LARGEST_INDEX,) * 2 if mdp is None else (mdp.num_states, mdp.num_actions)
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
        return _finish(kept, dropped, final)
    except ValueError as error:
        raise FileError(f"{path}: {error}") from None


def _iterate(episodes) -> Iterable:
    iterate = getattr(episodes, "iterate_episodes", None)
    try:
        return iter(iterate() if callable(iterate) else episodes)
    except TypeError:
        raise ValueError(f"episodes must be a sequence of episodes, got {type(episodes).__name__}") from None


def _fields(position: int, episode) -> tuple:
    """Observations and actions of an episode, whatever it is kept in."""
    for names in _FIELDS:
        if isinstance(episode, Mapping) and all(name in episode for name in names):
            return tuple(episode[name] for name in names)
        if all(hasattr(episode, name) for name in names):
            return tuple(getattr(episode, name) for name in names)
    if isinstance(episode, tuple | list) and len(episode) == 2:
        return tuple(episode)
    raise ValueError(
        f"episode {position} must have obs and acts, or observations and actions, or be a pair of them; "
        f"got {type(episode).__name__}"
    )


def _indices(observations, actions, to_states: Callable | None) -> tuple[np.ndarray, np.ndarray]:
    """States [H] or [H + 1] and actions [H] of one episode, or a `ValueError` that says why it cannot be used."""
    actions = _column("actions", actions)
    if to_states is not None:
        observations = to_states(observations)
    states = _column("observations", observations)
    if not len(actions):
        raise ValueError("it has no actions")
    if len(states) - len(actions) not in (0, 1):
        raise ValueError(f"{len(actions)} actions need as many observations or one more, got {len(states)}")
    states = checks.require_integers("observations", states, _LARGEST_INDEX)
    return states, checks.require_integers("actions", actions, _LARGEST_INDEX)


def _column(name: str, values) -> np.ndarray:
    """[H] or [H, 1] as [H]."""
    array = checks.as_host_array(name, values)
    if array.ndim == 2 and array.shape[1] == 1:
        array = array[:, 0]
    remedy = "; to_states turns other observations into state indices" if name == "observations" else ""
    if array.ndim != 1:
        raise ValueError(f"{name} must have shape [H] or [H, 1], got {array.shape}{remedy}")
    if not array.size:  # an empty list has no type of its own
        return np.zeros(0, np.int64)
    if array.dtype.kind not in "iuf":
        raise ValueError(f"{name} must be whole numbers, got dtype {array.dtype}{remedy}")
    return array


def _finish(kept, dropped, final_observations: int, terminated=None) -> tuple[Demonstrations, ImportReport]:
    if not kept:
        if not dropped:
            raise ValueError("there are no episodes")
        raise ValueError(f"none of {len(dropped)} episodes can be used; episode {dropped[0][0]}: {dropped[0][1]}")
    demonstrations = Demonstrations.from_trajectories(kept, terminated=terminated)
    steps = sum(len(actions) for _, actions in kept)
    report = ImportReport(
        episodes=len(kept), steps=steps, final_observations=final_observations, dropped=tuple(dropped)
    )
    return demonstrations, report


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


def _step(path, line: int, row: list[str], places: list[int], limits: tuple[int, int]) -> tuple[str, int, int | None]:
    """Episode, state and action of one line; None for an empty action."""
    if len(row) <= max(places):
        raise FileError(f"{path} line {line}: {len(row)} fields, but the first line names more columns")
    episode, state, action = (row[place].strip() for place in places)
    if not episode:
        raise FileError(f"{path} line {line}, column 'episode': is empty")
    state = _whole_number(path, line, "state", state, limits[0])
    return episode, state, _whole_number(path, line, "action", action, limits[1]) if action else None


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


class _Line(NamedTuple):
    """One step of a file."""

    line: int
    number: int | None
    state: int
    action: int | None


def _in_order(path, lines: list[_Line]) -> list[_Line]:
    """The lines of one episode by their step numbers, if they have some."""
    if lines[0].number is not None:
        lines = sorted(lines, key=lambda line: line.number)
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


def _place_of_step(path, header: list[str]) -> int | None:
    """Where the steps' numbers stand, if there are any."""
    places = [place for place, name in enumerate(header) if name.strip().lower() in STEP_COLUMNS]
    if len(places) > 1:
        names = " and ".join(repr(header[place].strip()) for place in places)
        raise FileError(f"{path} line 1: columns {names} could both number the steps: keep one")
    return places[0] if places else None


def _step_number(path, line: int, header: list[str], row: list[str], place: int) -> int:
    """The number of one line's step."""
    column, text = header[place].strip(), row[place].strip() if place < len(row) else ""
    try:
        return _whole_number(path, line, column, text, _LARGEST_INDEX)
    except FileError as error:
        raise FileError(f"{error}: the column numbers the steps of an episode; call it otherwise if not") from None


def _require_fields(path, line: int, row: list[str], header: list[str]) -> None:
    if any(field.strip() for field in row[len(header) :]):
        raise FileError(f"{path} line {line}: {len(row)} fields, but the first line names {len(header)} columns")
