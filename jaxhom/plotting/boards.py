"""Grids and tracks on axes: where cells are, the empty domain, images of its states, arrows.

A `Board` is what a picture needs of a domain. A racetrack's state is a cell and one of 25 speeds: what has one number
per state is drawn as a mosaic of the 25 speeds, or as one number per cell.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib import colors
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.ticker import MaxNLocator

from jaxhom import checks
from jaxhom.domains.gridworld import ACTIONS as GRIDWORLD_ACTIONS
from jaxhom.domains.gridworld import Gridworld
from jaxhom.domains.racetrack import ACTIONS as RACETRACK_ACTIONS
from jaxhom.domains.racetrack import Racetrack
from jaxhom.domains.tile_map import TileMap
from jaxhom.models.mdp import MDP
from jaxhom.plotting.style import AMOUNT, FAINT, INK, ROAD, START, WALL

if TYPE_CHECKING:
    from jaxtyping import ArrayLike, Float

BAR_ROOM, LEVEL_ROOM = 1.2, 2.0  # inches beside the map, for a colour bar with numbers and one with names

_LEAST_HEIGHT = 2.6  # inches, beside which the label of a colour bar finds room
_CHECKER = 4  # chequers along the side of a finish cell
_LEAST_PROBABILITY = 0.02  # of an action that gets an arrow


@dataclasses.dataclass(frozen=True, eq=False)
class Board:
    """What a picture needs of a domain, in NumPy: C cells, numbered as their states are.

    Attributes:
      domain: the gridworld, racetrack or tile map.
      shape: rows and columns of the map.
      cells: int [C, 2], (row, column).
      is_open: bool [C], False where no action is taken: on the finish line, in walls.
      per_cell: states per cell, 1 or 25.
      moves: int [A, 2], the (row, column) direction of each action.
    """

    domain: Gridworld | Racetrack | TileMap
    shape: tuple[int, int]
    cells: np.ndarray
    is_open: np.ndarray
    per_cell: int
    moves: np.ndarray

    @property
    def mdp(self) -> MDP:
        return self.domain.mdp

    @property
    def num_cells(self) -> int:
        return len(self.cells)

    @property
    def num_states(self) -> int:
        return self.num_cells * self.per_cell

    def states_at(self, speed) -> np.ndarray:
        """The state of each cell, [C]; with the given speed on a racetrack."""
        states = np.arange(self.num_cells) * self.per_cell
        if not isinstance(self.domain, Racetrack):
            return states
        return states + self.domain.state_of(self.cells[0], speed)

    def side(self, values: np.ndarray) -> int:
        """Pixels along the side of a cell: 1 for values per cell [C], 5 for values per state [S] of a track."""
        return round((len(values) / self.num_cells) ** 0.5)

    def centres(self, values: np.ndarray) -> np.ndarray:
        """Where the pixels of [C] or [S] values are, (x, y) [C, 2] or [S, 2]."""
        side = self.side(values)
        shift = (np.stack(np.divmod(np.arange(side**2), side), axis=1) - (side - 1) / 2) / side
        return (self.cells[:, None] + shift).reshape(-1, 2)[:, ::-1]

    def image(self, values: np.ndarray, fill=np.nan) -> np.ndarray:
        """[C] or [S] -> one pixel per cell, or a square of pixels per cell; `fill` off the map."""
        side = self.side(values)
        dtype = np.result_type(values, fill)
        tiles = np.full((*self.shape, side, side), fill, dtype)
        tiles[tuple(self.cells.T)] = values.reshape(self.num_cells, side, side)
        return tiles.swapaxes(1, 2).reshape(self.shape[0] * side, self.shape[1] * side)


def board_of(domain: Gridworld | Racetrack | TileMap, kind: Any = (Gridworld, Racetrack, TileMap)) -> Board:
    """The board of a domain; `ValueError` unless the domain is of the given kind or one of the given kinds."""
    if not isinstance(domain, kind):
        kinds = kind if isinstance(kind, tuple) else (kind,)
        names = " or ".join(f"a {kind.__name__}" for kind in kinds)
        raise ValueError(f"the domain must be {names}, got {type(domain).__name__}")
    if isinstance(domain, TileMap):
        shape = (len(domain.rows), len(domain.rows[0]))
        is_open = np.array([letter in ".S" for letter in domain.letters])
        return Board(domain, shape, domain.coordinates, is_open, 1, np.array(domain.moves))
    directions = {"up": (-1, 0), "down": (1, 0), "left": (0, -1), "right": (0, 1)}
    if isinstance(domain, Gridworld):
        actions: tuple[str, ...] = GRIDWORLD_ACTIONS
        cells, per_cell = np.asarray(domain.coordinates), 1
        shape, is_open = (domain.size, domain.size), np.ones(len(cells), bool)
    else:
        actions, cells, per_cell = RACETRACK_ACTIONS, np.asarray(domain.cells), len(domain.speeds)
        shape = (len(domain.rows), len(domain.rows[0]))
        is_open = ~np.asarray(domain.terminal)[::per_cell]
    moves = np.array([directions.get(action, (0, 0)) for action in actions])
    return Board(domain, shape, cells, is_open, per_cell, moves)


def require(name: str, array: ArrayLike, *shapes: tuple[int, ...]) -> np.ndarray:
    """Returns `array` as finite floats of one of the given shapes, or raises."""
    array = checks.as_host_array(name, array)
    checks.require_shape(name, array, " or ".join(map(str, shapes)), array.shape in shapes)
    return checks.require_floats(name, array)


def ground(board: Board, ax: Axes | None, room: float = 0.0) -> Axes:
    """Draws the empty domain: the regions of a gridworld; walls, start and finish of a track.

    New axes get `room` inches to their right, for a colour bar.
    """
    rows, columns = board.shape
    if ax is None:
        scale = min(9.0 / columns, 5.5 / rows, 0.6)
        size = (columns * scale + 0.8 + room, max(rows * scale + 0.8, _LEAST_HEIGHT if room else 0.0))
        _, ax = plt.subplots(figsize=size, layout="constrained")
    if isinstance(board.domain, Gridworld):
        borders = borders_of(board, np.asarray(board.domain.region))
        color, width, margin = FAINT, 0.7, 0.5
    else:
        ax.set_facecolor(WALL)
        ax.imshow(_track_image(board.domain.rows), extent=_extent(board), zorder=0)
        borders = borders_of(board, np.ones(board.num_cells, int))
        color, width, margin = INK, 1.2, 0.9
        ax.spines[:].set_visible(False)
    ax.add_collection(LineCollection(list(borders), colors=color, linewidths=width, zorder=2))
    ax.set(xlim=(-margin, columns - 1 + margin), ylim=(rows - 1 + margin, -margin), aspect="equal")
    ax.set(xlabel="column", ylabel="row")
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(MaxNLocator(8, integer=True, steps=[1, 2, 4, 5, 10]))
    return ax


def _track_image(rows: tuple[str, ...]) -> np.ndarray:
    """RGB image of a track's cells, `_CHECKER` pixels along the side of each."""
    tone = {"#": WALL, "@": WALL, ".": ROAD, "S": START, "F": ROAD}
    letters = np.array([list(row) for row in rows])
    image = np.array([[colors.to_rgb(tone[letter]) for letter in row] for row in letters])
    image = image.repeat(_CHECKER, axis=0).repeat(_CHECKER, axis=1)
    finish = (letters == "F").repeat(_CHECKER, axis=0).repeat(_CHECKER, axis=1)
    is_dark = np.indices(finish.shape).sum(axis=0) % 2 == 1
    image[finish & is_dark] = colors.to_rgb(INK)
    return image


