"""The states that a function of successors leads to, breadth first: how `MDP.from_function` finds a model.

States are numbered as they are met, the first ones those where episodes start; so are actions, unless they are given.
"""

from __future__ import annotations

import math
import numbers
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from jaxhom import checks
from jaxhom.models.names import Names, numbers_of
from jaxhom.models.padded_rows import rows_and_places

Successors = Callable[[Any], Mapping[Hashable, Iterable[tuple[float, Hashable]]] | None]


class Explored(NamedTuple):
    """What was found: S states, A actions, E outcomes of pairs that exist.

    Attributes:
      states, actions: by number.
      pair: int [E], s * A + a of each outcome, ascending; successor: int [E]; probability: float [E].
      initial: float [S].
      ends: bool [S], the states without actions.
    """

    states: Names
    actions: Names
    pair: np.ndarray
    successor: np.ndarray
    probability: np.ndarray
    initial: np.ndarray
    ends: np.ndarray

    @property
    def allowed(self) -> np.ndarray:
        """bool [S, A]: the pairs that have outcomes, and all of states that end episodes."""
        allowed = np.zeros(len(self.states) * len(self.actions), bool)
        allowed[self.pair] = True
        return allowed.reshape(len(self.states), len(self.actions)) | self.ends[:, None]


def explore(
    successors: Successors,
    start: Hashable | Mapping[Hashable, float],
    actions: Iterable[Hashable] | None,
    max_states: int,
    progress: bool,
) -> Explored:
    """Explores all that can be reached; arguments and errors are those of `MDP.from_function`."""
    checks.require_function("successors", successors)
    max_states = checks.require_count("max_states", max_states)
    found = _Found(max_states)
    weights = _start(found, start)
    columns = {} if actions is None else numbers_of("actions", tuple(actions))
    source, action, target, chance, ends = [], [], [], [], []
    for number, state in enumerate(tqdm(iter(found), "states", disable=not progress, unit=" states")):
        offered = _call("successors", successors, state)
        for name, outcomes in _offers(state, offered):
            column = _column(columns, state, name, is_open=actions is None)
            for probability, following in _outcomes(state, name, outcomes):
                source.append(number)
                action.append(column)
                target.append(found.number_of(following, state, name))
                chance.append(probability)
        ends.append(not offered)
    if not columns:
        raise ValueError("there are no actions: successors gave none in any of the states that can be reached")
    pair = np.array(source, np.int64) * len(columns) + np.array(action, np.int64)
    initial = np.zeros(len(found))
    initial[: len(weights)] = weights
    order = np.argsort(pair, kind="stable")
    return Explored(
        states=tuple(found),
        actions=tuple(columns),
        pair=pair[order],
        successor=np.array(target, np.int64)[order],
        probability=np.array(chance, np.float64)[order],
        initial=initial,
        ends=np.array(ends),
    )


def _call(name: str, function: Callable, *given: Any) -> Any:
    """What a function of the caller's returns; what it raises says for which state it was called."""
    try:
        return function(*given)
    except Exception as error:
        error.add_note(f"in {name}({', '.join(map(checks.in_one_line, given))})")
        raise


def padded(explored: Explored) -> tuple[np.ndarray, np.ndarray]:
    """The outcomes as successors and probabilities [S, A, N]; a state without actions stays where it is."""
    num_states, num_actions = len(explored.states), len(explored.actions)
    count = np.bincount(explored.pair, minlength=num_states * num_actions)
    width = max(1, int(count.max()))
    checks.require_slots(num_states, num_actions, width)
    pair, slot = rows_and_places(count)
    next_state = np.zeros((len(count), width), np.int64)
    probability = np.zeros((len(count), width))
    next_state[pair, slot], probability[pair, slot] = explored.successor, explored.probability
    shape = (num_states, num_actions, width)
    next_state, probability = next_state.reshape(shape), probability.reshape(shape)
    next_state[explored.ends], probability[explored.ends, :, 0] = np.flatnonzero(explored.ends)[:, None, None], 1.0
    return next_state, probability


def features_of(features: Callable[[Any, Any], Sequence[float]], explored: Explored) -> np.ndarray:
    """float [S, A, K]: the features of all pairs that exist; 0 elsewhere, and so in states without actions.

    Where no state has an action, nobody can say how many features there are: K = 0.

    Raises:
      ValueError: naming state and action of the first pair whose features are no K numbers.
    """
    checks.require_function("features", features)
    rows, table = np.unique(explored.pair), np.zeros((len(explored.states), len(explored.actions), 0))
    for pair in rows.tolist():
        state, action = divmod(pair, len(explored.actions))
        names = explored.states[state], explored.actions[action]
        row = checks.as_host_array(f"features of {_where(*names)}", _call("features", features, *names))
        if pair == rows[0]:
            table = np.zeros((*table.shape[:2], row.size))
        good = row.shape == table.shape[2:] and row.dtype.kind in "iubf" and np.isfinite(row).all()
        if not good:
            expected = f"{table.shape[2]} finite numbers, as those of the first pair"
            raise ValueError(f"features of {_where(*names)} must be {expected}, got {checks.in_one_line(row.tolist())}")
        table[state, action] = row
    return table


