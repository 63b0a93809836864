"""Pictures of gridworlds, racetracks, policies, demonstrations, generalizations and certificates.

Every `plot_*` function draws on the axes it is given and returns them; with `ax=None` it makes a
figure of a fitting size. The domain is a `Gridworld` or a `Racetrack`. Arrays may be JAX or NumPy.

One vocabulary throughout, told apart without colour vision (Okabe and Ito 2008; cividis, Nunez et
al. 2018): amounts run from white to blue, so that black arrows and orange lines stay legible on
them; ordinal levels are cividis; walls are grey, start cells green, finish cells chequered.

A racetrack's state is a cell and one of 25 speeds. What has one number per state is drawn per cell,
by the rule that each function states, or as a mosaic of the 25 speeds.

This module needs matplotlib (`pip install 'jaxhom[plot]'`); `import jaxhom` does not import it.
"""

import dataclasses
import itertools
from collections.abc import Mapping

import jax
import numpy as np

from jaxhom import checks
from jaxhom.demonstrations import Demonstrations, empirical_policy, sample_demonstrations
from jaxhom.domains.gridworld import ACTIONS as GRIDWORLD_ACTIONS
from jaxhom.domains.gridworld import Gridworld
from jaxhom.domains.racetrack import ACTIONS as RACETRACK_ACTIONS
from jaxhom.domains.racetrack import Racetrack
from jaxhom.mdp import MDP

try:
    import matplotlib.pyplot as plt
    from matplotlib import colors
    from matplotlib.axes import Axes
    from matplotlib.collections import EllipseCollection, LineCollection, PatchCollection
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch, Rectangle
    from matplotlib.ticker import MaxNLocator
except ImportError as error:
    raise ImportError("jaxhom.plotting needs matplotlib, which is not installed: pip install 'jaxhom[plot]'") from error

BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
YELLOW, BLUE, VERMILLION, PURPLE = "#F0E442", "#0072B2", "#D55E00", "#CC79A7"
"""The palette of Okabe and Ito (2008)."""
AMOUNT = colors.LinearSegmentedColormap.from_list("jaxhom_amount", ["#FFFFFF", "#A9D8F4", "#2C8CC9"])
"""Colours of amounts, white to blue, light enough everywhere for black on top."""

_INK, _WALL, _ROAD, _FAINT = "#222222", "#C9C9C9", "#FFFFFF", "#BBBBBB"
_START, _TINT = "#9AD9C3", "#F6EC86"
_CHECKER = 4  # chequers along the side of a finish cell
_LEAST_PROBABILITY = 0.02  # of an action that gets an arrow
_DECADES = 4  # of an occupancy that are told apart
_SPREAD = 0.4  # width of the lane, in cells, that several trajectories share
_BAR_ROOM = 0.9  # inches beside the map
_STRIP_WIDTH = 5.2  # inches
_NUM_TRIALS = 99  # of which the figure shows the median one