def _extent(board: Board) -> tuple[float, float, float, float]:
    """Where an image of the whole map goes: cell (r, c) has its centre at (x, y) = (c, r)."""
    rows, columns = board.shape
    return -0.5, columns - 0.5, rows - 0.5, -0.5


def borders_of(board: Board, labels: np.ndarray) -> np.ndarray:
    """Segments [N, 2, (x, y)] between cells that differ in `labels`, [C], and round the map."""
    labels = np.pad(board.image(labels, fill=-1), 1, constant_values=-1)
    row, column = np.nonzero(labels[:, 1:] != labels[:, :-1])
    upright = [(column - 0.5, row - 1.5), (column - 0.5, row - 0.5)]
    row, column = np.nonzero(labels[1:] != labels[:-1])
    level = [(column - 1.5, row - 0.5), (column - 0.5, row - 0.5)]
    return np.concatenate([np.transpose(ends, (2, 0, 1)) for ends in (upright, level)])


def show(ax: Axes, board: Board, values: np.ndarray, **style):
    """Draws [C] or [S] values as an image; leaves finish cells and NaN as they are."""
    is_open = board.is_open.repeat(len(values) // board.num_cells)
    image = np.ma.masked_invalid(board.image(np.where(is_open, values, np.nan)))
    return ax.imshow(image, extent=_extent(board), interpolation="nearest", zorder=1, **style)


def colorbar(ax: Axes, board: Board, image, label: str, **style):
    """A colour bar as high as the map and as wide as fits it."""
    rows, columns = board.shape
    width = 0.04 * max(rows, 16) / max(columns, 16)
    place = ax.inset_axes((1.0 + width / 2, 0.0, width, 1.0))
    bar = ax.figure.colorbar(image, cax=place, label=label, **style)
    bar.outline.set_visible(False)
    return bar


def heat(ax: Axes, board: Board, values: np.ndarray, label: str, norm=None) -> None:
    """A heat map of amounts per cell, with its colour bar."""
    image = show(ax, board, values, cmap=AMOUNT, norm=norm)
    colorbar(ax, board, image, label)


def policy_at(board: Board, policy: Float[ArrayLike, "S A"], speed: tuple[int, int]) -> np.ndarray:
    """[S, A] -> the probabilities to draw, [C, A]: of one speed, of open cells, not negligible."""
    shape = (board.num_states, len(board.moves))
    shown = require("policy", policy, shape)[board.states_at(speed)]
    return np.where(board.is_open[:, None] & (shown >= _LEAST_PROBABILITY), shown, 0.0)


def draw_arrows(ax: Axes, board: Board, policy: np.ndarray, color: str) -> None:
    """Draws probabilities [C, A] as arrows, and as dots where the action is not to move."""
    arrow = 0.8 * policy[..., None] * board.moves  # [C, A, (row, column)]
    # Half the mean move behind the centre: one arrow alone is centred in its cell, a rose as well.
    tail = board.cells[:, None] - 0.5 * arrow.sum(axis=1, keepdims=True)
    shown = arrow.any(axis=-1)
    tail = np.broadcast_to(tail, arrow.shape)[shown]
    y, x, dy, dx = np.concatenate([tail, arrow[shown]], axis=-1).T
    style: dict[str, Any] = {"width": 0.075, "headwidth": 3.6, "headlength": 3.2, "headaxislength": 2.9}
    placed: dict[str, Any] = {"angles": "xy", "units": "xy", "scale_units": "xy", "scale": 1.0}
    ax.quiver(x, y, dx, dy, color=color, zorder=4, **placed, **style)
    cell, action = np.nonzero((policy > 0) & ~board.moves.any(axis=-1))
    if cell.size:
        size = 0.3 * np.sqrt(policy[cell, action])
        placed = {"offsets": board.cells[cell, ::-1], "offset_transform": ax.transData}
        dots = EllipseCollection(size, size, 0.0, units="xy", color=color, zorder=4, **placed)
        ax.add_collection(dots, autolim=False)
