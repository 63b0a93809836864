"""Which of many recorded steps belong to one episode, and in which order: rows of a table become episodes.

Rows of one episode have one name in the column of the episodes, if there is one. Else an episode ends after a row that
says so, before one that says that it is the first, where a next state is not the state of the following row, where the
steps' numbers begin again, and after a final observation: a row without an action, in the state where the episode
ended. Where the steps are numbered, they are put in that order. What contradicts itself is refused.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from jaxhom.interop.numbering import keys_of, number_in_order

_APART = "terminated", "truncated", "start", "next_state", "step"  # what tells episodes apart that have no names


class Rows(NamedTuple):
    """T rows of a table, put in order.

    Attributes:
      order: int [T], the rows, those of each episode together and in the order of its steps.
      first: int [M], where in `order` each of M episodes begins; they come in the order in which they begin.
    """

    order: np.ndarray
    first: np.ndarray

    def split(self, column: np.ndarray) -> list[np.ndarray]:
        """A column [T, ...] of the table, episode by episode."""
        return np.split(column[self.order], self.first[1:])

    def any(self, column: np.ndarray) -> np.ndarray:
        """bool [M], whether a column, bool [T], is True anywhere in each episode."""
        return np.logical_or.reduceat(column[self.order], self.first)

    def states(self, columns: Mapping[str, np.ndarray], has_action: np.ndarray) -> list[np.ndarray]:
        """The states of each episode, and the one after its last step where the table holds it."""
        states = self.split(columns["state"])
        if "next_state" not in columns:
            return states
        last = self.order[np.append(self.first[1:], len(self.order)) - 1]
        final = columns["next_state"]
        return [
            np.concatenate([each, final[row : row + 1]]) if has_action[row] else each
            for each, row in zip(states, last, strict=True)
        ]

    def actions(self, columns: Mapping[str, np.ndarray], has_action: np.ndarray) -> list[np.ndarray]:
        """The actions of each episode, without those that a final observation lacks."""
        parts = zip(self.split(columns["action"]), self.split(has_action), strict=True)
        return [actions[: len(actions) - (not taken[-1])] for actions, taken in parts]

    def terminated(self, columns: Mapping[str, np.ndarray]) -> np.ndarray:
        """bool [M], the episodes that terminated: one whose last step has both flags was cut off."""
        ended, cut = (
            self.any(columns[role]) if role in columns else np.zeros(len(self.first), bool)
            for role in ("terminated", "truncated")
        )
        return ended & ~cut


class Refusal(ValueError):
    """What is wrong with rows of a table, `rows`: the reason, to which the caller adds what it calls them."""

    def __init__(self, reason: str, *rows: Any):
        super().__init__(reason)
        self.rows = tuple(map(int, rows))

    def said(self, kind: str, number: Callable[[int], int] = int) -> str:
        """The whole message, with rows that are called `kind` and numbered by the caller."""
        numbers = " and ".join(str(number(row)) for row in self.rows)
        plural = "s" if len(self.rows) > 1 else ""
        return f"{kind}{plural} {numbers}: {self}" if self.rows else str(self)


def put_in_order(columns: Mapping[str, np.ndarray], has_action: np.ndarray) -> Rows:
    """Finds the episodes.

    Args:
      columns: at least one, [T, ...] each, T >= 1, by their roles: `state`, `next_state`, [T, ...], that compare by
        value; `episode`, any names [T]; `step`, numbers [T]; `terminated`, `truncated` and `start`, bool [T].
      has_action: bool [T], False on final observations.

    Raises:
      Refusal: if nothing tells the episodes apart, a step occurs twice, one follows a final observation or the end of
        its episode, or a next state is not that of the step that follows.
    """
    group = _groups(columns["episode"]) if "episode" in columns else _found(columns, has_action)
    if "step" in columns and "episode" in columns:
        order = np.lexsort((columns["step"], group))
    else:
        order = np.argsort(group, kind="stable")
    same = np.diff(group[order]) == 0  # whether each row and the one after it are of one episode
    _require_consistent(columns, has_action, order[:-1][same], order[1:][same])
    return Rows(order, np.append(0, np.flatnonzero(~same) + 1))


def _groups(names: np.ndarray) -> np.ndarray:
    """[T], numbers of the episodes from 0 on, in the order in which they begin."""
    if names.dtype == object or names.ndim > 1:
        return number_in_order([keys_of(names)])[0][0]
    _, first, group = np.unique(names, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[group]


def _found(columns: Mapping[str, np.ndarray], has_action: np.ndarray) -> np.ndarray:
    """[T], numbers of the episodes of rows in order, whose episodes have no names."""
    if has_action.all() and not any(role in columns for role in _APART):
        raise Refusal(
            "column 'episode' is missing, and so is whatever else would tell episodes apart "
            f"({', '.join(role.replace('_', ' ') for role in _APART)}); for a single one it is the same in all rows"
        )
    begins = ~has_action[:-1]
    for role in ("terminated", "truncated"):
        if role in columns:  # the final observation of an episode that has ended is still its own
            begins = begins | (columns[role][:-1] & has_action[1:])
    if "start" in columns:
        begins = begins | columns["start"][1:]
    if "next_state" in columns:
        begins = begins | ~_equal(columns["next_state"][:-1], columns["state"][1:])
    if "step" in columns:
        begins = begins | (columns["step"][1:] <= columns["step"][:-1])
    return np.cumsum(np.append(False, begins))


def _require_consistent(columns, has_action, former, later) -> None:
    """Raises at the first of the pairs of rows that follow each other in an episode and do not fit."""

    def first(bad: np.ndarray) -> tuple[int, int] | None:
        return (former[bad.argmax()], later[bad.argmax()]) if bad.any() else None

    if "step" in columns:
        step = columns["step"]
        if pair := first(step[former] == step[later]):
            raise Refusal(f"step {step[pair[0]]} occurs twice in its episode", *pair)
    if pair := first(~has_action[former]):
        raise Refusal("a step after its episode's final observation (a line without action)", pair[1])
    for role in ("terminated", "truncated"):
        if role in columns and (pair := first(columns[role][former] & has_action[later])):
            raise Refusal(f"a step after the one that {role} its episode", pair[1])
    if "next_state" in columns:
        state, follows = columns["state"], columns["next_state"]
        if pair := first(~_equal(follows[former], state[later]) & has_action[former]):
            raise Refusal(f"the next state is {follows[pair[0]]}, but then the state is {state[pair[1]]}", *pair)


def _equal(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """bool [T], which rows of two arrays [T, ...] are equal."""
    same = np.asarray(left == right)
    return np.all(same, axis=tuple(range(1, same.ndim)))
