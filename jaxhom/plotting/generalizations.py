"""Pictures of what a generalization did: how far it looked, how many demonstrated states voted, what came of it.

Two kinds of state have a colour and a sign of their own, so that neither depends on the other: a dot on demonstrated
states, a cross where nothing was found. All others run through cividis, from bright (near, few) to dark (far, many).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import matplotlib.pyplot as plt
import numpy as np
from matplotlib import colors
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import EllipseCollection, LineCollection

from jaxhom import checks
from jaxhom.domains.gridworld import Gridworld
from jaxhom.domains.racetrack import ACTIONS as RACETRACK_ACTIONS
from jaxhom.domains.racetrack import Racetrack
from jaxhom.domains.tile_map import TileMap
from jaxhom.generalization.result import Generalization
from jaxhom.plotting.boards import (
    LEVEL_ROOM,
    Board,
    board_of,
    borders_of,
    colorbar,
    draw_arrows,
    ground,
    heat,
    policy_at,
    require,
    show,
)
from jaxhom.plotting.style import BLUE, FAINT, GREEN, INK, ORANGE, PURPLE, SIGNS, SKY, VERMILLION, YELLOW

if TYPE_CHECKING:
    from jaxtyping import ArrayLike, Bool, Int

_TONES = 250  # of levels: where there are more, neighbours share one
_NOTHING, _DEMONSTRATED = -1, 0
_MIXED = 0  # no action has more than half of the probability
_ARROWS = {"up": "\N{UPWARDS ARROW}", "down": "\N{DOWNWARDS ARROW}", "left": "\N{LEFTWARDS ARROW}"}
_ARROWS["right"] = "\N{RIGHTWARDS ARROW}"
_WIDE = 1.6  # columns per row of a map from which on panels go below each other


def plot_radius(
    domain: Gridworld | Racetrack | TileMap,
    radius: Int[ArrayLike, "S"],
    *,
    speed: tuple[int, int] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Colours states by the radius at which Algorithm 1 stopped: how far the expert's advice came.

    On a racetrack every cell shows the state of one speed, or is a mosaic of its 25 states: row speed -2 ... 2 from
    top to bottom, column speed -2 ... 2 from left to right.

    Args:
      domain: a gridworld, a racetrack or a tile map.
      radius: int [S], `Generalization.radius`: 0 on demonstrated states, -1 where nothing was found; these two have
        colours and signs of their own, the others a scale.
      speed: racetrack only: the speed of the cars whose states are shown; the mosaic if None.
      ax: axes to draw on; new ones if None.

    Returns:
      The axes.

    Raises:
      ValueError: if the shape does not fit the domain, an entry is below -1 or not whole, or there is no such speed.

    Outside jit, vmap and grad only: it draws concrete numbers.

    Example:
      >>> import jaxhom
      >>> world = jaxhom.gridworld(4)
      >>> walk = jaxhom.Demonstrations.from_trajectories([([0, 1, 2], [3, 3, 3])])
      >>> general = jaxhom.nearest_neighbors(world, walk)
      >>> ax = plot_radius(world, general.radius)
    """
    board = board_of(domain)
    radius = require("radius", radius, (board.num_states,))
    whole = (radius == np.floor(radius)) & (radius >= -1)
    checks.require_all("radius", radius, whole, "must be whole and at least -1")
    levels = _at_speed(board, radius, speed)
    return _draw_levels(ground(board, ax, LEVEL_ROOM), board, levels, ("step away", "steps"))


