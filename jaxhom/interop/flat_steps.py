"""Demonstrations from tables with a row per step: flat arrays, transitions, D4RL's dictionaries, data frames, buffers.

Which rows belong to one episode `step_order` finds out; the episodes are read as all others are.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxhom import checks
from jaxhom.interop.column_names import field, fields_by_role, listed, names_by_role
from jaxhom.interop.import_reports import ImportReport
from jaxhom.interop.numbering import NO_ACTION, Numbering, literal, numberings, parsed
from jaxhom.interop.state_sequences import demonstrations_from_states
from jaxhom.interop.step_assembly import assembled
from jaxhom.interop.step_order import Refusal, Rows, put_in_order
from jaxhom.interop.trajectories import as_flags, is_time_limit, read_episodes
from jaxhom.models.demonstrations import Demonstrations
from jaxhom.models.mdp import MDP

if TYPE_CHECKING:
    from jaxtyping import ArrayLike, Bool, Int, Shaped

_FLAGS = ("terminated", "truncated", "start")


def demonstrations_from_steps(
    episode: Shaped[ArrayLike, "T"],
    observations: Shaped[ArrayLike, "T ..."],
    actions: Int[ArrayLike, "T *1"],
    *,
    mdp: MDP | None = None,
    to_states: Callable[[Any], Any] | None = None,
) -> tuple[Demonstrations, ImportReport]:
    """Reads flat arrays with one step an entry, as offline data sets hold them.

    Args:
      episode: [T], which episode each step belongs to: any numbers or texts. Steps of one episode are in their order;
        episodes may be interleaved. From flags that mark last steps: `numpy.cumsum(done) - done`.
      observations: [T, ...], one observation per step.
      actions: [T] or [T, 1].
      mdp: as in `demonstrations_from_episodes`.
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
    columns = _of_one_length("episode", {"episode": names, "observations": observations, "actions": actions})
    has_action = np.ones(len(names), bool)
    by_role = {"episode": names, "state": columns["observations"], "action": columns["actions"]}
    return _read(_in_order(by_role, has_action), by_role, has_action, mdp, to_states)


