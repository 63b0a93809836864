"""The racetrack of Boularias and Chaib-draa (2010), section VI.B.

A car's state is its cell and its speed (row and column speed, each in -2 ... 2). It may leave its
speed alone or change one of the two by one. The change succeeds with probability 0.9 where the
*present* speed of that axis is at most 1 in size, with probability 0.5 where it is 2, and otherwise
the speed stays; a change beyond 2 leaves the speed as it is. A move that would leave the road keeps
the cell and resets the speed to zero. Reward: 5 for a step that stays on the road, 0 for an
off-road, 200 (not 205) for the step that reaches the finish line: two features, "on the road" and
"finish".

The paper leaves open what follows. Each choice was held against three figures that an earlier
implementation gave for track (a): 113 classes of local models at d = 1 up to renaming of states, an
expert that takes about 21 steps a lap at about 14 reward a step, and the share of states that
Algorithm 1 matches after 2 demonstrations (77%; 22% if the match must hold in both directions).

* The speed changes first, and the car moves by the new speed. (Moving by the old one: 50-65
  classes.)
* The whole way counts, not only where it ends: a move with a component of 2 also passes the cell
  half-way, rounded towards the starting cell. A wall there is an off-road, and a car that meets a
  finish cell there has finished and stays in that cell, with the speed it came with, even if it
  would have overshot. (Judged by the last cell alone: 99 classes. Finishing only by landing: 101.
  Other roundings, every cell that the line touches, one axis after the other: 93-110. Speed zero at
  the finish: 137. As chosen: 113, with 82% and 24% of the states matched.)
* A car in a finish cell is put back to `initial` at the next step, whatever the action; that step
  earns nothing, so returns up to the finish do not depend on whether it is counted. It makes the
  expert's lap 20.9 steps at 14.0 a step; without it, taken literally, finishing at all would be a
  mistake: 5 a step for ever is worth 500.

States are numbered cell by cell: state = 25 * cell + speed.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np

from jaxhom import checks
from jaxhom.domains.track_maps import read_map
from jaxhom.models.mdp import MDP
from jaxhom.status import Record

if TYPE_CHECKING:
    from jax.typing import DTypeLike
    from jaxtyping import Array, Bool, Float, Int

ACTIONS = ("nothing", "up", "down", "left", "right")
SHIPPED_STARTS = {"a": ((7, 0),), "b": None}
"""Default `start` of the shipped tracks: one place of the start line on (a), anywhere on (b)."""

_ACCELERATIONS = np.array([(0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)])
_SPEEDS = np.stack(np.divmod(np.arange(25), 5), axis=-1) - 2
_STANDING = 12  # index of speed (0, 0)
_SUCCESS = (0.9, 0.5)  # of a change of speed at low or zero and at high speed: the paper's
_WEIGHTS = (5.0, 200.0)  # the paper's rewards of a step on the road and of the finish
_ON_ROAD, _FINISH, _OFF_ROAD = range(3)


class Racetrack(Record):
    """A racetrack and its geometry: C open cells, S = 25 C states, A = 5. See `racetrack`.

    Attributes:
      mdp: the model; actions in the order of `ACTIONS`; features [S, A, 2] are the probabilities
        that the step stays on the road, and that it reaches the finish line; both are 0 in a finish
        cell.
      weights: float [2], (5, 200): the reward [S, A] is `mdp.features @ weights`.
      cells: int32 [C, 2], (row, column) of the open cells, row by row from the top.
      speeds: int32 [25, 2], (row, column) speed in cells per step; downwards and to the right is
        positive.
      coordinates: int32 [S, 2], (row, column) of every state.
      terminal: bool [S], whether the state's cell is on the finish line.
      off_road: float [S, A], probability that the step ends in an off-road. Outside the finish
        cells it adds up with the two features to 1.
      rows: the map, one string of `#` (wall), `.` (road), `S` (start) and `F` (finish) per row, of
        equal length.
    """

    mdp: MDP
    weights: Float[Array, " 2"]
    cells: Int[Array, "C 2"]
    speeds: Int[Array, "25 2"]
    coordinates: Int[Array, "S 2"]
    terminal: Bool[Array, " S"]
    off_road: Float[Array, "S A"]
    rows: tuple[str, ...] = dataclasses.field(metadata={"static": True})

    def state_of(self, cell: Sequence[int], speed: Sequence[int] = (0, 0)) -> int:
        """Returns the state of a car in `cell` (row, column) with `speed` (row, column speed).

        Raises:
          ValueError: if the cell is not open or a speed is not in -2 ... 2.
        """
        index = _cell_index(self.rows, cell, "cell")
        row_speed, column_speed = speed
        if not {row_speed, column_speed} <= set(range(-2, 3)):
            raise ValueError(f"speed must be two of -2, -1, 0, 1, 2, got {tuple(speed)}")
        return 25 * index + 5 * (int(row_speed) + 2) + int(column_speed) + 2


def racetrack(
    track: str | os.PathLike | Iterable[str] = "a",
    *,
    discount: float = 0.99,
    start: Iterable[Sequence[int]] | None = None,
    dtype: DTypeLike | None = None,
) -> Racetrack:
    """Builds the racetrack of section VI.B. On the host: not under `jit`, `vmap` or `grad`.

    A map has one letter per cell: `X`, `#` or `o` wall, space, `.` or `P` road, `S` road on the
    start line, `F` or `G` finish line, in either case, and `@` where the map ends; beyond it is
    wall. A header with the map's size, as `.track` files of planning benchmarks have it, is
    understood (see `track_maps`); without one, short rows are filled up with wall.

    Args:
      track: "a" (236 cells) or "b" (204 cells, drawn for this library: the paper's map is not
        known); or the path of a map; or a map, as text with line breaks or as lines.
      discount: scalar, strictly between 0 and 1.
      start: cells (row, column), row 0 on top, one of which the car starts in, each with equal
        probability and at zero speed. None: the paper's for "a", which is ((7, 0),), and "b", which
        is every road cell; for other maps the `S` cells, or every road cell if there are none.
      dtype: floating-point type of the model; JAX's default if None (float64 needs
        `jax_enable_x64`).

    Returns:
      The racetrack.

    Raises:
      ValueError: on an unknown letter (naming its line and column, counted from 1), on a header that
        is malformed or disagrees with the map, on a map without road or without finish line, and on
        a start cell that is missing from the road or repeated.
      FileNotFoundError: if `track` is text without line breaks, and neither a shipped track nor a
        file.

    Example:
      >>> track = racetrack(["XXXX", "S..F", "XXXX"])
      >>> track.mdp.num_states, track.state_of((1, 0))
      (100, 12)

    Source: Boularias and Chaib-draa 2010, section VI.B.
    """
    checks.require_float_type("dtype", dtype)
    if start is None and isinstance(track, str):
        start = SHIPPED_STARTS.get(track)
    rows = read_map(track)
    grid = np.array([list(row) for row in rows])
    cells = np.argwhere(grid != "#")
    terminal = np.repeat(grid[tuple(cells.T)] == "F", 25)
    restart = np.array(_start_cells(rows, grid, start)) * 25 + _STANDING
    checks.require_slots(len(terminal), len(ACTIONS), max(2, len(restart)))
    next_state, probability, events = _transition(grid, cells)  # [S, A, 2], [S, A, 2], [S, A, 3]
    events[terminal] = 0.0
    next_state, probability = _with_restart(next_state, probability, terminal, restart)
    initial = np.zeros(len(terminal))
    initial[restart] = 1.0 / len(restart)
    mdp = MDP.from_successors(
        next_state,
        np.asarray(probability, dtype),
        discount=discount,
        initial=initial,
        features=events[..., [_ON_ROAD, _FINISH]],
    )
    return Racetrack(
        mdp=mdp,
        weights=checks.to_device(_WEIGHTS, mdp.dtype),
        cells=checks.to_device(cells, jnp.int32),
        speeds=checks.to_device(_SPEEDS, jnp.int32),
        coordinates=checks.to_device(np.repeat(cells, 25, axis=0), jnp.int32),
        terminal=checks.to_device(terminal),
        off_road=checks.to_device(events[..., _OFF_ROAD], mdp.dtype),
        rows=rows,
    )


def _transition(grid, cells) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two successors per state and action (speed changed, unchanged) and the events' chances.

    Returns next_state and probability, [S, A, 2], and events [S, A, 3].
    """
    landing, event = _moves(grid, cells)  # [C, 25]
    # A change beyond the highest speed is cut off, which leaves the speed as it is.
    changed = np.clip(_SPEEDS[:, None] + _ACCELERATIONS, -2, 2) @ np.array([5, 1]) + _STANDING
    unchanged = np.broadcast_to(np.arange(25)[:, None], changed.shape)
    after = np.stack([changed, unchanged], axis=-1)  # [25, A, 2]
    is_high = np.abs(_SPEEDS) @ np.abs(_ACCELERATIONS.T) == 2
    success = np.where(is_high, _SUCCESS[1], _SUCCESS[0])
    success[:, 0] = 1.0
    chance = np.stack([success, 1.0 - success], axis=-1)  # [25, A, 2]
    happened = event[:, after][..., None] == np.arange(3)  # [C, 25, A, 2, 3]
    events = np.sum(chance[..., None] * happened, axis=-2)
    shape = (25 * len(cells), len(ACTIONS), 2)
    probability = np.broadcast_to(chance, (len(cells), *chance.shape)).reshape(shape)
    return landing[:, after].reshape(shape), probability, events.reshape(*shape[:2], 3)


