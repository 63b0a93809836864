"""Questions to an expert as a terminal shows them: which states, where they are on the map, what can be answered."""

from __future__ import annotations

import string

import numpy as np

from jaxhom.cli.sources import Problem, plain_text
from jaxhom.cli.tables import format_table
from jaxhom.domains.racetrack import ACTIONS as RACETRACK_ACTIONS
from jaxhom.domains.racetrack import Racetrack
from jaxhom.guarantees.queries import Queries
from jaxhom.models.demonstrations import Demonstrations

_MARKS = string.digits[1:] + string.ascii_letters
_KNOWN = "+"
_MOVES = {(-1, 0): "up", (1, 0): "down", (0, -1): "left", (0, 1): "right", (0, 0): "stay"}


def questions(problem: Problem, demonstrations: Demonstrations, queries: Queries) -> str:
    """The states in a table, and on the map if there is one."""
    states = np.asarray(queries.states)
    columns = {
        "ask": map(mark, range(len(states))),
        "state": (name_of(problem, state) for state in states),
        "score": (f"{score:.4g}" for score in np.asarray(queries.scores)),
    }
    if queries.changes is not None:
        columns["changes a feature by"] = (f"{change:.4g}" for change in np.asarray(queries.changes))
    table = format_table(tuple(columns), list(zip(*columns.values(), strict=True)))
    return "\n".join([table, *_map(problem, demonstrations, states)])


def mark(number: int) -> str:
    """What stands for a question, counted from 0, on the map and in the table."""
    return _MARKS[number] if number < len(_MARKS) else "*"


def name_of(problem: Problem, state: int) -> str:
    """A state's number, and its name or on maps its place; the latter is what `Problem.state_of` looks for first."""
    if problem.mdp.state_names is not None:
        return f"{state} {plain_text(problem.mdp.state_names[state])}"
    if problem.domain is None or problem.coordinates is None:
        return str(state)
    place = [*problem.coordinates[state]]
    if isinstance(problem.domain, Racetrack):
        place += [*np.asarray(problem.domain.speeds)[state % len(problem.domain.speeds)]]
    return f"{state} at {','.join(map(str, place))}"


def action_names(problem: Problem) -> list[str]:
    """What the actions are called; their numbers where neither the model nor a map says more."""
    if problem.mdp.action_names is not None:
        return [plain_text(name) for name in problem.mdp.action_names]
    numbers = [str(action) for action in range(problem.mdp.num_actions)]
    if problem.domain is None:
        return numbers
    if isinstance(problem.domain, Racetrack):
        return list(RACETRACK_ACTIONS)
    return [_MOVES.get(move, number) for move, number in zip(problem.domain.moves, numbers, strict=True)]


def _map(problem: Problem, demonstrations: Demonstrations, states: np.ndarray) -> list[str]:
    """Lines of the map with a mark per question, the first of a cell, and `+` where the expert is known."""
    if problem.domain is None or problem.coordinates is None:
        return []
    letters = [list(row) for row in problem.domain.rows]
    known = np.asarray(demonstrations.states)[np.asarray(demonstrations.mask)]
    marks = [(state, _KNOWN) for state in known] + [(s, mark(i)) for i, s in reversed([*enumerate(states)])]
    for state, letter in marks:
        row, column = problem.coordinates[state]
        letters[row][column] = letter
    return ["", *("".join(row) for row in letters)]