class _Found:
    """The states so far, in the order in which they were met; iterating goes on while there are more."""

    def __init__(self, max_states: int):
        self._numbers: dict[Hashable, int] = {}
        self._states: list[Hashable] = []
        self._max = max_states

    def __len__(self) -> int:
        return len(self._states)

    def __iter__(self) -> Iterator[Hashable]:
        number = 0
        while number < len(self._states):  # which grows
            yield self._states[number]
            number += 1

    def number_of(self, state: Hashable, *origin: Hashable) -> int:
        try:
            number = self._numbers.setdefault(state, len(self._states))
        except TypeError:
            where = f"{_where(*origin)}: a next state" if origin else "start"
            raise ValueError(f"{where} must be hashable (a tuple, say), got {checks.in_one_line(state)}") from None
        if number == len(self._states):
            if number >= self._max:
                raise ValueError(
                    f"more than {self._max} states can be reached, {checks.in_one_line(state)} the last of them: "
                    "pass a larger max_states, or make states coarser"
                )
            self._states.append(state)
        return number


def _start(found: _Found, start) -> np.ndarray:
    """Numbers the states where episodes start; their probabilities."""
    distribution = start if isinstance(start, Mapping) else {start: 1.0} if _is_hashable(start) else None
    if distribution is None:
        found.number_of(start)
    if not distribution:
        raise ValueError("start must be a state, or a mapping from states to probabilities, got an empty one")
    weights = []
    for state, probability in distribution.items():
        found.number_of(state)
        weights.append(_probability(f"start: the probability of state {checks.in_one_line(state)}", probability))
    _require_sum("start", weights)
    return np.array(weights)


def _is_hashable(state: Any) -> bool:
    try:
        hash(state)
    except TypeError:
        return False
    return True


def _offers(state, offered) -> Iterable[tuple[Hashable, Any]]:
    """The actions of a state and their outcomes."""
    if offered is None:
        return ()
    if not isinstance(offered, Mapping):
        raise ValueError(
            f"successors({checks.in_one_line(state)}) must be a mapping from actions to outcomes, or None where "
            f"nothing can be done, got {checks.in_one_line(offered)}"
        )
    return offered.items()


def _column(columns: dict[Hashable, int], state, action, *, is_open: bool) -> int:
    if action not in columns and not is_open:
        raise ValueError(f"{_where(state, action)}: not one of the given actions {checks.in_one_line(list(columns))}")
    return columns.setdefault(action, len(columns))


def _outcomes(state, action, outcomes) -> list[tuple[float, Hashable]]:
    """The outcomes of a pair that can happen, one at least."""
    where, expected = _where(state, action), "outcomes must be a list of pairs (probability, next state)"
    is_list = isinstance(outcomes, Iterable) and not isinstance(outcomes, str | Mapping)
    listed = list(outcomes) if is_list else []
    if not listed:
        raise ValueError(f"{where}: {expected}, got {checks.in_one_line(outcomes)}")
    for outcome in listed:
        if not isinstance(outcome, tuple | list) or len(outcome) != 2:
            raise ValueError(f"{where}: {expected}, got {checks.in_one_line(outcome)} among them")
    pairs = [(_probability(f"{where}: a probability", probability), following) for probability, following in listed]
    _require_sum(where, [probability for probability, _ in pairs])
    return [pair for pair in pairs if pair[0] > 0]


def _require_sum(where: str, probabilities: list[float]) -> None:
    total = math.fsum(probabilities)
    if not checks.sums_to_one(total, np.float64):
        raise ValueError(f"{where}: probabilities must sum to 1, got {total}")


def _probability(what: str, value: Any) -> float:
    is_number = isinstance(value, numbers.Real | np.number) or (hasattr(value, "item") and np.ndim(value) == 0)
    number = float(value) if is_number else np.nan
    if not 0.0 <= number < np.inf:
        raise ValueError(f"{what} must be a number, not negative, got {checks.in_one_line(value)}")
    return number


def _where(state, action) -> str:
    return f"state {checks.in_one_line(state)}, action {checks.in_one_line(action)}"