def demonstrations_from_transitions(
    observations: Shaped[ArrayLike, "T ..."],
    actions: Int[ArrayLike, "T *1"],
    next_observations: Shaped[ArrayLike, "T ..."],
    dones: Bool[ArrayLike, "T"],
    *,
    truncated: Bool[ArrayLike, "T"] | None = None,
    mdp: MDP | None = None,
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
      mdp: as in `demonstrations_from_episodes`.
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
    before, after, taken = _of_one_length("observations", given).values()
    checks.require_shape("next_observations", after, f"{before.shape} like observations", after.shape == before.shape)
    length, has_action = len(before), np.ones(len(before), bool)
    by_role = {
        "state": before,
        "action": taken,
        "next_state": after,
        "terminated": as_flags("dones", dones, length),
        "truncated": as_flags("truncated", ~has_action if truncated is None else truncated, length),
    }
    return _read(_in_order(by_role, has_action), by_role, has_action, mdp, to_states)


def demonstrations_of_table(
    table: Any,
    *,
    mdp: MDP | None,
    columns: Mapping[str, str] | None,
    to_states: Callable[[Any], Any] | None,
    ambiguous: str,
) -> tuple[Demonstrations, ImportReport]:
    """Reads columns by their usual names; see `demonstrations_from`.

    Args:
      table: a mapping, a data frame or an object, with columns [T, ...]. Flags may be [T, E], steps of E environments
        side by side: then all columns have these axes.

    Raises:
      ValueError: naming the column, or the rows, that cannot be used.
    """
    fields = {role: _column(role, column) for role, column in fields_by_role(table, columns).items()}
    needed = ("state",) if mdp is not None else ("state", "action")  # a model finds the actions between states
    for role in needed:
        if role not in fields:
            raise ValueError(f"column {role!r} is missing (there is {listed(fields)})")
        checks.require_shape(f"column {role!r}", fields[role], "[T, ...]", fields[role].ndim >= 1)
    fields = _filled(table, fields)
    infos = field(table, "infos")  # imitation's
    if "truncated" not in fields and hasattr(infos, "__len__") and len(infos) == len(fields["state"]):
        fields["truncated"] = np.array([is_time_limit(info) for info in infos])
    if any(fields[role].ndim == 2 for role in _FLAGS if role in fields):
        fields = _one_after_the_other(fields)
    if "action" in fields and len(fields["state"]) == 1 + len(fields["action"]):
        return read_episodes([table], mdp=mdp, to_states=to_states, columns=columns)
    by_role = _of_one_length("state", fields)
    if "action" in fields and _holds_episodes(fields["state"], fields["action"]):
        return read_episodes(_one_a_row(table, by_role), mdp=mdp, to_states=to_states)
    length = len(by_role["state"])
    names = names_by_role(table, columns)
    by_role |= {role: as_flags(names.get(role, role), by_role[role], length) for role in _FLAGS if role in fields}
    if to_states is not None:
        by_role |= {role: parsed(by_role[role]) for role in ("state", "next_state") if role in fields}
    has_action = ~_is_missing(by_role["action"]) if "action" in fields else np.ones(length, bool)
    rows = _in_order(by_role, has_action)
    if mdp is None or "action" in fields:
        return _read(rows, by_role, has_action, mdp, to_states)
    sequences = rows.states(by_role, has_action)
    if to_states is not None:
        sequences = [to_states(sequence) for sequence in sequences]
    return demonstrations_from_states(mdp, sequences, ambiguous=ambiguous)


def _holds_episodes(states: np.ndarray, actions: np.ndarray) -> bool:
    """Whether the rows of a table are episodes rather than steps: each holds a sequence of actions, or writes one."""
    if actions.ndim == 2:
        return actions.shape[1] > 1 and states.ndim >= 2 and states.shape[1] - actions.shape[1] in (0, 1)
    return actions.dtype.kind in "OU" and len(actions) > 0 and isinstance(_cell(actions[0]), tuple | list | np.ndarray)


def _one_a_row(table: Any, columns: Mapping[str, np.ndarray]) -> list[dict[str, Any]]:
    """The rows of a table as episodes."""
    cells = {role: list(map(_cell, column)) for role, column in columns.items() if role != "episode"}
    infos = field(table, "infos")
    if infos is not None:
        cells["infos"] = infos
    return [dict(zip(cells, row, strict=True)) for row in zip(*cells.values(), strict=True)]


def _cell(cell: Any) -> Any:
    return literal(cell) if isinstance(cell, str) else cell


def _of_one_length(first: str, columns: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Columns as arrays [T, ...], T >= 1, as long as the one that is called `first`."""
    arrays = {name: checks.as_host_array(name, column) for name, column in columns.items()}
    length = len(np.atleast_1d(arrays[first]))
    for name, array in arrays.items():
        good = array.ndim >= 1 and len(array) == length > 0
        checks.require_shape(name, array, f"({length}, ...) like {first}, T >= 1", good)
    return arrays


def _column(role: str, field: Any) -> np.ndarray:
    """A column as an array: of arrays, where it holds sequences of unequal length, and of names that have parts."""
    try:
        array = checks.as_host_array(role, field)
    except ValueError:
        if not isinstance(field, list | tuple):
            raise
    else:
        if not (array.dtype.kind == "U" and isinstance(field, list | tuple) and any(map(_is_mixed, field))):
            return array
    array = np.empty(len(field), object)
    for row, cell in enumerate(field):
        array[row] = cell if _is_mixed(cell) else np.asarray(cell)
    return array


def _is_mixed(cell: Any) -> bool:
    """Whether a cell is a name like `("kitchen", 0)`, which an array would make one of texts, or `((0, 1), "hall")`."""
    if not isinstance(cell, tuple):
        return False
    is_text = [isinstance(part, str) for part in cell]
    return any(is_text) and not all(is_text)


def _filled(table: Any, fields: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The part of a replay buffer (Stable-Baselines3's) that has been filled, from the oldest step on."""
    position, is_full, size = (getattr(table, name, None) for name in ("pos", "full", "buffer_size"))
    if not isinstance(position, int) or not isinstance(is_full, bool) or position == size:
        return fields
    if is_full:
        return {role: np.roll(column, -position, axis=0) for role, column in fields.items()}
    return {role: column[:position] for role, column in fields.items()}


def _one_after_the_other(fields: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Columns of E environments side by side, [T, E, ...], as [E T, ...]: one environment after the other."""
    steps, environments = next(fields[role].shape for role in _FLAGS if role in fields and fields[role].ndim == 2)
    flat = {
        role: column.swapaxes(0, 1).reshape(-1, *column.shape[2:])
        if column.shape[:2] == (steps, environments)
        else column  # buffers that have been trained on are flat already, but for their flags
        for role, column in fields.items()
    }
    first = np.arange(steps * environments) % steps == 0
    start = as_flags("start", flat["start"], len(first)) if "start" in flat else np.zeros(len(first), bool)
    return {**flat, "start": start | first}


def _is_missing(column: np.ndarray) -> np.ndarray:
    """bool [T], where a column holds nothing: an empty field, or what stands for it in data frames."""
    if column.dtype.kind in "OUS" and column.ndim == 1:
        return np.array([str(cell).strip().lower() in NO_ACTION for cell in column], bool)
    if column.dtype.kind == "f":
        return np.isnan(column).reshape(len(column), -1).any(axis=1)
    return np.zeros(len(column), bool)


def _in_order(columns: dict[str, np.ndarray], has_action: np.ndarray) -> Rows:
    """The rows of each episode in order; `step` and `episode` are checked first."""
    if "step" in columns:
        columns["step"] = Numbering("step").indices("step", columns["step"])
    if "episode" in columns and (missing := _is_missing(columns["episode"])).any():
        raise ValueError(f"episode[{missing.argmax()}] is missing")
    try:
        return put_in_order(columns, has_action)
    except Refusal as refusal:
        raise ValueError(refusal.said("row")) from None


def _read(
    rows: Rows,
    columns: Mapping[str, np.ndarray],
    has_action: np.ndarray,
    mdp: MDP | None,
    to_states: Callable[[Any], Any] | None,
) -> tuple[Demonstrations, ImportReport]:
    """The demonstrations of rows with actions: all at once, or episode by episode where some have to be dropped."""
    of_states, of_actions = numberings(mdp)
    try:
        if to_states is None:
            roles = [role for role in ("state", "next_state") if role in columns]
            actions = np.zeros(len(has_action), np.int64)
            actions[has_action] = of_actions.indices("actions", columns["action"][has_action])
            states = {role: of_states.indices("observations", columns[role]) for role in roles}
            return assembled(rows, {**columns, **states, "action": actions}, has_action, range(len(rows.first)))
    except ValueError:
        pass
    parts = rows.states(columns, has_action), rows.actions(columns, has_action), rows.terminated(columns)
    names = ("state", "action", "terminated")
    episodes = [dict(zip(names, episode, strict=True)) for episode in zip(*parts, strict=True)]
    return read_episodes(episodes, mdp=mdp, to_states=to_states)