def _moves(grid, cells) -> tuple[np.ndarray, np.ndarray]:
    """The state that a move by each speed from each cell leads to, and its event: [C, 25]."""
    padded = np.pad(grid, 2, constant_values="#")  # a move ends at most 2 cells beyond the map
    number = np.zeros(padded.shape, np.int64)
    number[padded != "#"] = np.arange(len(cells))
    # The cell half-way, rounded towards the start; a move by a single cell has none of its own.
    is_fast = np.abs(_SPEEDS).max(axis=-1, keepdims=True) == 2
    passed = np.where(is_fast, np.trunc(_SPEEDS / 2).astype(int), _SPEEDS)
    first, last = (tuple(np.moveaxis(cells[:, None] + 2 + way, -1, 0)) for way in (passed, _SPEEDS))
    speed = np.arange(25)
    here = np.arange(len(cells))[:, None]
    ends = [  # the first that applies decides
        (padded[first] == "F", 25 * number[first] + speed, _FINISH),
        (padded[first] == "#", 25 * here + _STANDING, _OFF_ROAD),
        (padded[last] == "F", 25 * number[last] + speed, _FINISH),
        (padded[last] == "#", 25 * here + _STANDING, _OFF_ROAD),
    ]
    conditions = [end[0] for end in ends]
    landing = np.select(conditions, [end[1] for end in ends], 25 * number[last] + speed)
    return landing, np.select(conditions, [end[2] for end in ends], _ON_ROAD)


