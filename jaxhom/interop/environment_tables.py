"""The transition table `P` of a Gymnasium environment as arrays, and whether the environment does what it says.

`env.unwrapped.P[s][a]` lists outcomes (probability, next state, reward, terminated). A table may be nested lists or
dictionaries; states may lack actions. What is malformed is one `ValueError` that names the entry. Options and wrappers
that act in `step` alone, outside the table, are found by asking for the known ones and by taking random steps.
"""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jaxhom import checks

if TYPE_CHECKING:
    import gymnasium

_OUTSIDE_THE_TABLE = ("fickle_passenger",)  # options of Gymnasium's environments that act in `step` alone


class TransitionTable(NamedTuple):
    """A table's outcomes, padded with zeros to N of them per state and action.

    Attributes:
      next_state: int [S, A, N].
      probability: [S, A, N], rows of actions that are allowed sum to 1.
      reward: [S, A, N], of each outcome.
      terminated: bool [S, A, N], whether the outcome ends the episode; False where its probability is 0.
      allowed: bool [S, A], which actions have outcomes.
    """

    next_state: np.ndarray
    probability: np.ndarray
    reward: np.ndarray
    terminated: np.ndarray
    allowed: np.ndarray


def read_table(env: gymnasium.Env) -> TransitionTable:
    """The table of an environment.

    Raises:
      ValueError: if it has none, or naming the first entry that is malformed.
    """
    table = getattr(getattr(env, "unwrapped", env), "P", None)
    if table is None:
        raise ValueError(
            f"{name_of(env)} has no transition table P: record transitions in it, and estimate a model with "
            "jaxhom.interop.from_samples"
        )
    entries, allowed = _entries(_rows(table, name_of(env), getattr(getattr(env, "action_space", None), "n", None)))
    probability, next_state, reward, terminated = np.moveaxis(entries, -1, 0)
    probability = checks.require_distribution("P: probability", probability, None if allowed.all() else allowed)
    next_state = checks.require_integers("P: next state", next_state, upper=len(entries))
    reward = checks.require_floats("P: reward", reward)
    return TransitionTable(next_state, probability.copy(), reward, (terminated != 0) & (probability > 0), allowed)


def _entries(rows: list[list]) -> tuple[np.ndarray, np.ndarray]:
    """The table's numbers, [S, A, N, 4], padded with zeros, and which pairs have any, [S, A]."""
    width = max(1, max(len(outcomes) for row in rows for outcomes in row))
    checks.require_slots(len(rows), len(rows[0]), width)
    entries = np.zeros((len(rows), len(rows[0]), width, 4))
    allowed = np.array([[len(outcomes) > 0 for outcomes in row] for row in rows])
    for s, row in enumerate(rows):
        for a, outcomes in enumerate(row):
            for i, outcome in enumerate(outcomes):
                try:
                    probability, next_state, reward, terminated = outcome
                    entries[s, a, i] = probability, next_state, reward, terminated
                except (TypeError, ValueError):
                    expected = "(probability, next state, reward, terminated)"
                    got = checks.in_one_line(outcome)
                    raise ValueError(f"P[{s}][{a}][{i}] must be {expected}, got {got}") from None
    return entries, allowed


def _rows(table, name: str, most: int | None) -> list[list]:
    """The table as nested lists, whatever it is kept in: states 0 ... S-1, each with actions 0 ... A-1.

    Where a state lacks an action (a dictionary without it, or no outcomes), its list is empty. `most` is how many
    actions the environment has, if it says so.
    """
    try:
        num_states = len(table)
        for s in range(num_states):
            _require_actions(table[s], f"P[{s}] of {name}", most)
        num_actions = max((_num_actions(table[s]) for s in range(num_states)), default=0)
        checks.require_slots(num_states, num_actions, 1)
        rows = [[list(_outcomes(table[s], a)) for a in range(_num_actions(table[s]))] for s in range(num_states)]
    except (TypeError, KeyError, IndexError) as error:
        raise ValueError(
            f"P of {name} must hold a list of outcomes as P[state][action], both numbered from 0: "
            f"{type(error).__name__} {error}"
        ) from None
    if not num_states or not num_actions:
        raise ValueError(f"P of {name} must have at least one state and one action")
    return [row + [[] for _ in range(num_actions - len(row))] for row in rows]


