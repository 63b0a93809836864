"""Demonstrations from the data of other libraries and from flat arrays of steps.

Recorded episodes hold one observation more than actions: the last is where the episode ended, and no action was taken
there. It becomes the episode's final state. Observations must be state indices, whole numbers from 0 on,
each alone or in an array of one ([H, 1]); for anything else (one-hot vectors, tuples, coordinates) `to_states` says
which state it is.

An episode that cannot be used is dropped and the report says why; if nothing is left, that is an error. None of the
libraries is imported: what counts is what the objects hold. CSV files are read by `csv_steps`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxhom import checks
from jaxhom.interop.import_reports import LARGEST_INDEX, ImportReport, with_report
from jaxhom.models.demonstrations import Demonstrations
from jaxhom.models.trajectories import require_no_steps

if TYPE_CHECKING:
    from jaxtyping import ArrayLike, Bool, Int, Shaped

_FIELDS = (("obs", "acts"), ("observations", "actions"))
# Under which names an end is recorded, and that it was a cut.
_TERMINATED = ("terminal", "terminated", "terminations", "terminals", "dones", "done")
_CUT = ("truncated", "truncations", "truncation", "timeouts", "timeout")
_NEXT = ("next_obs", "next_observations")
_FLAT = "{}: if these are flattened transitions of several episodes, demonstrations_from_transitions finds them again"


def demonstrations_from_episodes(
    episodes: Iterable[Any], *, to_states: Callable[[Any], Any] | None = None
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

    Outside jit, vmap and grad only: what is read is checked on the host.

    Example:
      >>> demonstrations, report = demonstrations_from_episodes([([0, 1, 2], [1, 1]), ([0], [])])
      >>> demonstrations.states.tolist(), demonstrations.final_states.tolist()
      ([[0, 1]], [2])
      >>> print(report)
      1 episodes, 2 steps; 1 final observations
      episode 1 dropped: it has no actions
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
    return with_report(kept, dropped, final, ended)


def demonstrations_from_steps(
    episode: Shaped[ArrayLike, "T"],
    observations: Shaped[ArrayLike, "T ..."],
    actions: Int[ArrayLike, "T *1"],
    *,
    to_states: Callable[[Any], Any] | None = None,
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

    Outside jit, vmap and grad only: what is read is checked on the host.

    Example:
      >>> demonstrations, report = demonstrations_from_steps(["a", "a", "b"], [0, 1, 0], [1, 1, 0])
      >>> demonstrations.num_trajectories, report.steps
      (2, 3)
    """
    names = checks.as_host_array("episode", episode)
    checks.require_shape("episode", names, "[T] with T >= 1", names.ndim == 1 and names.size > 0)
    if names.dtype.hasobject:
        raise ValueError(f"episode must hold numbers or texts, got dtype {names.dtype}")
    given = {"observations": observations, "actions": actions}
    arrays = {name: checks.as_host_array(name, array) for name, array in given.items()}
    for name, array in arrays.items():
        good = array.ndim >= 1 and len(array) == len(names)
        checks.require_shape(name, array, f"({len(names)}, ...) like episode", good)
    _, first, group = np.unique(names, return_index=True, return_inverse=True)
    group = np.argsort(np.argsort(first))[group]  # numbered in the order in which they begin
    order = np.argsort(group, kind="stable")
    cuts = np.flatnonzero(np.diff(group[order])) + 1
    pieces = (np.split(array[order], cuts) for array in arrays.values())
    return demonstrations_from_episodes(zip(*pieces, strict=True), to_states=to_states)


def demonstrations_from_transitions(
    observations: Shaped[ArrayLike, "T ..."],
    actions: Int[ArrayLike, "T *1"],
    next_observations: Shaped[ArrayLike, "T ..."],
    dones: Bool[ArrayLike, "T"],
    *,
    truncated: Bool[ArrayLike, "T"] | None = None,
    to_states: Callable[[Any], Any] | None = None,
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

    Outside jit, vmap and grad only: what is read is checked on the host.

    Example:
      >>> demonstrations, _ = demonstrations_from_transitions([0, 1, 0], [1, 1, 0], [1, 2, 0], [False, True, False])
      >>> demonstrations.num_trajectories, demonstrations.terminated.tolist()
      (2, [True, False])
    """
    given = {"observations": observations, "next_observations": next_observations, "actions": actions}
    arrays = {name: checks.as_host_array(name, array) for name, array in given.items()}
    length = len(np.atleast_1d(arrays["observations"]))
    for name, array in arrays.items():
        good = array.ndim >= 1 and len(array) == length > 0
        checks.require_shape(name, array, f"({length}, ...) like observations, T >= 1", good)
    before, after, taken = arrays.values()
    checks.require_shape("next_observations", after, f"{before.shape} like observations", after.shape == before.shape)
    was_cut = _flags("truncated", np.zeros(length, bool) if truncated is None else truncated, length)
    is_done = _flags("dones", dones, length)
    ends = np.flatnonzero(np.append((is_done | was_cut)[:-1] | ~_continues(before, after), True))
    starts = np.append(0, ends[:-1] + 1)
    episodes = [
        {
            "observations": np.concatenate([before[first : last + 1], after[last : last + 1]]),
            "actions": taken[first : last + 1],
            "terminated": bool(is_done[last] and not was_cut[last]),
        }
        for first, last in zip(starts, ends, strict=True)
    ]
    return demonstrations_from_episodes(episodes, to_states=to_states)


def _iterate(episodes) -> Iterable:
    iterate = getattr(episodes, "iterate_episodes", None)
    try:
        return iter(iterate() if callable(iterate) else episodes)
    except TypeError:
        raise ValueError(f"episodes must be a sequence of episodes, got {type(episodes).__name__}") from None


def _is_one(episodes) -> bool:
    """Whether something is one episode or set of transitions rather than a sequence of episodes."""
    return not callable(getattr(episodes, "iterate_episodes", None)) and all(
        _field(episodes, *names) is not None for names in zip(*_FIELDS, strict=True)
    )


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


def _field(episode, *names: str):
    """The first of the named fields that an episode has, else None."""
    for name in names:
        value = episode.get(name) if isinstance(episode, Mapping) else getattr(episode, name, None)
        if value is not None and not callable(value):
            return value
    return None


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


def _flags(name: str, values, length: int) -> np.ndarray:
    """bool [T], from booleans or zeros and ones."""
    flags = checks.as_host_array(name, values)
    checks.require_shape(name, flags, f"({length},) like observations", flags.shape == (length,))
    if flags.dtype.kind not in "biuf":
        raise ValueError(f"{name} must be bool, got dtype {flags.dtype}")
    checks.require_all(name, flags, (flags == 0) | (flags == 1), "must be True or False")
    return flags.astype(bool)


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
    states = checks.require_integers("observations", states, LARGEST_INDEX)
    return states, checks.require_integers("actions", actions, LARGEST_INDEX)


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
