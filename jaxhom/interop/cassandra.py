"""Models in Cassandra's format: the `.MDP` and `.POMDP` files of pomdp-solve and of the collections in its format.

What is read is the model under the observations, as if the state were seen. Rewards become expected ones,

    r(s, a) = sum_z T(s, a, z) sum_o O(a, z, o) R(a, s, z, o),

and observations count only where they change the reward; else they are not read, and a remark says so. Costs become
rewards with the sign changed. `cassandra_statements` describes the format.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxhom import checks
from jaxhom.interop.archives import FileError, errors_of
from jaxhom.interop.cassandra_statements import WILD, Rules, Statements, Things, number_of, start_of
from jaxhom.interop.imported_model import Entries, ImportedModel, counted, model_of_entries, named
from jaxhom.models.padded_rows import rows_and_places

if TYPE_CHECKING:
    from jaxtyping import ArrayLike, Float


def from_cassandra(path: str | os.PathLike, *, discount: Float[ArrayLike, ""] | None = None) -> ImportedModel:
    """Reads a model in Cassandra's format.

    Args:
      path: the file, plain or compressed by gzip.
      discount: scalar, strictly between 0 and 1; that of the file if None. Files whose discount is 1 need one.

    Returns:
      The model with the names of its states and actions, and its reward, None if the file has none. Remarks say what
      became of observations, costs and a discount that was replaced.

    Raises:
      FileError: if the file is missing or no text; naming the line of what is malformed or not known; naming state and
        action of the first row that does not sum to 1; or if there is no discount between 0 and 1.

    Outside jit, vmap and grad only: what is read is checked on the host.

    Example:
      >>> import pathlib, tempfile
      >>> path = pathlib.Path(tempfile.mkdtemp(), "door.MDP")
      >>> _ = path.write_text('''
      ... discount: 0.9
      ... states: open shut
      ... actions: push wait
      ... T: wait identity
      ... T: push : shut  0.7 0.3
      ... T: push : open  1.0 0.0
      ... R: push : shut : open : * 1
      ... ''')
      >>> door = from_cassandra(path)
      >>> door.state_names, np.asarray(door.reward, float).round(2).tolist()
      (('open', 'shut'), [[0.0, 0.0], [0.7, 0.0]])
    """
    statements = Statements(path)
    states, actions = _declared(statements, "states"), _declared(statements, "actions")
    with errors_of(path):
        checks.require_slots(states.count, actions.count, 1)
    observations = Things.read(statements, "observations")
    seen = observations or Things("observation", 1, None, {"*": WILD})
    remarks: list[str] = []
    gamma = _discount(statements, discount, remarks)
    start = start_of(statements, states)
    uniform = np.full(states.count, 1.0 / states.count)
    axes = (actions, states, states)
    transitions = Rules.read(statements, "T", axes, uniform if start is None else start)
    places, probability = transitions.entries([axis.count for axis in axes])
    action, state, next_state = places.T
    _require_all_rows(path, action, state, actions, states)
    rules = Rules.read(statements, "R", (*axes, seen), uniform)
    reward = _rewards(statements, rules, places, (actions, states, seen), remarks)
    if observations is not None and not any("reward depends" in remark for remark in remarks):
        remarks.append(f"{counted(observations.count, 'observation')} ignored")
    with errors_of(path):
        return model_of_entries(
            Entries(state, action, next_state, probability, reward),
            num_states=states.count,
            num_actions=actions.count,
            discount=gamma,
            initial=start,
            state_names=states.names,
            action_names=actions.names,
            remarks=remarks,
        )


def _declared(statements: Statements, word: str) -> Things:
    things = Things.read(statements, word)
    if things is None:
        has = ", ".join(statements.numbers) or "nothing"
        raise FileError(f"{statements.path}: it declares no {word} (it has {has})")
    return things


def _discount(statements: Statements, discount: Any, remarks: list[str]) -> float:
    """The discount to use: the given one, or that of the file."""
    found = number_of(statements, "discount")
    if discount is not None:
        given = float(checks.require_discount(discount))
        if found is not None and found[1] != given:
            remarks.append(f"discount {found[1]:g} replaced by {given:g}")
        return given
    if found is None:
        raise FileError(f"{statements.path}: it has no discount: give one")
    number, value = found
    if not 0.0 < value < 1.0:
        raise statements.error(number, f"must lie strictly between 0 and 1, got {value:g}: give another")
    return value


def _require_all_rows(path, action: np.ndarray, state: np.ndarray, actions: Things, states: Things) -> None:
    """Every action exists in every state of this format."""
    is_set = np.zeros((states.count, actions.count), bool)
    is_set[state, action] = True
    if not is_set.all():
        s, a = np.argwhere(~is_set)[0]
        pair = f"action {named(actions.names, a)} in state {named(states.names, s)}"
        others = int((~is_set).sum()) - 1
        more = f", nor of {counted(others, 'other pair')}" if others else ""
        raise FileError(f"{path}: no probabilities (T) of {pair}{more}")


def _rewards(statements: Statements, rules: Rules, places: np.ndarray, axes, remarks: list[str]) -> np.ndarray | None:
    """float [N]: the expected reward of each transition, None if the file has no rewards."""
    sign = _sign(statements)
    if not rules.time.size:
        return None
    actions, states, seen = axes
    shape = (actions.count, states.count, states.count, seen.count)
    if seen.count == 1 or (rules.fields[:, 3] == WILD).all():
        reward = rules.at(np.pad(places, ((0, 0), (0, 1))), shape)
    else:
        remarks.append(f"reward depends on the {counted(seen.count, 'observation')}: the expected one is used")
        reward = _mean_over_observations(statements, rules, places, axes, shape)
    if sign < 0:
        remarks.append("costs became rewards with the sign changed")
    return sign * reward


def _sign(statements: Statements) -> int:
    found = statements.only("values")
    if found is None:
        return 1
    number, words = found
    if words not in (["reward"], ["cost"]):
        raise statements.error(number, f"must be reward or cost, got {' '.join(words)!r}")
    return -1 if words == ["cost"] else 1


def _mean_over_observations(statements: Statements, rules: Rules, places: np.ndarray, axes, shape) -> np.ndarray:
    """float [N]: sum_o O(a, z, o) R(a, s, z, o) of transitions (a, s, z)."""
    actions, states, seen = axes
    table = Rules.read(statements, "O", (actions, states, seen), np.zeros(0))
    observed, chance = table.entries((actions.count, states.count, seen.count))
    row_of = observed[:, 0] * states.count + observed[:, 1]
    count = np.bincount(row_of, minlength=actions.count * states.count)
    first = np.cumsum(count) - count
    row = places[:, 0] * states.count + places[:, 2]
    total = np.bincount(row_of, chance, minlength=len(count))
    wrong = ~checks.sums_to_one(total[row], np.float64)
    if wrong.any():
        a, _, z = places[np.argmax(wrong)]
        pair = f"action {named(actions.names, a)} and next state {named(states.names, z)}"
        raise FileError(f"{statements.path}: observations (O) of {pair} must sum to 1, got {total[row][wrong][0]:g}")
    step, place = rows_and_places(count[row])
    entry = first[row][step] + place
    reward = rules.at(np.column_stack([places[step], observed[entry, 2]]), shape)
    return np.bincount(step, chance[entry] * reward, minlength=len(places)) / total[row]