def _require_actions(actions, where: str, most: int | None) -> None:
    """Raises where a dictionary has an action that cannot be one of 0, 1, ..., `most` - 1."""
    for action in actions if isinstance(actions, Mapping) else ():
        if action < 0 or (most is not None and action >= most):
            range_ = "from 0 on" if most is None else f"from 0 to {most - 1}"
            raise ValueError(f"{where} has an action {checks.in_one_line(action)}: actions are numbered {range_}")


def _num_actions(actions) -> int:
    """The actions of one state: up to the largest number in a dictionary."""
    return max(actions, default=-1) + 1 if isinstance(actions, Mapping) else len(actions)


def _outcomes(actions, action: int):
    return actions.get(action, ()) if isinstance(actions, Mapping) else actions[action]


def require_known_options(env: gymnasium.Env) -> None:
    """Raises where an option makes the environment do what its table does not say (Taxi's fickle passenger)."""
    given = getattr(getattr(env, "spec", None), "kwargs", {})
    for option in _OUTSIDE_THE_TABLE:
        if given.get(option) or getattr(getattr(env, "unwrapped", env), option, False):
            raise ValueError(
                f"{name_of(env)} was made with {option}=True, which its table P does not contain: make it without, or "
                "record transitions and estimate a model with jaxhom.interop.from_samples"
            )


def require_steps_of_table(env: gymnasium.Env, num_steps: int = 200) -> None:
    """Takes random steps in an environment and raises if one is not in its table `P`.

    An option or a wrapper may act in `step` alone, and then the table is not the model of what an agent meets. The
    environment is reset and stepped: not for one in which an episode is under way.

    Args:
      env: the environment. Nothing is checked if it has no table, its observations are no states, or it cannot be
        stepped.
      num_steps: how many: some episodes of a small environment, in a few milliseconds.

    Raises:
      ValueError: naming the first state, action and next state that the table gives no probability.
    """
    table, found = getattr(env.unwrapped, "P", None), None
    with warnings.catch_warnings(), contextlib.suppress(Exception):  # the environment's own, whatever they are
        warnings.simplefilter("ignore")
        found = _step_outside(env, table, num_steps)
    if found is not None:
        state, action, successor = found
        raise ValueError(
            f"{name_of(env)}: action {action} led from state {state} to {successor}, which its table P gives "
            "probability 0: an option or a wrapper acts outside the table; make it without, or record "
            "transitions and estimate a model with jaxhom.interop.from_samples"
        )


def _step_outside(env, table, num_steps: int) -> tuple | None:
    """The first of some random steps that is not in the table: state, action, next state; None if all are."""
    rng = np.random.default_rng(0)
    state = env.reset(seed=0)[0]
    for _ in range(num_steps):
        candidates = range(_num_actions(table[int(state)])) if _is_state(state, table) else ()
        actions = [action for action in candidates if len(_outcomes(table[int(state)], action))]
        if not actions:
            return None
        action = actions[rng.integers(len(actions))]
        successor, _, terminated, truncated, _ = env.step(action)
        outcomes = _outcomes(table[int(state)], action)
        if _is_state(successor, table) and not any(o[0] > 0 and o[1] == successor for o in outcomes):
            return state, action, successor
        state = env.reset()[0] if terminated or truncated else successor
    return None


def _is_state(observation, table) -> bool:
    return np.ndim(observation) == 0 and np.asarray(observation).dtype.kind in "iu" and 0 <= observation < len(table)


def name_of(env: gymnasium.Env) -> str:
    """What messages call an environment."""
    return f"environment {type(getattr(env, 'unwrapped', env)).__name__}"
