"""Whole figures: the picture that the command line saves."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import jax
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from jaxhom.domains.gridworld import Gridworld
from jaxhom.domains.racetrack import Racetrack
from jaxhom.models.demonstrations import Demonstrations, sample_demonstrations
from jaxhom.plotting.boards import Board, board_of, draw_arrows, policy_at, require
from jaxhom.plotting.pictures import plot_gridworld, plot_racetrack, plot_trajectories, unpadded
from jaxhom.plotting.style import BLACK, BLUE, GREEN, INK, ORANGE, PURPLE, TINT, VERMILLION

if TYPE_CHECKING:
    from jaxtyping import Array, ArrayLike, Float, Key

_STRIP_WIDTH = 5.2  # inches, where the title of a strip finds room
_NUM_TRIALS = 99  # of which the figure shows the median one


def learned_policy_figure(
    gridworld: Gridworld,
    reward: Float[ArrayLike, "S *A"],
    gridworld_demonstrations: Demonstrations,
    gridworld_policy: Float[ArrayLike, "S A"],
    racetrack: Racetrack,
    racetrack_demonstrations: Demonstrations,
    racetrack_policies: Mapping[str, Float[Array, "S A"]],
    *,
    key: Key[Array, ""],
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

    Outside jit, vmap and grad only: trials are sampled and drawn on the host.

    Example:
      >>> import jaxhom
      >>> world, track = jaxhom.gridworld(4), jaxhom.racetrack(["XXXX", "S..F", "XXXX"])
      >>> walk = jaxhom.Demonstrations.from_trajectories([([0, 1], [3, 3])])
      >>> drive = jaxhom.Demonstrations.from_trajectories([([12, 38], [4, 4])])
      >>> uniform = {name: np.full((domain.mdp.num_states, actions), 1 / actions)
      ...     for name, domain, actions in (("world", world, 4), ("track", track, 5))}
      >>> figure = learned_policy_figure(world, np.arange(16.0), walk, uniform["world"], track, drive,
      ...     {"uniform": uniform["track"]}, key=jax.random.key(0))
    """
    if not racetrack_policies:
        raise ValueError("racetrack_policies must name at least one policy")
    world = board_of(gridworld, Gridworld)
    reward = require("reward", reward, (world.num_states,), (world.num_states, len(world.moves)))
    arrows = policy_at(world, gridworld_policy, (0, 0))
    gridworld_demonstrations.validate(world.mdp, "ignore")
    racetrack_demonstrations.validate(racetrack.mdp, "ignore")
    visited = np.zeros(racetrack.mdp.num_states, bool)
    visited[np.concatenate(unpadded(racetrack_demonstrations))] = True
    trials = {name: _median_trial(key, racetrack, policy, horizon) for name, policy in racetrack_policies.items()}
    left, right = _two_halves(board_of(racetrack, Racetrack), len(trials))
    reward = reward.reshape(world.num_states, -1).max(axis=1)
    _draw_learned_gridworld(left, gridworld, reward, gridworld_demonstrations, arrows)
    palette = itertools.cycle((BLACK, VERMILLION, BLUE, PURPLE, GREEN, ORANGE))
    axes = right.subplots(len(trials), squeeze=False)[:, 0]
    for ax, color, (name, trial) in zip(axes, palette, trials.items(), strict=False):
        plot_racetrack(racetrack, visited=visited, ax=ax)
        _draw_trial(ax, racetrack, trial, name, color)
    demonstrated = Patch(color=TINT, label="demonstrated")
    _legend(right, demonstrated, _marker("o-", "steps of a trial"), _marker("X", "off-road"))
    return left.figure


def _two_halves(board: Board, num_strips: int):
    """A new figure's halves: a square one, and one for pictures of `board` below each other."""
    rows, columns = board.shape
    strip = min(_STRIP_WIDTH * rows / columns, 2.5)
    height = max(5.5, 0.45 + num_strips * (strip + 0.35))
    widths = height + 0.5, _STRIP_WIDTH + 0.1
    figure = plt.figure(figsize=(sum(widths), height), layout="constrained")
    return figure.subfigures(1, 2, width_ratios=widths)


def _draw_learned_gridworld(figure, gridworld: Gridworld, reward, demonstrations, arrows) -> None:
    """The left half of `learned_policy_figure`."""
    ax = plot_gridworld(gridworld, values=reward, label="true reward", ax=figure.subplots())
    plot_trajectories(gridworld, demonstrations, ax=ax)
    draw_arrows(ax, board_of(gridworld), arrows, INK)
    count = demonstrations.num_trajectories
    _strip(ax, f"Learned from {count} demonstration{'s' * (count != 1)}")
    lines = _marker("o-", "demonstration", color=VERMILLION, markersize=3)
    learned = _marker(r"$\rightarrow$", "learned action", markersize=13)
    _legend(figure, lines, learned, _marker((4, 1, 0), "uniform (no advice)"))


def _strip(ax: Axes, title: str) -> None:
    """Gives axes a title, and takes their scales away."""
    ax.set(xlabel="", ylabel="", xticks=[], yticks=[])
    ax.set_title(title, loc="left", fontsize="medium")


def _marker(shape, label: str, *, color: str = INK, markersize: float = 6) -> Line2D:
    """A legend's entry: a marker, followed by "-" for one on a line."""
    on_line = isinstance(shape, str) and shape.endswith("-")
    marker, line = (shape[:-1], "-") if on_line else (shape, "")
    style: dict[str, Any] = {"linestyle": line, "markersize": markersize, "markeredgewidth": 0}
    return Line2D([], [], color=color, marker=marker, label=label, **style)


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
    (states,) = unpadded(trial)
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
