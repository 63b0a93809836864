"""Pictures of domains, policies, trajectories and occupancies, each on axes that are given or new."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import colors
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.patches import Rectangle

from jaxhom.domains.gridworld import Gridworld
from jaxhom.domains.racetrack import Racetrack
from jaxhom.domains.tile_map import TileMap
from jaxhom.models.demonstrations import Demonstrations
from jaxhom.plotting.boards import (
    BAR_ROOM,
    board_of,
    draw_arrows,
    ground,
    heat,
    policy_at,
    require,
)
from jaxhom.plotting.style import INK, OCCUPANCY_RANGE, TINT, VERMILLION

if TYPE_CHECKING:
    from jaxtyping import ArrayLike, Bool, Float

_SPREAD = 0.4  # cells from the first to the last of several trajectories that run side by side


def plot_gridworld(
    gridworld: Gridworld,
    *,
    values: Float[ArrayLike, "S"] | None = None,
    policy: Float[ArrayLike, "S A"] | None = None,
    trajectories: Demonstrations | None = None,
    visited: Bool[ArrayLike, "S"] | None = None,
    label: str = "value",
    ax: Axes | None = None,
) -> Axes:
    """Draws a gridworld and its regions, and on them what is given.

    Args:
      gridworld: the domain.
      values: [S], one amount per state, as a heat map with a colour bar.
      policy: [S, A], as arrows; see `plot_policy`.
      trajectories: drawn by `plot_trajectories`.
      visited: bool [S], states to tint, the demonstrated ones for instance.
      label: what `values` are, for the colour bar.
      ax: axes to draw on; new ones if None.

    Returns:
      The axes.

    Raises:
      ValueError: if a shape does not fit the gridworld.

    Outside jit, vmap and grad only: it draws concrete numbers.

    Example:
      >>> import jaxhom
      >>> world = jaxhom.gridworld(4, num_regions=4)
      >>> plot_gridworld(world, values=np.arange(16.0), label="number").get_xlabel()
      'column'
    """
    board = board_of(gridworld, Gridworld)
    if values is not None:
        values = require("values", values, (board.num_states,))
    return _plot_domain(board, values, label, visited, trajectories, policy, (0, 0), ax)


def plot_racetrack(
    racetrack: Racetrack,
    *,
    values: Float[ArrayLike, "C"] | Float[ArrayLike, "S"] | None = None,
    policy: Float[ArrayLike, "S A"] | None = None,
    speed: tuple[int, int] = (0, 0),
    trajectories: Demonstrations | None = None,
    visited: Bool[ArrayLike, "S"] | None = None,
    label: str = "value",
    ax: Axes | None = None,
) -> Axes:
    """Draws a racetrack (walls, road, start and finish), and on it what is given.

    Args:
      racetrack: the domain, with C cells.
      values: [C] amounts per cell, or [S] per state, of which each cell shows the largest over its
        25 speeds; as a heat map with a colour bar. Finish cells keep their chequers.
      policy: [S, A], as arrows, for cars of one speed; see `plot_policy`.
      speed: (row, column) speed of these cars, each in -2 ... 2.
      trajectories: drawn by `plot_trajectories`.
      visited: bool [S]; an open cell with a visited state is tinted.
      label: what `values` are, for the colour bar.
      ax: axes to draw on; new ones if None.

    Returns:
      The axes.

    Raises:
      ValueError: if a shape does not fit the racetrack, or there is no such speed.

    Outside jit, vmap and grad only: it draws concrete numbers.

    Example:
      >>> import jaxhom
      >>> track = jaxhom.racetrack(["XXXX", "S..F", "XXXX"])
      >>> plot_racetrack(track, values=np.arange(4.0)).get_ylabel()
      'row'
    """
    board = board_of(racetrack, Racetrack)
    if values is not None:
        values = require("values", values, (board.num_cells,), (board.num_states,))
        values = values.reshape(board.num_cells, -1).max(axis=1)
    return _plot_domain(board, values, label, visited, trajectories, policy, speed, ax)


def plot_policy(
    domain: Gridworld | Racetrack | TileMap,
    policy: Float[ArrayLike, "S A"],
    *,
    speed: tuple[int, int] = (0, 0),
    color: str = INK,
    ax: Axes | None = None,
) -> Axes:
    """Draws a policy as arrows: per state one for each action, as long as the action is probable.

    A deterministic policy has one arrow of 0.8 cells per cell, a uniform one a rose of short ones.
    The racetrack's action "nothing" is a dot; its arrows are changes of speed, not moves, and its
    finish cells, where actions have no effect, have none.

    Args:
      domain: a gridworld, a racetrack or a tile map.
      policy: [S, A], rows sum to 1.
      speed: racetrack only: the speed of the cars whose actions are drawn, standing ones if not
        given.
      color: of the arrows.
      ax: axes to draw on, as an overlay; new ones with the domain on them if None.

    Returns:
      The axes.

    Raises:
      ValueError: if a shape does not fit the domain, or there is no such speed.

    Outside jit, vmap and grad only: it draws concrete numbers.

    Example:
      >>> import jaxhom
      >>> world = jaxhom.gridworld(4)
      >>> ax = plot_policy(world, np.full((16, 4), 0.25))
      >>> ax.figure.savefig("/dev/null", format="png")
    """
    board = board_of(domain)
    policy = policy_at(board, policy, speed)
    ax = ground(board, ax) if ax is None else ax
    draw_arrows(ax, board, policy, color)
    return ax


def plot_trajectories(
    domain: Gridworld | Racetrack | TileMap,
    trajectories: Demonstrations,
    *,
    color: str = VERMILLION,
    label: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draws trajectories as lines with a dot per step and a ring in every cell where one begins.

    Several trajectories run side by side: from its ring on, each has an offset of its own from the
    centres of the cells. Answers about single states are rings alone.
    On a racetrack a line is cut where the car is put back from the finish to the start.

    Args:
      domain: a gridworld, a racetrack or a tile map.
      trajectories: M trajectories of its model.
      color: of all of them.
      label: their name in a legend.
      ax: axes to draw on, as an overlay; new ones with the domain on them if None.

    Returns:
      The axes.

    Raises:
      ValueError: if a state does not exist in the domain.

    Outside jit, vmap and grad only: it draws concrete numbers.

    Example:
      >>> import jaxhom
      >>> walk = jaxhom.Demonstrations.from_trajectories([([0, 1, 5], [3, 1, 1])])
      >>> len(plot_trajectories(jaxhom.gridworld(4), walk).lines)
      1
    """
    board = board_of(domain)
    trajectories.validate(board.mdp, "ignore")
    ax = ground(board, ax) if ax is None else ax
    walks = ~np.asarray(trajectories.is_answer)
    num = walks.sum()
    offset = _SPREAD * (np.cumsum(walks) - (num + 1) / 2) / max(num - 1, 1)
    width = 1.6 if num <= 1 else 1.0
    style: dict[str, Any] = {"color": color, "linewidth": width, "marker": "o", "markersize": 1.0 + 1.6 * width}
    paths = [states // board.per_cell for states in unpadded(trajectories)]
    for m, path in enumerate(paths):
        ends = np.flatnonzero(~board.is_open[path]) + 1
        points = board.cells[path] + offset[m]
        points[0] = board.cells[path[0]]
        y, x = np.insert(points, ends, np.nan, axis=0).T
        ax.plot(x, y, label=None if m else label, alpha=0.9, zorder=3, **style)
    y, x = board.cells[np.unique(np.array([path[0] for path in paths], int))].T
    ax.scatter(x, y, s=50, facecolor="white", edgecolor=color, linewidth=1.6, zorder=3.5)
    return ax


def plot_occupancy(
    domain: Gridworld | Racetrack | TileMap,
    occupancy: Float[ArrayLike, "S *A"],
    *,
    label: str = "expected discounted visits",
    ax: Axes | None = None,
) -> Axes:
    """Draws how often each cell is visited, as a heat map with a logarithmic colour bar.

    Args:
      domain: a gridworld, a racetrack or a tile map.
      occupancy: [S, A] or [S], not negative: an occupancy measure, or counts. It is summed over
        actions, and over speeds on a racetrack. Cells below 1 / 10000 of the largest stay white;
        finish cells keep their chequers.
      label: of the colour bar.
      ax: axes to draw on; new ones if None.

    Returns:
      The axes.

    Raises:
      ValueError: if the shape does not fit the domain, or no open cell is visited.

    Outside jit, vmap and grad only: it draws concrete numbers.

    Example:
      >>> import jaxhom
      >>> world = jaxhom.gridworld(4)
      >>> visits = jaxhom.occupancy(world, np.full((16, 4), 0.25))
      >>> plot_occupancy(world, visits).get_ylabel()
      'row'
    """
    board = board_of(domain)
    shape = (board.num_states,)
    occupancy = require("occupancy", occupancy, shape, (*shape, len(board.moves)))
    visits = occupancy.reshape(board.num_cells, -1).sum(axis=1)
    largest = visits[board.is_open].max()
    if not largest > 0:
        raise ValueError(f"occupancy must be positive in some open cell, its largest is {largest}")
    least = largest / OCCUPANCY_RANGE
    scale = colors.LogNorm(vmin=least, vmax=largest)
    ax = ground(board, ax, BAR_ROOM)
    heat(ax, board, np.where(visits < least, np.nan, visits), label, norm=scale)
    return ax


def _plot_domain(board, values, label, visited, trajectories, policy, speed, ax) -> Axes:
    """Draws a domain, and on it what is given; checks everything before it draws anything."""
    if visited is not None:
        visited = require("visited", visited, (board.num_states,)) > 0
    if trajectories is not None:
        trajectories.validate(board.mdp, "ignore")
    if policy is not None:
        policy = policy_at(board, policy, speed)
    ax = ground(board, ax, BAR_ROOM * (values is not None))
    if values is not None:
        heat(ax, board, values, label)
    if visited is not None:
        cells = board.cells[visited.reshape(board.num_cells, -1).any(axis=1) & board.is_open]
        tint = [Rectangle((x - 0.4, y - 0.4), 0.8, 0.8) for y, x in cells]
        ax.add_collection(PatchCollection(tint, facecolor=TINT, linewidth=0, zorder=1.5))
    if trajectories is not None:
        plot_trajectories(board.domain, trajectories, ax=ax)
    if policy is not None:
        draw_arrows(ax, board, policy, INK)
    return ax


def unpadded(trajectories: Demonstrations) -> list[np.ndarray]:
    """The states of each trajectory."""
    mask = np.asarray(trajectories.mask)
    return [states[kept] for states, kept in zip(np.asarray(trajectories.states), mask, strict=True)]