def plot_gridworld(
    gridworld: Gridworld,
    *,
    values=None,
    policy=None,
    trajectories: Demonstrations | None = None,
    visited=None,
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
    """
    board = _board(gridworld, Gridworld)
    if values is not None:
        values = _require("values", values, (board.num_states,))
    return _plot_domain(board, values, label, visited, trajectories, policy, (0, 0), ax)


def plot_racetrack(
    racetrack: Racetrack,
    *,
    values=None,
    policy=None,
    speed: tuple[int, int] = (0, 0),
    trajectories: Demonstrations | None = None,
    visited=None,
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
    """
    board = _board(racetrack, Racetrack)
    if values is not None:
        values = _require("values", values, (board.num_cells,), (board.num_states,))
        values = values.reshape(board.num_cells, -1).max(axis=1)
    return _plot_domain(board, values, label, visited, trajectories, policy, speed, ax)


def plot_policy(
    domain: Gridworld | Racetrack,
    policy,
    *,
    speed: tuple[int, int] = (0, 0),
    color: str = _INK,
    ax: Axes | None = None,
) -> Axes:
    """Draws a policy as arrows: per state one for each action, as long as the action is probable.

    A deterministic policy has one arrow of 0.8 cells per cell, a uniform one a rose of short ones.
    The racetrack's action "nothing" is a dot; its arrows are changes of speed, not moves, and its
    finish cells, where actions have no effect, have none.

    Args:
      domain: a gridworld or a racetrack.
      policy: [S, A], rows sum to 1.
      speed: racetrack only: the speed of the cars whose actions are drawn, standing ones if not
        given.
      color: of the arrows.
      ax: axes to draw on, as an overlay; new ones with the domain on them if None.

    Returns:
      The axes.

    Raises:
      ValueError: if a shape does not fit the domain, or there is no such speed.
    """
    board = _board(domain)
    policy = _policy_at(board, policy, speed)
    ax = _ground(board, ax) if ax is None else ax
    _draw_arrows(ax, board, policy, color)
    return ax


def plot_trajectories(
    domain: Gridworld | Racetrack,
    trajectories: Demonstrations,
    *,
    color: str = VERMILLION,
    label: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draws trajectories as lines with a dot per step and a ring in every cell where one begins.

    Several trajectories run side by side: from its ring on, each has an offset of its own from the
    centres of the cells.
    On a racetrack a line is cut where the car is put back from the finish to the start.

    Args:
      domain: a gridworld or a racetrack.
      trajectories: M trajectories of its model.
      color: of all of them.
      label: their name in a legend.
      ax: axes to draw on, as an overlay; new ones with the domain on them if None.

    Returns:
      The axes.

    Raises:
      ValueError: if a state does not exist in the domain.
    """
    board = _board(domain)
    trajectories.validate(board.mdp)
    ax = _ground(board, ax) if ax is None else ax
    num = trajectories.num_trajectories
    offset = _SPREAD * (np.arange(num) - (num - 1) / 2) / max(num - 1, 1)
    width = 1.6 if num == 1 else 1.0
    style = {"color": color, "linewidth": width, "marker": "o", "markersize": 1.0 + 1.6 * width}
    paths = [states // board.per_cell for states in _unpadded(trajectories)]
    for m, path in enumerate(paths):
        ends = np.flatnonzero(~board.is_open[path]) + 1
        points = board.cells[path] + offset[m]
        points[0] = board.cells[path[0]]
        y, x = np.insert(points, ends, np.nan, axis=0).T
        ax.plot(x, y, label=None if m else label, alpha=0.9, zorder=3, **style)
    y, x = board.cells[np.unique([path[0] for path in paths])].T
    ax.scatter(x, y, s=50, facecolor="white", edgecolor=color, linewidth=1.6, zorder=3.5)
    return ax


def plot_occupancy(
    domain: Gridworld | Racetrack,
    occupancy,
    *,
    label: str = "expected discounted visits",
    ax: Axes | None = None,
) -> Axes:
    """Draws how often each cell is visited, as a heat map with a logarithmic colour bar.

    Args:
      domain: a gridworld or a racetrack.
      occupancy: [S, A] or [S], not negative: an occupancy measure, or counts. It is summed over
        actions, and over speeds on a racetrack. Cells below 1 / 10000 of the largest stay white;
        finish cells keep their chequers.
      label: of the colour bar.
      ax: axes to draw on; new ones if None.

    Returns:
      The axes.

    Raises:
      ValueError: if the shape does not fit the domain, or no open cell is visited.
    """
    board = _board(domain)
    shape = (board.num_states,)
    occupancy = _require("occupancy", occupancy, shape, (*shape, len(board.moves)))
    visits = occupancy.reshape(board.num_cells, -1).sum(axis=1)
    largest = visits[board.is_open].max()
    if not largest > 0:
        raise ValueError(f"occupancy must be positive in some open cell, its largest is {largest}")
    least = largest / 10**_DECADES
    scale = colors.LogNorm(vmin=least, vmax=largest)
    ax = _ground(board, ax, _BAR_ROOM)
    _heat(ax, board, np.where(visits < least, np.nan, visits), label, norm=scale)
    return ax


def plot_radius(domain: Gridworld | Racetrack, radius, *, ax: Axes | None = None) -> Axes:
    """Colours states by the radius at which Algorithm 1 stopped: how far the expert's advice came.

    On a racetrack every cell is a mosaic of its 25 states: row speed -2 ... 2 from top to bottom,
    column speed -2 ... 2 from left to right.

    Args:
      domain: a gridworld or a racetrack.
      radius: int [S], `Generalization.radius`: 0 on demonstrated states, -1 where nothing was
        found; these two have colours of their own, the others a scale.
      ax: axes to draw on; new ones if None.

    Returns:
      The axes.

    Raises:
      ValueError: if the shape does not fit the domain, or an entry is below -1 or not whole.
    """
    board = _board(domain)
    radius = _require("radius", radius, (board.num_states,))
    whole = (radius == np.floor(radius)) & (radius >= -1)
    checks.require_all("radius", radius, whole, "must be whole and at least -1")
    largest = max(int(radius.max()), 1)
    levels = plt.get_cmap("cividis_r")(np.linspace(0.0, 1.0, largest))
    palette = colors.ListedColormap([colors.to_rgba(PURPLE), colors.to_rgba(VERMILLION), *levels])
    scale = colors.BoundaryNorm(np.arange(-1, largest + 2) - 0.5, palette.N)
    ax = _ground(board, ax, 1.6 * _BAR_ROOM)
    image = _show(ax, board, radius, cmap=palette, norm=scale)
    bar = _colorbar(ax, board, image, "")
    shown = np.arange(1, largest + 1, -(-largest // 8))
    names = ["nothing found", "demonstrated", f"{shown[0]} step away", *map(str, shown[1:])]
    bar.set_ticks([-1, 0, *shown], labels=names)
    bar.minorticks_off()
    bar.ax.tick_params(length=0)
    if board.per_cell > 1:
        borders = _borders(board, np.arange(board.num_cells))
        ax.add_collection(LineCollection(borders, colors="white", linewidths=0.8, zorder=2))
    return ax


def plot_certificate(lower, upper, *, iterations=None, label: str | None = None, ax: Axes | None = None) -> Axes:
    """Draws how a certificate closes: the gap between two bounds over iterations, on a log axis.

    Bounds stay true, so the line is the gap between the best of each so far; pale dots are the gap
    of the iteration's own pair. A gap of zero is drawn at the rounding of the bounds.

    Args:
      lower: [T], lower bounds on the optimum after each of T iterations.
      upper: [T], upper bounds.
      iterations: [T], their numbers; 1 ... T if None.
      label: the line's name in a legend.
      ax: axes to draw on; new ones if None.

    Returns:
      The axes.

    Raises:
      ValueError: if a shape does not fit.
    """
    lower, upper = np.asarray(lower, float), np.asarray(upper, float)
    checks.require_shape("lower", lower, "[T] with T >= 1", lower.ndim == 1 and lower.size > 0)
    checks.require_shape("upper", upper, str(lower.shape), upper.shape == lower.shape)
    iterations = np.arange(1, len(lower) + 1) if iterations is None else np.asarray(iterations)
    same = iterations.shape == lower.shape
    checks.require_shape("iterations", iterations, str(lower.shape), same)
    if ax is None:
        _, ax = plt.subplots(figsize=(6.0, 3.8), layout="constrained")
        ax.set_prop_cycle(color=(BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY, BLACK))
    rounding = np.finfo(float).eps * max(np.abs(lower).max(), np.abs(upper).max(), 1e-300)
    best = np.minimum.accumulate(upper) - np.maximum.accumulate(lower)
    (line,) = ax.plot(iterations, np.maximum(best, rounding), linewidth=2.0, label=label, zorder=3)
    own = np.maximum(upper - lower, rounding)
    ax.plot(iterations, own, ".", color=line.get_color(), markersize=3.5, alpha=0.3)
    ax.set(yscale="log", xlabel="iterations", ylabel="upper bound - lower bound")
    ax.grid(axis="y", color="#E3E3E3", linewidth=0.8)
    ax.spines[["top", "right"]].set_visible(False)
    return ax


def learned_policy_figure(
    gridworld: Gridworld,
    reward,
    gridworld_demonstrations: Demonstrations,
    gridworld_policy,
    racetrack: Racetrack,
    racetrack_demonstrations: Demonstrations,
    racetrack_policies: Mapping[str, jax.Array],
    *,
    key: jax.Array,
    horizon: int = 30,
) -> Figure:
    """Draws the library's story: few demonstrations in, a policy for every state out.

    Left the gridworld: its true reward, the demonstrations, the learned policy. Right the racetrack
    once per policy, with the demonstrated cells tinted and a trial of the policy, up to the finish.
    Of 99 trials the one with the median total reward is drawn; all policies meet the same random
    numbers. Crosses mark the steps that were off-roads more likely than not, and the title counts
    how many there were in expectation, given where the car was at every step.

    Args:
      gridworld: the domain on the left.
      reward: [S], true reward of its states, or [S, A], of which the largest over actions is shown.
      gridworld_demonstrations: what the policy was learned from.
      gridworld_policy: [S, A], the learned policy.
      racetrack: the domain on the right.
      racetrack_demonstrations: what its policies were learned from.
      racetrack_policies: named policies [S, A] (the expert's, k-NN's, the soft local
        homomorphism's), from top to bottom.
      key: a `jax.random` key for the trials.
      horizon: largest number of steps of a trial.

    Returns:
      The figure.

    Raises:
      ValueError: if a shape does not fit, or there is no policy for the racetrack.
    """
    if not racetrack_policies:
        raise ValueError("racetrack_policies must name at least one policy")
    world = _board(gridworld, Gridworld)
    reward = _require("reward", reward, (world.num_states,), (world.num_states, len(world.moves)))
    arrows = _policy_at(world, gridworld_policy, (0, 0))
    gridworld_demonstrations.validate(world.mdp)
    visited, _ = empirical_policy(racetrack.mdp, racetrack_demonstrations)
    trials = {name: _median_trial(key, racetrack, policy, horizon) for name, policy in racetrack_policies.items()}
    left, right = _two_halves(_board(racetrack, Racetrack), len(trials))
    reward = reward.reshape(world.num_states, -1).max(axis=1)
    _draw_learned_gridworld(left, world, reward, gridworld_demonstrations, arrows)
    palette = itertools.cycle((BLACK, VERMILLION, BLUE, PURPLE, GREEN, ORANGE))
    axes = right.subplots(len(trials), squeeze=False)[:, 0]
    for ax, color, (name, trial) in zip(axes, palette, trials.items(), strict=False):
        plot_racetrack(racetrack, visited=visited, ax=ax)
        _draw_trial(ax, racetrack, trial, name, color)
    demonstrated = Patch(color=_TINT, label="demonstrated")
    _legend(right, demonstrated, _marker("o-", "steps of a trial"), _marker("X", "off-road"))
    return left.figure


@dataclasses.dataclass(frozen=True, eq=False)
class _Board:
    """What a picture needs of a domain, in NumPy: C cells, numbered as their states are.

    Attributes:
      domain: the gridworld or racetrack.
      shape: rows and columns of the map.
      cells: int [C, 2], (row, column).
      is_open: bool [C], False on the finish line.
      per_cell: states per cell, 1 or 25.
      moves: int [A, 2], the (row, column) direction of each action.
    """

    domain: Gridworld | Racetrack
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
        if self.per_cell == 1:
            return states
        return states + self.domain.state_of(self.cells[0], speed)

    def image(self, values: np.ndarray, fill=np.nan) -> np.ndarray:
        """[C] or [S] -> one pixel per cell, or a square of pixels per cell; `fill` off the map."""
        side = round((len(values) / self.num_cells) ** 0.5)
        dtype = np.result_type(values, fill)
        tiles = np.full((*self.shape, side, side), fill, dtype)
        tiles[tuple(self.cells.T)] = values.reshape(self.num_cells, side, side)
        return tiles.swapaxes(1, 2).reshape(self.shape[0] * side, self.shape[1] * side)


def _board(domain, kind=(Gridworld, Racetrack)) -> _Board:
    if not isinstance(domain, kind):
        kinds = kind if isinstance(kind, tuple) else (kind,)
        names = " or a ".join(kind.__name__ for kind in kinds)
        raise ValueError(f"the domain must be a {names}, got {type(domain).__name__}")
    directions = {"up": (-1, 0), "down": (1, 0), "left": (0, -1), "right": (0, 1)}
    if isinstance(domain, Gridworld):
        actions, cells, per_cell = GRIDWORLD_ACTIONS, np.asarray(domain.coordinates), 1
        shape, is_open = (domain.size, domain.size), np.ones(len(cells), bool)
    else:
        actions, cells, per_cell = RACETRACK_ACTIONS, np.asarray(domain.cells), len(domain.speeds)
        shape = (len(domain.rows), len(domain.rows[0]))
        is_open = ~np.asarray(domain.terminal)[::per_cell]
    moves = np.array([directions.get(action, (0, 0)) for action in actions])
    return _Board(domain, shape, cells, is_open, per_cell, moves)


def _require(name: str, array, *shapes: tuple[int, ...]) -> np.ndarray:
    """Returns `array` as finite floats of one of the given shapes, or raises."""
    array = checks.as_host_array(name, array)
    checks.require_shape(name, array, " or ".join(map(str, shapes)), array.shape in shapes)
    return checks.require_floats(name, array)


def _ground(board: _Board, ax: Axes | None, room: float = 0.0) -> Axes:
    """Draws the empty domain: the regions of a gridworld; walls, start and finish of a track.

    New axes get `room` inches to their right, for a colour bar.
    """
    rows, columns = board.shape
    if ax is None:
        scale = min(9.0 / columns, 5.5 / rows, 0.6)
        size = (columns * scale + 0.8 + room, rows * scale + 0.8)
        _, ax = plt.subplots(figsize=size, layout="constrained")
    if isinstance(board.domain, Gridworld):
        borders = _borders(board, np.asarray(board.domain.region))
        color, width, margin = _FAINT, 0.7, 0.5
    else:
        ax.set_facecolor(_WALL)
        ax.imshow(_track_image(board.domain.rows), extent=_extent(board), zorder=0)
        borders = _borders(board, np.ones(board.num_cells, int))
        color, width, margin = _INK, 1.2, 0.9
        ax.spines[:].set_visible(False)
    ax.add_collection(LineCollection(borders, colors=color, linewidths=width, zorder=2))
    ax.set(xlim=(-margin, columns - 1 + margin), ylim=(rows - 1 + margin, -margin), aspect="equal")
    ax.set(xlabel="column", ylabel="row")
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(MaxNLocator(8, integer=True, steps=[1, 2, 4, 5, 10]))
    return ax


def _track_image(rows: tuple[str, ...]) -> np.ndarray:
    """RGB image of a track's cells, `_CHECKER` pixels along the side of each."""
    tone = {"#": _WALL, ".": _ROAD, "S": _START, "F": _ROAD}
    letters = np.array([list(row) for row in rows])
    image = np.array([[colors.to_rgb(tone[letter]) for letter in row] for row in letters])
    image = image.repeat(_CHECKER, axis=0).repeat(_CHECKER, axis=1)
    finish = (letters == "F").repeat(_CHECKER, axis=0).repeat(_CHECKER, axis=1)
    is_dark = np.indices(finish.shape).sum(axis=0) % 2 == 1
    image[finish & is_dark] = colors.to_rgb(_INK)
    return image


def _extent(board: _Board) -> tuple[float, float, float, float]:
    """Where an image of the whole map goes: cell (r, c) has its centre at (x, y) = (c, r)."""
    rows, columns = board.shape
    return -0.5, columns - 0.5, rows - 0.5, -0.5


def _borders(board: _Board, labels: np.ndarray) -> np.ndarray:
    """Segments [N, 2, (x, y)] between cells that differ in `labels`, [C], and round the map."""
    labels = np.pad(board.image(labels, fill=-1), 1, constant_values=-1)
    row, column = np.nonzero(labels[:, 1:] != labels[:, :-1])
    upright = [(column - 0.5, row - 1.5), (column - 0.5, row - 0.5)]
    row, column = np.nonzero(labels[1:] != labels[:-1])
    level = [(column - 1.5, row - 0.5), (column - 0.5, row - 0.5)]
    return np.concatenate([np.transpose(ends, (2, 0, 1)) for ends in (upright, level)])


def _show(ax: Axes, board: _Board, values: np.ndarray, **style):
    """Draws [C] or [S] values as an image; leaves finish cells and NaN as they are."""
    is_open = board.is_open.repeat(len(values) // board.num_cells)
    image = np.ma.masked_invalid(board.image(np.where(is_open, values, np.nan)))
    return ax.imshow(image, extent=_extent(board), interpolation="nearest", zorder=1, **style)


def _colorbar(ax: Axes, board: _Board, image, label: str):
    """A colour bar as high as the map and as wide as fits it."""
    rows, columns = board.shape
    width = 0.04 * max(rows, 16) / max(columns, 16)
    place = ax.inset_axes([1.0 + width / 2, 0.0, width, 1.0])
    bar = ax.figure.colorbar(image, cax=place, label=label)
    bar.outline.set_visible(False)
    return bar


def _heat(ax: Axes, board: _Board, values: np.ndarray, label: str, norm=None) -> None:
    """A heat map of amounts per cell, with its colour bar."""
    image = _show(ax, board, values, cmap=AMOUNT, norm=norm)
    _colorbar(ax, board, image, label)


def _plot_domain(board, values, label, visited, trajectories, policy, speed, ax) -> Axes:
    """Draws a domain, and on it what is given; checks everything before it draws anything."""
    if visited is not None:
        visited = _require("visited", visited, (board.num_states,)) > 0
    if trajectories is not None:
        trajectories.validate(board.mdp)
    if policy is not None:
        policy = _policy_at(board, policy, speed)
    ax = _ground(board, ax, _BAR_ROOM * (values is not None))
    if values is not None:
        _heat(ax, board, values, label)
    if visited is not None:
        cells = board.cells[visited.reshape(board.num_cells, -1).any(axis=1) & board.is_open]
        tint = [Rectangle((x - 0.4, y - 0.4), 0.8, 0.8) for y, x in cells]
        ax.add_collection(PatchCollection(tint, facecolor=_TINT, linewidth=0, zorder=1.5))
    if trajectories is not None:
        plot_trajectories(board.domain, trajectories, ax=ax)
    if policy is not None:
        _draw_arrows(ax, board, policy, _INK)
    return ax


def _policy_at(board: _Board, policy, speed) -> np.ndarray:
    """[S, A] -> the probabilities to draw, [C, A]: of one speed, of open cells, not negligible."""
    shape = (board.num_states, len(board.moves))
    policy = _require("policy", policy, shape)[board.states_at(speed)]
    return np.where(board.is_open[:, None] & (policy >= _LEAST_PROBABILITY), policy, 0.0)


def _draw_arrows(ax: Axes, board: _Board, policy: np.ndarray, color: str) -> None:
    """Draws probabilities [C, A] as arrows, and as dots where the action is not to move."""
    arrow = 0.8 * policy[..., None] * board.moves  # [C, A, (row, column)]
    # Half the mean move behind the centre: one arrow alone is centred in its cell, a rose as well.
    tail = board.cells[:, None] - 0.5 * arrow.sum(axis=1, keepdims=True)
    shown = arrow.any(axis=-1)
    tail = np.broadcast_to(tail, arrow.shape)[shown]
    y, x, dy, dx = np.concatenate([tail, arrow[shown]], axis=-1).T
    style = {"width": 0.075, "headwidth": 3.8, "headlength": 3.8, "headaxislength": 3.4}
    placed = {"angles": "xy", "units": "xy", "scale_units": "xy", "scale": 1.0}
    ax.quiver(x, y, dx, dy, color=color, zorder=4, **placed, **style)
    cell, action = np.nonzero((policy > 0) & ~board.moves.any(axis=-1))
    if cell.size:
        size = 0.3 * np.sqrt(policy[cell, action])
        placed = {"offsets": board.cells[cell, ::-1], "offset_transform": ax.transData}
        dots = EllipseCollection(size, size, 0.0, units="xy", color=color, zorder=4, **placed)
        ax.add_collection(dots, autolim=False)


def _unpadded(trajectories: Demonstrations) -> list[np.ndarray]:
    """The states of each trajectory."""
    mask = np.asarray(trajectories.mask)
    return [states[kept] for states, kept in zip(np.asarray(trajectories.states), mask, strict=True)]


def _two_halves(board: _Board, num_strips: int):
    """A new figure's halves: a square one, and one for pictures of `board` below each other."""
    rows, columns = board.shape
    strip = min(_STRIP_WIDTH * rows / columns, 2.5)
    height = max(5.5, 0.45 + num_strips * (strip + 0.35))
    widths = height + 0.5, _STRIP_WIDTH + 0.1
    figure = plt.figure(figsize=(sum(widths), height), layout="constrained")
    return figure.subfigures(1, 2, width_ratios=widths)


def _draw_learned_gridworld(figure, board: _Board, reward, demonstrations, arrows) -> None:
    """The left half of `learned_policy_figure`."""
    ax = plot_gridworld(board.domain, values=reward, label="true reward", ax=figure.subplots())
    plot_trajectories(board.domain, demonstrations, ax=ax)
    _draw_arrows(ax, board, arrows, _INK)
    count = demonstrations.num_trajectories
    _strip(ax, f"Learned from {count} demonstration{'s' * (count != 1)}")
    lines = _marker("o-", "demonstration", color=VERMILLION, markersize=3)
    learned = _marker(r"$\rightarrow$", "learned action", markersize=13)
    _legend(figure, lines, learned, _marker((4, 1, 0), "uniform (no advice)"))


def _strip(ax: Axes, title: str) -> None:
    """Gives axes a title, and takes their scales away."""
    ax.set(xlabel="", ylabel="", xticks=[], yticks=[])
    ax.set_title(title, loc="left", fontsize="medium")


def _marker(shape, label: str, *, color: str = _INK, markersize: float = 6) -> Line2D:
    """A legend's entry: a marker, followed by "-" for one on a line."""
    on_line = isinstance(shape, str) and shape.endswith("-")
    marker, line = (shape[:-1], "-") if on_line else (shape, "")
    style = {"markersize": markersize, "markeredgewidth": 0}
    return Line2D([], [], color=color, marker=marker, linestyle=line, label=label, **style)


def _legend(figure, *entries) -> None:
    """Names a picture's signs below it."""
    figure.legend(
        handles=entries,
        loc="outside lower left",
        ncols=len(entries),
        frameon=False,
        handletextpad=0.5,
        columnspacing=1.5,
    )


def _median_trial(key, racetrack: Racetrack, policy, horizon: int) -> Demonstrations:
    """The trial with the median total reward, up to the state on the finish line."""
    trials = sample_demonstrations(key, racetrack.mdp, policy, _NUM_TRIALS, horizon + 1)
    states, actions = np.asarray(trials.states), np.asarray(trials.actions)
    is_finish = np.asarray(racetrack.terminal)[states]
    before = np.cumsum(is_finish, axis=1) - is_finish == 0  # up to and with the first finish state
    reward = np.asarray(racetrack.mdp.features @ racetrack.weights)[states, actions]
    total = np.where(before & ~is_finish, reward, 0.0)[:, :horizon].sum(axis=1)
    middle = np.argsort(total, kind="stable")[_NUM_TRIALS // 2]
    return jax.tree.map(lambda leaf: leaf[middle][None], trials.replace(mask=before))


def _draw_trial(ax: Axes, racetrack: Racetrack, trial: Demonstrations, name: str, color) -> None:
    """One strip of the right half of `learned_policy_figure`."""
    plot_trajectories(racetrack, trial, color=color, ax=ax)
    (states,) = _unpadded(trial)
    steps = len(states) - 1
    off_road = _off_road_chances(racetrack, states, np.asarray(trial.actions)[0, :steps])
    y, x = np.asarray(racetrack.coordinates)[states[:-1]][off_road > 0.5].T
    ax.plot(x, y, "X", color=color, markersize=12, markeredgecolor="white", zorder=5)
    is_finished = bool(np.asarray(racetrack.terminal)[states[-1]])
    end = f"finish in {steps} steps" if is_finished else f"no finish in {steps} steps"
    times = round(off_road.sum())
    _strip(ax, f"{name}: {end}, {times} off-road{'s' * (times != 1)}")


def _off_road_chances(racetrack: Racetrack, states, actions) -> np.ndarray:
    """Probability of an off-road at each step of a trial, [H], given where the step led.

    A car that stands in the same cell afterwards may have braked to a halt, or hit the wall.
    """
    here, after = states[:-1], states[1:]
    mdp = racetrack.mdp
    is_after = np.asarray(mdp.next_state)[here, actions] == after[:, None]
    chance = np.where(is_after, np.asarray(mdp.probability)[here, actions], 0.0).sum(axis=1)
    cells = np.asarray(racetrack.coordinates)
    stands = np.asarray(~racetrack.speeds.any(axis=1))[after % len(racetrack.speeds)]
    is_same = (cells[here] == cells[after]).all(axis=1) & stands
    return np.where(is_same, np.asarray(racetrack.off_road)[here, actions] / chance, 0.0)
