"""Recorded transitions as numbers: what the states and actions of an environment without a table are called and where
its episodes end.
"""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any, NamedTuple

import numpy as np

from jaxhom import checks
from jaxhom.interop.numbering import keys_of, number_in_order
from jaxhom.interop.trajectories import as_flags
from jaxhom.models.names import described

END = "end"  # the name of the state that is added where episodes end


class RecordedSteps(NamedTuple):
    """T transitions between S states by A actions, and what these are called.

    Attributes:
      states: int [T].
      actions: int [T].
      next_states: int [T].
      num_states: S.
      num_actions: A.
      state_names: S of them, or None where states were given by number.
      action_names: A of them, or None where actions were given by number.
      terminal: bool [S], the states in which episodes ended; None if nothing was recorded of that.
    """

    states: np.ndarray
    actions: np.ndarray
    next_states: np.ndarray
    num_states: int
    num_actions: int
    state_names: tuple[Hashable, ...] | None = None
    action_names: tuple[Hashable, ...] | None = None
    terminal: np.ndarray | None = None


def recorded_steps(
    states: Any, actions: Any, next_states: Any, num_states: int | None, num_actions: int | None
) -> RecordedSteps:
    """Numbers what was recorded, where the number of states, or of actions, is not given.

    States are numbered as they first appear among `states`, and after these those that were only ever reached. Actions
    that are whole numbers keep them; others are numbered as they first appear.

    Raises:
      ValueError: on sequences of different lengths or none at all; naming the first entry that is out of range, not
        whole, or that no name can be made of.
    """
    given = {"states": states, "actions": actions, "next_states": next_states}
    state_names = action_names = None
    if num_states is None:
        keys = [_keys(name, given[name]) for name in ("states", "next_states")]
        (given["states"], given["next_states"]), state_names = number_in_order(keys)
        num_states = len(state_names)
    if num_actions is None:
        taken = _keys("actions", actions)
        if all(type(key) is int for key in taken):
            given["actions"] = np.array(taken, int)
            num_actions = 1 + int(given["actions"].max(initial=0))
        else:
            (given["actions"],), action_names = number_in_order([taken])
            num_actions = len(action_names)
    num_states = checks.require_count("num_states", num_states)
    num_actions = checks.require_count("num_actions", num_actions)
    sizes = {"states": num_states, "actions": num_actions, "next_states": num_states}
    columns: list[np.ndarray] = []
    for name, values in given.items():
        array = checks.as_host_array(name, values)
        checks.require_shape(name, array, "[T] with T >= 1", array.ndim == 1 and array.size > 0)
        columns.append(checks.require_integers(name, array, sizes[name]))
        same = len(columns[-1]) == len(columns[0])
        checks.require_shape(name, array, f"({len(columns[0])},) like states", same)
    numbered = dict(zip(given, columns, strict=True))
    return RecordedSteps(
        **numbered, num_states=num_states, num_actions=num_actions, state_names=state_names, action_names=action_names
    )


def with_ends(steps: RecordedSteps, terminated: Any, end_state: bool) -> RecordedSteps:
    """The transitions with the states where episodes end: those that terminated steps lead to, or one that is added.

    Args:
      steps: as they were recorded.
      terminated: bool [T], which of them ended their episode.
      end_state: whether all these lead to one state more, the last.

    Raises:
      ValueError: naming a step that goes on from a state in which others end, or enters it and goes on.
    """
    is_end = as_flags("terminated", terminated, len(steps.states))
    if end_state:
        names = steps.state_names
        return steps._replace(
            next_states=np.where(is_end, steps.num_states, steps.next_states),
            num_states=steps.num_states + 1,
            state_names=None if names is None else (*names, END if END not in names else (END, len(names))),
            terminal=np.arange(steps.num_states + 1) == steps.num_states,
        )
    terminal = np.zeros(steps.num_states, bool)
    terminal[steps.next_states[is_end]] = True
    for column, how in ((steps.states, "leaves it"), (steps.next_states, "enters it and goes on")):
        bad = terminal[column] & ~is_end if how != "leaves it" else terminal[column]
        if bad.any():
            step = int(bad.argmax())
            state = described(column[step], steps.state_names)
            raise ValueError(
                f"state {state} ends some episodes, but step {step} {how}: it cannot be made absorbing; pass "
                "end_state=True, which sends every terminated step to one state more"
            )
    return steps._replace(terminal=terminal)


def _keys(name: str, values: Any) -> list[Hashable]:
    """What each entry is called."""
    try:
        keys = keys_of(values)
    except TypeError:
        raise ValueError(f"{name} must be a sequence, got {type(values).__name__}") from None
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None
    for index, key in enumerate(keys):
        if any(isinstance(part, float) and part != part for part in (key if type(key) is tuple else (key,))):
            raise ValueError(f"{name}[{index}] must not be NaN, which is equal to nothing, got {key}")
    return keys
