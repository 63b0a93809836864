"""A model whose states are the cells of a map, with actions that are moves: what a picture needs to know of it.

Gridworlds and racetracks are domains of this library and know their geometry. A model that came from elsewhere,
an environment's table say, has none; `TileMap` lays its states out on a map.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from jaxhom import checks
from jaxhom.models.mdp import MDP
from jaxhom.status import Record

if TYPE_CHECKING:
    from jaxtyping import Int


_VOID = "@"


class TileMap(Record):
    """A model on a map: its states are the cells, row by row, but for those that are none. See `TileMap.from_rows`.

    Attributes:
      mdp: the model, S states.
      rows: the map, R strings of C letters: `#` (no state to act in: a wall, a hole), `.` (open), `S` (start), `F`
        (goal), `@` (no state at all).
      moves: per action the (row, column) direction in which it is meant to lead; (0, 0) for staying.
    """

    mdp: MDP
    rows: tuple[str, ...] = dataclasses.field(metadata={"static": True})
    moves: tuple[tuple[int, int], ...] = dataclasses.field(metadata={"static": True})

    @classmethod
    def from_rows(cls, mdp: MDP, rows: Sequence[str], moves: Sequence[Sequence[int]]) -> TileMap:
        """Lays a model out.

        Raises:
          ValueError: if the map is no rectangle or has not one cell, `@` left out, per state, a letter is unknown, or
            there is not one move per action.

        Example:
          >>> corridor = MDP.from_successors([[[1]], [[1]]], [[[1.0]], [[1.0]]], discount=0.9)
          >>> TileMap.from_rows(corridor, ["SF"], [(0, 1)]).state_of((0, 1))
          1
        """
        rows = tuple(rows)
        is_rectangle = len({len(row) for row in rows}) == 1
        if not is_rectangle or sum(len(row) - row.count(_VOID) for row in rows) != mdp.num_states:
            raise ValueError(f"rows must be equally long and have {mdp.num_states} cells, one per state")
        for number, row in enumerate(rows):
            if not set(row) <= set("#.SF" + _VOID):
                raise ValueError(f"rows[{number}] must be made of #, ., S, F and {_VOID}, got {row!r}")
        directions = checks.as_host_array("moves", moves)
        checks.require_all("moves", directions, directions == np.round(directions), "must be whole")
        expected = f"({mdp.num_actions}, 2)"
        checks.require_shape("moves", directions, expected, directions.shape == (mdp.num_actions, 2))
        return cls(mdp=mdp, rows=rows, moves=tuple((int(row), int(column)) for row, column in directions))

    @property
    def coordinates(self) -> Int[np.ndarray, "S 2"]:
        """(row, column) of every state."""
        return np.argwhere(np.array([list(row) for row in self.rows]) != _VOID)

    @property
    def letters(self) -> str:
        """Those of the states' cells, one after the other."""
        return "".join(self.rows).replace(_VOID, "")

    def state_of(self, cell: Sequence[int]) -> int:
        """Returns the state of a cell (row, column).

        Raises:
          ValueError: if the cell is not on the map, or is no state.
        """
        row, column = checks.require_cell("cell", cell)
        height, width = len(self.rows), len(self.rows[0])
        if not (0 <= row < height and 0 <= column < width):
            raise ValueError(f"cell {(row, column)} is outside the {height} x {width} map")
        if self.rows[row][column] == _VOID:
            raise ValueError(f"cell {(row, column)} is no state of the model")
        before = "".join(self.rows[:row]) + self.rows[row][:column]
        return len(before) - before.count(_VOID)