def plot_support(
    domain: Gridworld | Racetrack | TileMap,
    support: Int[ArrayLike, "S"],
    *,
    visited: Bool[ArrayLike, "S"] | None = None,
    speed: tuple[int, int] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Colours states by how many demonstrated states their policy came from.

    Args:
      domain: a gridworld, a racetrack or a tile map.
      support: int [S], `Generalization.support`: 0 where nothing was found, which has a colour and a sign of its own.
      visited: bool [S], demonstrated states, to be told from those with one voter.
      speed: as in `plot_radius`.
      ax: axes to draw on; new ones if None.

    Returns:
      The axes.

    Raises:
      ValueError: if a shape does not fit the domain, an entry is negative or not whole, or there is no such speed.

    Outside jit, vmap and grad only: it draws concrete numbers.

    Example:
      >>> import jaxhom
      >>> world = jaxhom.gridworld(4)
      >>> walk = jaxhom.Demonstrations.from_trajectories([([0, 1, 2], [3, 3, 3])])
      >>> general = jaxhom.nearest_neighbors(world, walk)
      >>> ax = plot_support(world, general.support, visited=general.visited)
    """
    board = board_of(domain)
    support = require("support", support, (board.num_states,))
    whole = (support == np.floor(support)) & (support >= 0)
    checks.require_all("support", support, whole, "must be whole and not negative")
    levels = np.where(support == 0, _NOTHING, support)
    if visited is not None:
        levels = np.where(require("visited", visited, (board.num_states,)) > 0, _DEMONSTRATED, levels)
    levels = _at_speed(board, levels, speed)
    return _draw_levels(ground(board, ax, LEVEL_ROOM), board, levels, ("voter", "voters"))


def plot_generalization(
    domain: Gridworld | Racetrack | TileMap,
    general: Generalization,
    *,
    speed: tuple[int, int] | None = (0, 0),
    ax: Sequence[Axes] | np.ndarray | None = None,
) -> np.ndarray:
    """Draws a generalization in three panels: how far it looked, how many states voted, and the policy.

    The policy is drawn as arrows (see `plot_policy`) on the probability of the likeliest action: white where all are
    equally likely, dark where one is certain.

    On a racetrack the panels show the cars of one speed. With `speed=None` they show all: radius and support as
    mosaics of the 25 speeds of a cell (see `plot_radius`), and as the policy a mosaic of the actions with more than
    half of the probability.

    Args:
      domain: a gridworld, a racetrack or a tile map.
      general: a `Generalization` on its model.
      speed: racetrack only: (row, column) speed, each in -2 ... 2, or None.
      ax: three axes to draw on; a new figure if None.

    Returns:
      The three axes, [3].

    Raises:
      ValueError: if a shape does not fit the domain, there is no such speed, or `ax` is not three axes.

    Outside jit, vmap and grad only: it draws concrete numbers.

    Example:
      >>> import jaxhom
      >>> world = jaxhom.gridworld(4)
      >>> walk = jaxhom.Demonstrations.from_trajectories([([0, 1, 2], [3, 3, 3])])
      >>> general = jaxhom.nearest_neighbors(world, walk)
      >>> print(*(panel.get_title(loc="left") for panel in plot_generalization(world, general)))
      radius support policy
    """
    if not all(hasattr(general, name) for name in ("policy", "visited", "radius", "support")):
        raise ValueError(f"general must be a jaxhom.Generalization, got {type(general).__name__}")
    board = board_of(domain)
    mosaic = speed is None and board.per_cell > 1
    policy = require("policy", general.policy, (board.num_states, len(board.moves)))
    policy = policy if mosaic else policy_at(board, policy, speed or (0, 0))
    if ax is None:
        ax = _three_panels(board)
    panels = np.asarray(ax, dtype=object).ravel()
    checks.require_shape("ax", panels, "(3,), three axes", panels.shape == (3,))
    shown = speed if board.per_cell > 1 else None
    plot_radius(domain, general.radius, speed=shown, ax=panels[0])
    plot_support(domain, general.support, visited=general.visited, speed=shown, ax=panels[1])
    if mosaic:
        _draw_actions(ground(board, panels[2]), board, policy, np.asarray(general.radius))
    else:
        _draw_policy(ground(board, panels[2]), board, policy)
    whose = "" if board.per_cell == 1 else ", all speeds" if shown is None else f", speed ({shown[0]}, {shown[1]})"
    for panel, title in zip(panels, ("radius", "support", "policy"), strict=True):
        panel.set_title(f"{title}{whose}", loc="left", fontsize="medium")
    return panels


def _at_speed(board: Board, values: np.ndarray, speed) -> np.ndarray:
    """[S] -> [C] for one speed; as it is for the mosaic."""
    return values if speed is None or board.per_cell == 1 else values[board.states_at(speed)]


def _draw_levels(ax: Axes, board: Board, levels: np.ndarray, units: tuple[str, str]) -> Axes:
    """Colours [C] or [S] by level: -1 nothing found, 0 demonstrated, 1, 2, ... on a scale of their own."""
    largest = max(int(levels.max()), 1)
    tones = plt.get_cmap("cividis_r")(np.linspace(0.0, 1.0, min(largest, _TONES)))
    palette = colors.ListedColormap([colors.to_rgba(PURPLE), colors.to_rgba(VERMILLION), *tones])
    bounds = np.append([-1.5, -0.5], np.linspace(0.5, largest + 0.5, len(tones) + 1))
    show(ax, board, levels, cmap=palette, norm=colors.BoundaryNorm(bounds, palette.N))
    _level_bar(ax, board, palette, largest, units)
    _draw_signs(ax, board, levels)
    if board.side(levels) > 1:
        _draw_cells(ax, board)
    return ax


def _level_bar(ax: Axes, board: Board, palette, largest: int, units: tuple[str, str]) -> None:
    """The colour bar of levels; on it the first two are as wide as their names need, however many others there are."""
    width = max(1.0, largest / 10)
    bounds = np.append([0.5 - 2 * width, 0.5 - width], np.linspace(0.5, largest + 0.5, palette.N - 1))
    mappable = ScalarMappable(colors.BoundaryNorm(bounds, palette.N), palette)
    bar = colorbar(ax, board, mappable, "", spacing="proportional")
    ticks = np.arange(1, largest + 1, -(-largest // 8))
    numbers = [f"{tick} {units[0] if tick == 1 else units[1]}" for tick in ticks]
    bar.set_ticks([0.5 - 1.5 * width, 0.5 - 0.5 * width, *ticks], labels=[*SIGNS, *numbers])
    _without_marks(bar)


def _without_marks(bar) -> None:
    """Names need no tick marks."""
    bar.minorticks_off()
    bar.ax.tick_params(length=0)


def _draw_signs(ax: Axes, board: Board, levels: np.ndarray) -> None:
    """Dots on demonstrated states and crosses where nothing was found, a third of a pixel wide."""
    side = board.side(levels)
    is_open = board.is_open.repeat(side**2)
    centres = board.centres(levels)
    crossed, dotted = (centres[is_open & (levels == level)] for level in (_NOTHING, _DEMONSTRATED))
    arm = 0.17 / side
    ends = np.array([[(-arm, -arm), (arm, arm)], [(-arm, arm), (arm, -arm)]])
    strokes = (crossed[:, None, None] + ends).reshape(-1, 2, 2)
    ax.add_collection(LineCollection(list(strokes), colors=INK, linewidths=1.4 / side**0.5, zorder=2.5))
    size = np.full(len(dotted), 0.32 / side)
    placed = {"offsets": dotted, "offset_transform": ax.transData}
    dots = EllipseCollection(size, size, np.zeros(len(dotted)), units="xy", color=INK, zorder=2.5, **placed)
    ax.add_collection(dots, autolim=False)


def _draw_policy(ax: Axes, board: Board, policy: np.ndarray) -> None:
    """Arrows on a heat map of the largest probability; `policy` is [C, A]."""
    scale = colors.Normalize(1.0 / policy.shape[1], 1.0)
    heat(ax, board, policy.max(axis=1), "probability of the likeliest action", norm=scale)
    draw_arrows(ax, board, policy, INK)


def _draw_actions(ax: Axes, board: Board, policy: np.ndarray, radius: np.ndarray) -> None:
    """A mosaic of the actions that are more likely than all others together; [S, A], [S]."""
    actions = 1 + np.argmax(policy, axis=1)
    kinds = np.where(policy.max(axis=1) > 0.5, actions, _MIXED)
    names = [f"{_ARROWS.get(name, '')} {name}".strip() for name in RACETRACK_ACTIONS]
    palette = colors.ListedColormap(["white", YELLOW, BLUE, ORANGE, SKY, GREEN])
    scale = colors.BoundaryNorm(np.arange(palette.N + 1) - 0.5, palette.N)
    bar = colorbar(ax, board, show(ax, board, kinds, cmap=palette, norm=scale), "")
    bar.outline.set(visible=True, edgecolor=FAINT)
    bar.set_ticks(np.arange(palette.N), labels=["no majority", *names])
    _without_marks(bar)
    _draw_signs(ax, board, np.where(radius < 0, _NOTHING, 1))
    _draw_cells(ax, board)


def _draw_cells(ax: Axes, board: Board) -> None:
    """Outlines of the cells of a mosaic."""
    borders = borders_of(board, np.arange(board.num_cells))
    ax.add_collection(LineCollection(list(borders), colors="white", linewidths=0.8, zorder=2))


def _three_panels(board: Board) -> np.ndarray:
    """Axes side by side, or below each other for a map that is far wider than high."""
    rows, columns = board.shape
    if columns > _WIDE * rows:
        scale = min(8.5 / columns, 3.0 / rows, 0.6)
        grid, width, height = (3, 1), columns * scale + 0.8 + LEVEL_ROOM, 3 * (rows * scale + 0.9)
    else:
        scale = min(4.2 / columns, 4.2 / rows, 0.6)
        grid, width, height = (1, 3), 3 * (columns * scale + 0.5 + LEVEL_ROOM), rows * scale + 0.9
    return plt.subplots(*grid, figsize=(width, height), layout="constrained")[1]
