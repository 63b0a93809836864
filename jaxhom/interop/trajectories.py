"""Demonstrations from the episodes of other libraries: `imitation`, Minari, data sets with a row per episode, pairs.

Recorded episodes hold one observation more than actions: the last is where the episode ended, and no action was taken
there. It becomes the episode's final state. Observations must be state indices, whole numbers from 0 on,
each alone or in an array of one ([H, 1]), or names that a model has for its states; for anything else (one-hot vectors,
coordinates) `to_states` says which state it is.

An episode that cannot be used is dropped and the report says why; if nothing is left, that is an error. None of the
libraries is imported: what counts is what the objects hold. Tables with a row per step are read by `flat_steps`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from jaxhom import checks
from jaxhom.interop.column_names import field, fields_by_role, names_by_role
from jaxhom.interop.import_reports import ImportReport, with_report
from jaxhom.interop.numbering import Numbering, numberings
from jaxhom.models.demonstrations import Demonstrations
from jaxhom.models.mdp import MDP
from jaxhom.models.trajectories import require_no_steps

_FLAT = "{}: if these are flattened transitions of several episodes, demonstrations_from_transitions finds them again"


def demonstrations_from_episodes(
    episodes: Iterable[Any], *, mdp: MDP | None = None, to_states: Callable[[Any], Any] | None = None
) -> tuple[Demonstrations, ImportReport]:
    """Reads episodes of `imitation`, of Minari, or as pairs of arrays.

    Args:
      episodes: M of them, or a data set with `iterate_episodes()` (Minari's). An episode is an object or a mapping with
        `obs` and `acts` (imitation's trajectories) or `observations` and `actions` (Minari's), or a pair
        (observations, actions). H actions go with H + 1 observations, or with H if the last is missing. One that has
        `terminal` or `terminations` says by it whether it terminated, unless `truncations`, `timeouts` or its `infos`
        say that it was cut off; others count as cut off.
      mdp: a model in which every state and action must exist; by its names for them, if it has some.
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
    if not callable(getattr(episodes, "iterate_episodes", None)) and {"state", "action"} <= set(
        fields_by_role(episodes)
    ):
        raise ValueError(
            "episodes has observations and actions itself: pass a list of episodes, or, if these are flattened "
            "transitions, use demonstrations_from_transitions"
        )
    return read_episodes(episodes, mdp=mdp, to_states=to_states)


def read_episodes(
    episodes: Iterable[Any],
    *,
    mdp: MDP | None,
    to_states: Callable[[Any], Any] | None,
    columns: Mapping[str, str] | None = None,
) -> tuple[Demonstrations, ImportReport]:
    """`demonstrations_from_episodes`, with names that fields have beside the usual ones, by their roles."""
    kept, ended, dropped, final, pairs = [], [], [], 0, []
    numbers = numberings(mdp)
    for position, episode in enumerate(_iterate(episodes)):
        fields = _fields(position, episode, columns)
        _require_no_jump(position, fields)
        pairs += [(position, episode)] if isinstance(episode, tuple | list) else []
        try:
            states, actions = _indices(fields["state"], fields["action"], to_states, *numbers)
        except ValueError as error:
            dropped.append((position, str(error)))
            continue
        final += len(states) - len(actions)
        kept.append((states, actions))
        ended.append(_has_terminated(episode, fields))
    require_no_steps(pairs, "episode")
    return with_report(kept, dropped, final, ended)


def _iterate(episodes) -> Iterable:
    iterate = getattr(episodes, "iterate_episodes", None)
    try:
        return iter(iterate() if callable(iterate) else episodes)
    except TypeError:
        raise ValueError(f"episodes must be a sequence of episodes, got {type(episodes).__name__}") from None


def _fields(position: int, episode, columns: Mapping[str, str] | None) -> dict[str, Any]:
    """What an episode holds, by role: states and actions at least. Ends are flags, none set before the last step."""
    if isinstance(episode, tuple | list) and len(episode) == 2 and not hasattr(episode, "_fields"):
        return dict(zip(("state", "action"), episode, strict=True))
    try:
        fields, names = fields_by_role(episode, columns), names_by_role(episode, columns)
    except ValueError as error:
        raise ValueError(f"episode {position}: {error}") from None
    if not {"state", "action"} <= set(fields):
        raise ValueError(
            f"episode {position} must have obs and acts, or observations and actions, or be a pair of them; "
            f"got {type(episode).__name__}"
        )
    for role in [role for role in ("terminated", "truncated") if role in fields]:
        name = f"episode {position}: {names[role]}"
        flags = np.ravel(checks.as_host_array(name, fields[role]))
        fields[role] = as_flags(name, flags, len(flags))
        if fields[role][:-1].any():
            raise ValueError(_FLAT.format(f"episode {position} ends before its last step ({names[role]})"))
    return fields


def _require_no_jump(position: int, fields: Mapping[str, Any]) -> None:
    """Raises if an episode has a step that does not begin where the former led to."""
    before, after = fields["state"], fields.get("next_state")
    if after is not None and np.shape(before) == np.shape(after) and not np.array_equal(before[1:], after[:-1]):
        raise ValueError(_FLAT.format(f"episode {position} jumps: a next observation is not that of the next step"))


def _has_terminated(episode, fields: Mapping[str, Any]) -> bool:
    """Whether an episode says that it ended in a terminal state, and nothing (imitation's `infos`) that it was cut."""
    ended, cut = (np.any(fields.get(role, False)) for role in ("terminated", "truncated"))
    return bool(ended and not cut and not _was_cut_by_time(episode))


def _was_cut_by_time(episode: Any) -> bool:
    """Whether imitation's `infos` say that a time limit ended an episode."""
    infos = None if isinstance(episode, tuple | list) else field(episode, "infos")
    return isinstance(infos, Sequence | np.ndarray) and np.size(infos) > 0 and is_time_limit(infos[-1])


def is_time_limit(info: Any) -> bool:
    """Whether an `info` of imitation's says that a time limit ended the episode: as a dictionary, or its text in JSON.

    `imitation` writes these texts by jsonpickle, of which nothing is unpickled.
    """
    if isinstance(info, str):
        if "TimeLimit" not in info:
            return False
        try:
            info = json.loads(info)
        except ValueError:
            return False
    return isinstance(info, Mapping) and info.get("TimeLimit.truncated") is True


def as_flags(name: str, values: Any, length: int) -> np.ndarray:
    """bool [T], from booleans or zeros and ones."""
    flags = checks.as_host_array(name, values)
    checks.require_shape(name, flags, f"({length},) like observations", flags.shape == (length,))
    if flags.dtype.kind not in "biuf":
        raise ValueError(f"{name} must be bool, got dtype {flags.dtype}")
    checks.require_all(name, flags, (flags == 0) | (flags == 1), "must be True or False")
    return flags.astype(bool)


def _indices(
    observations, actions, to_states: Callable | None, of_states: Numbering, of_actions: Numbering
) -> tuple[np.ndarray, np.ndarray]:
    """States [H] or [H + 1] and actions [H] of one episode, or a `ValueError` that says why it cannot be used."""
    taken = of_actions.indices("actions", actions)
    if not len(taken):
        raise ValueError("it has no actions")
    if to_states is not None:
        observations, of_states = to_states(observations), Numbering("state", of_states.limit)
    states = of_states.indices("observations", observations)
    if len(states) - len(taken) not in (0, 1):
        raise ValueError(f"{len(taken)} actions need as many observations or one more, got {len(states)}")
    return states, taken
