"""Gridworlds as text, one letter per cell: the `.gw` files of stochastic shortest path collections.

    .  open        x X #  wall                          S  start
    @  hole        D      dead end, never left          G  goal

The moves up, down, left and right succeed with probability 1 - slip and go to either side otherwise (Russell and
Norvig's gridworld for slip = 0.2); where a wall or the border is in the way one stays. Goals and dead ends absorb. A
file says what is where, not what it costs: features are minus the steps, minus those in holes, and arrivals at goals.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import numpy as np

from jaxhom import checks
from jaxhom.domains.tile_map import TileMap
from jaxhom.interop.archives import FileError, errors_of
from jaxhom.interop.imported_model import Entries, ImportedModel, model_of_entries
from jaxhom.interop.text_files import open_text, require_letters

if TYPE_CHECKING:
    from jaxtyping import ArrayLike, Float

_LETTERS = {**dict.fromkeys("xX#", "@"), ".": ".", "@": ".", "S": "S", "G": "F", "D": "#"}  # on a `TileMap`
_MOVES = {"up": (-1, 0), "down": (1, 0), "left": (0, -1), "right": (0, 1)}
_SIDES = ((2, 3), (2, 3), (0, 1), (0, 1))


def from_gridworld(
    path: str | os.PathLike, *, discount: Float[ArrayLike, ""] = 0.99, slip: float = 0.2
) -> ImportedModel:
    """Reads a gridworld (see the module's text).

    Args:
      path: the file, plain or compressed by gzip. Short rows are filled up with wall; blanks at their ends count for
        nothing.
      discount: scalar, strictly between 0 and 1.
      slip: probability of going to the side, each side half of it.

    Returns:
      The model without a reward: its states are the cells that are no wall, named (row, column) from (0, 0) on, which
      also are the coordinates. `labels` has `hole`, `goal` and `dead end`, `domain` the map. Episodes start in the
      cells S alike, or anywhere if there is none.

    Raises:
      FileError: if the file is missing or no text, naming line and column of an unknown letter, or without a cell to
        act in.
      ValueError: if `slip` is no probability.

    Outside jit, vmap and grad only: what is read is checked on the host.

    Example:
      >>> import pathlib, tempfile
      >>> path = pathlib.Path(tempfile.mkdtemp(), "small.gw")
      >>> _ = path.write_text("G.x\\n@.S\\n")
      >>> grid = from_gridworld(path, slip=0.0)
      >>> grid.state_names[3], grid.mdp.features[1, 2].tolist()  # from (0, 1) to the left
      ((1, 1), [-1.0, 0.0, 1.0])
    """
    if not 0.0 <= checks.require_number("slip", slip) <= 1.0:
        raise ValueError(f"slip must lie in [0, 1], got {slip}")
    letters = _map(path)
    rows = ["".join(map(_LETTERS.__getitem__, row)) for row in letters]
    is_cell = np.array([list(row) for row in rows]) != "@"
    cells, kind = np.argwhere(is_cell), letters[is_cell]
    labels = {"hole": kind == "@", "goal": kind == "G", "dead end": kind == "D"}
    is_end = labels["goal"] | labels["dead end"]
    if is_end.all():
        raise FileError(f"{path}: no cell of its map is open")
    target = _targets(is_cell, cells)
    state = np.flatnonzero(~is_end)
    entries = _entries(target, state, slip)
    count, num_actions = len(cells), len(_MOVES)
    arrivals = np.zeros((count, num_actions))
    np.add.at(arrivals, (entries.state, entries.action), entries.probability * labels["goal"][entries.next_state])
    steps = np.ones((count, num_actions))
    start = kind == "S"
    with errors_of(path):
        model = model_of_entries(
            entries,
            num_states=count,
            num_actions=num_actions,
            discount=discount,
            initial=start / start.sum() if start.any() else None,
            features=np.stack([-steps, 0.0 - steps * labels["hole"][:, None], arrivals], axis=-1),
            state_names=[*map(tuple, cells.tolist())],
            action_names=[*_MOVES],
            coordinates=cells,
            labels={name: mask for name, mask in labels.items() if mask.any()},
        )
    return model.replace(domain=TileMap.from_rows(model.mdp, rows, [*_MOVES.values()]))


def _map(path: str | os.PathLike) -> np.ndarray:
    """The letters [R, C] of a file."""
    with open_text(path) as file:
        lines = [line.rstrip() for line in file]
    while lines and not lines[-1]:
        lines.pop()
    for number, line in enumerate(lines, start=1):
        require_letters(path, number, line, _LETTERS)
    if not any(lines):
        raise FileError(f"{path}: it has no map")
    width = max(map(len, lines))
    return np.array([list(line.ljust(width, "x")) for line in lines])


def _targets(is_cell: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """int [S, A]: where a move leads; the state itself where something is in the way."""
    number = np.full(np.add(is_cell.shape, 2), -1)
    number[1:-1, 1:-1][is_cell] = np.arange(len(cells))
    there = np.stack([number[tuple((cells + 1 + move).T)] for move in _MOVES.values()], axis=1)
    return np.where(there >= 0, there, np.arange(len(cells))[:, None])


def _entries(target: np.ndarray, state: np.ndarray, slip: float) -> Entries:
    """The moves from the given states: each, and those to its sides."""
    chances = [(action, action, 1.0 - slip) for action in range(len(_MOVES))]
    chances += [(action, side, slip / 2.0) for action, sides in enumerate(_SIDES) for side in sides]
    chances = [chance for chance in chances if chance[2]]
    action, way, probability = (np.array(column) for column in zip(*chances, strict=True))
    return Entries(
        np.repeat(state, len(chances)),
        np.tile(action, len(state)),
        target[state][:, way].ravel(),
        np.tile(probability, len(state)),
    )
