"""Trajectories as users have them, pairs of sequences of unequal length: checked, and padded to the longest.

On the host: nothing here but `with_single_steps` works under `jit`, `vmap` or `grad`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxhom import checks

if TYPE_CHECKING:
    from jaxtyping import ArrayLike, Bool


def padded(trajectories: Iterable[Any], terminated: Bool[ArrayLike, " M"] | None) -> dict[str, np.ndarray]:
    """The fields of `Demonstrations` by name, see `Demonstrations.from_trajectories`.

    Raises:
      ValueError: see there.
    """
    try:
        trajectories = list(trajectories)
    except TypeError:
        kind = type(trajectories).__name__
        raise ValueError(f"trajectories must be a sequence of pairs (states, actions), got {kind}") from None
    if not trajectories:
        raise ValueError("at least one trajectory is needed, got none")
    rows = [_validated_trajectory(i, pair) for i, pair in enumerate(trajectories)]
    require_no_steps(list(enumerate(trajectories)), "trajectory")
    if terminated is None:
        terminated = np.zeros(len(rows), bool)
    terminated = checks.require_flags("terminated", checks.as_host_array("terminated", terminated), len(rows))
    horizon = max(len(actions) for _, actions in rows)
    require_slots(len(rows), horizon)
    return {**_in_rows(rows, horizon), "terminated": terminated}


def require_slots(count: int, horizon: int) -> None:
    """Raises if so many trajectories, padded to the longest, are too many steps for 32-bit indices."""
    if count * horizon > checks.MAX_SLOTS:
        raise ValueError(
            f"{count} trajectories padded to the longest, {horizon} steps, are more than 2^31 - 2 steps: "
            "cut the long ones into pieces"
        )


def _in_rows(rows: list[tuple[np.ndarray, np.ndarray]], horizon: int) -> dict[str, np.ndarray]:
    """Checked trajectories as arrays [M, H], and where each ended."""
    states, actions = np.zeros((2, len(rows), horizon), np.int32)
    mask, final_states = np.zeros((len(rows), horizon), bool), np.full(len(rows), -1, np.int32)
    for i, (row_states, row_actions) in enumerate(rows):
        length = len(row_actions)
        states[i, :length] = row_states[:length]
        actions[i, :length] = row_actions
        mask[i, :length] = True
        final_states[i] = row_states[length] if len(row_states) > length else -1
    return {"states": states, "actions": actions, "mask": mask, "final_states": final_states}


def with_single_steps(demonstrations: Any, states: Any, actions: Any) -> dict[str, Any]:
    """The fields of demonstrations by name, with N answers behind them; see `Demonstrations.with_answers`."""
    given = {"states": states, "actions": actions}
    if not checks.is_traced(given):
        given = {name: checks.as_host_array(name, array) for name, array in given.items()}
    count = np.size(states)
    for name, array in given.items():
        checks.require_shape(name, array, f"({count},), as many states as actions", np.shape(array) == (count,))
        if not checks.is_traced(array):
            given[name] = checks.require_integers(name, np.asarray(array, None if count else int), checks.LARGEST_INDEX)
    xp = checks.arrays_of(demonstrations, given)
    is_given = xp.asarray(given["states"]) >= 0
    is_first = np.arange(demonstrations.horizon) == 0
    mask = is_given[:, None] & is_first
    rows = {
        **{name: xp.where(mask, xp.asarray(array, np.int32)[:, None], 0) for name, array in given.items()},
        "mask": mask,
        "terminated": np.zeros(count, bool),
        "final_states": np.full(count, -1, np.int32),
        "is_answer": np.ones(count, bool),
    }
    return {
        name: checks.to_device(xp.concatenate([xp.asarray(getattr(demonstrations, name)), more]))
        for name, more in rows.items()
    }


def require_no_steps(pairs: Sequence[tuple[int, Any]], kind: str) -> None:
    """Raises if nothing tells pairs (states, actions) from episodes of two steps (state, action) each.

    That is so where all pairs hold two and two numbers, and are not in the form that is asked for, a tuple of two lists
    or arrays. A single longer one shows what is meant.

    Args:
      pairs: what was given, with its position, [(position, pair), ...].
      kind: what a pair is called in the message.
    """
    if pairs and all(_may_be_steps(pair) for _, pair in pairs):
        position, pair = pairs[0]
        raise ValueError(
            f"{kind} {position} could be (states, actions) or two steps (state, action), got "
            f"{checks.in_one_line(pair)}: pass a tuple of two lists or arrays, ([state, state], [action, action])"
        )


def _may_be_steps(pair: Any) -> bool:
    parts = [part for part in pair if isinstance(part, tuple | list) or (isinstance(part, np.ndarray) and part.ndim)]
    parts = [part for part in parts if len(part) == 2]
    if len(parts) < 2 or any(hasattr(entry, "__len__") for part in parts for entry in part):
        return False
    return not isinstance(pair, tuple) or all(isinstance(part, tuple) for part in parts)


def _validated_trajectory(index: int, pair) -> tuple[np.ndarray, np.ndarray]:
    """Checks one (states, actions) pair."""
    try:
        states, actions = pair
    except (TypeError, ValueError):
        raise ValueError(f"trajectory {index} must be a pair (states, actions)") from None
    states = checks.as_host_array(f"trajectory {index} states", states)
    actions = checks.as_host_array(f"trajectory {index} actions", actions)
    for name, array in (("states", states), ("actions", actions)):
        checks.require_shape(f"trajectory {index} {name}", array, "[H]", array.ndim == 1)
    if len(states) - len(actions) not in (0, 1):
        counts = f"{len(states)} states and {len(actions)} actions"
        raise ValueError(f"trajectory {index} has {counts}: as many are needed, or one state more, where it ended")
    if not len(actions):
        raise ValueError(f"trajectory {index} is empty")
    upper = checks.LARGEST_INDEX
    states = checks.require_integers(f"trajectory {index} states", states, upper)
    return states, checks.require_integers(f"trajectory {index} actions", actions, upper)