def _with_restart(next_state, probability, terminal, restart) -> tuple[np.ndarray, np.ndarray]:
    """Sends terminal states to the restart states at the next step; may widen the rows."""
    width = max(next_state.shape[-1], len(restart))
    padding = [(0, 0), (0, 0), (0, width - next_state.shape[-1])]
    next_state, probability = np.pad(next_state, padding), np.pad(probability, padding)
    next_state[terminal], probability[terminal] = 0, 0.0
    next_state[terminal, :, : len(restart)] = restart
    probability[terminal, :, : len(restart)] = 1.0 / len(restart)
    return next_state, probability


def _start_cells(rows, grid, start) -> list[int]:
    """Indices of the cells that the car starts in."""
    letters = grid[grid != "#"]
    if start is None:
        letter = "S" if "S" in letters else "."
        return np.flatnonzero(letters == letter).tolist()
    indices = [_cell_index(rows, cell, "start cell") for cell in start]
    if not indices:
        raise ValueError("start must name at least one cell")
    for position, index in enumerate(indices):
        if letters[index] == "F":
            raise ValueError(f"start[{position}] is on the finish line")
        if index in indices[:position]:
            raise ValueError(f"start[{position}] repeats an earlier cell")
    return indices


def _cell_index(rows: tuple[str, ...], cell: Sequence[int], name: str) -> int:
    """The number of an open cell among the open cells, or raises."""
    row, column = checks.require_cell(name, cell)
    inside = 0 <= row < len(rows) and 0 <= column < len(rows[0])
    if not inside or rows[row][column] == "#":
        where = "a wall" if inside else f"outside the {len(rows)} x {len(rows[0])} map"
        raise ValueError(f"{name} {(row, column)} is {where}")
    before = "".join(rows[:row]) + rows[row][:column]
    return len(before) - before.count("#")
