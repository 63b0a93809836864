"""Pictures of models without a map: states by number, from left to right.

The counterparts of what is drawn on a map: a policy is an image of its probabilities, trajectories are lines over
time, an occupancy a line of spikes, and the radii of a generalization a histogram.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import TYPE_CHECKING

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.ticker import MaxNLocator

from jaxhom import checks
from jaxhom.models.demonstrations import Demonstrations
from jaxhom.models.names import check_names
from jaxhom.plotting.boards import require
from jaxhom.plotting.pictures import unpadded
from jaxhom.plotting.style import AMOUNT, BLUE, OCCUPANCY_RANGE, PURPLE, SIGNS, VERMILLION, plain_axes

if TYPE_CHECKING:
    from jaxtyping import ArrayLike, Bool, Float, Int

_NAMED = 24  # states or actions, that names have room for
_LETTERS = 60  # of all of them side by side


def plot_policy_by_state(
    policy: Float[ArrayLike, "S A"],
    *,
    visited: Bool[ArrayLike, "S"] | None = None,
    state_names: Sequence[Hashable] | None = None,
    action_names: Sequence[Hashable] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draws a policy as an image: states from left to right, actions from top to bottom, dark where likely.

    Args:
      policy: [S, A], rows sum to 1.
      visited: bool [S], states to mark below the image, the demonstrated ones for instance.
      state_names: S names (`mdp.state_names`), to show in place of numbers where there are few.
      action_names: A names, likewise.
      ax: axes to draw on; new ones if None.

    Returns:
      The axes.

    Raises:
      ValueError: if a shape does not fit.

    Outside jit, vmap and grad only: it draws concrete numbers.

    Example:
      >>> import jaxhom
      >>> plot_policy_by_state(np.full((5, 2), 0.5), visited=np.arange(5) < 2).get_ylabel()
      'action'
    """
    policy = checks.as_host_array("policy", policy)
    checks.require_shape("policy", policy, "[S, A]", policy.ndim == 2 and policy.size > 0)
    policy = checks.require_floats("policy", policy)
    num_states, num_actions = policy.shape
    if visited is not None:
        visited = require("visited", visited, (num_states,)) > 0
    ax = _axes(ax, height=1.4 + 0.25 * min(num_actions, 12))
    image = ax.imshow(policy.T, aspect="auto", interpolation="nearest", cmap=AMOUNT, vmin=0.0, vmax=1.0)
    ax.figure.colorbar(image, ax=ax, label="probability").outline.set_visible(False)
    if visited is not None:
        marked = np.flatnonzero(visited)
        ax.plot(marked, np.full(len(marked), num_actions), "|", color=VERMILLION, markersize=7, label="demonstrated")
        ax.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), frameon=False, borderaxespad=0.0)
        ax.set_ylim(num_actions + 0.5, -0.5)
    ax.set(xlabel="state", ylabel="action")
    ax.yaxis.set_major_locator(MaxNLocator(6, integer=True))
    ax.set_yticks([tick for tick in ax.get_yticks() if 0 <= tick < num_actions])
    _show_names(ax.xaxis, "state_names", state_names, num_states, is_upright=True)
    _show_names(ax.yaxis, "action_names", action_names, num_actions)
    return ax


def plot_occupancy_by_state(
    occupancy: Float[ArrayLike, "S *A"],
    *,
    label: str = "expected discounted visits",
    state_names: Sequence[Hashable] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draws how often each state is visited, as spikes on a logarithmic axis.

    Args:
      occupancy: [S, A] or [S], not negative; summed over actions. States below 1 / 10000 of the largest have no spike.
      label: of the axis.
      state_names: S names, to show in place of numbers where there are few.
      ax: axes to draw on; new ones if None.

    Returns:
      The axes.

    Raises:
      ValueError: if the shape does not fit, or no state is visited.

    Outside jit, vmap and grad only: it draws concrete numbers.

    Example:
      >>> plot_occupancy_by_state([3.0, 1.0, 0.1]).get_yscale()
      'log'
    """
    occupancy = checks.as_host_array("occupancy", occupancy)
    checks.require_shape("occupancy", occupancy, "[S] or [S, A]", occupancy.ndim in (1, 2) and occupancy.size > 0)
    visits = checks.require_floats("occupancy", occupancy).reshape(len(occupancy), -1).sum(axis=1)
    largest = visits.max()
    if not largest > 0:
        raise ValueError(f"occupancy must be positive in some state, its largest is {largest}")
    least = largest / OCCUPANCY_RANGE
    ax = _axes(ax, height=2.8)
    shown = np.flatnonzero(visits >= least)
    ax.vlines(shown, least, visits[shown], color=BLUE, linewidth=np.clip(240.0 / len(visits), 0.6, 4.0))
    ax.set(yscale="log", ylim=(least, 1.5 * largest), xlim=(-0.5, len(visits) - 0.5), xlabel="state", ylabel=label)
    _show_names(ax.xaxis, "state_names", state_names, len(visits), is_upright=True)
    return plain_axes(ax)


def plot_trajectories_by_state(
    trajectories: Demonstrations, *, state_names: Sequence[Hashable] | None = None, ax: Axes | None = None
) -> Axes:
    """Draws trajectories as lines: the state over the steps, with a ring where each begins; no answers, without time.

    Args:
      trajectories: M of them.
      state_names: S names, to show in place of numbers where there are few.
      ax: axes to draw on; new ones if None.

    Returns:
      The axes.

    Outside jit, vmap and grad only: it draws concrete numbers.

    Example:
      >>> import jaxhom
      >>> walk = jaxhom.Demonstrations.from_trajectories([([0, 1, 5], [3, 1, 1])])
      >>> plot_trajectories_by_state(walk).get_xlabel()
      'step'
    """
    ax = _axes(ax, height=3.2)
    for states in unpadded(trajectories[~np.asarray(trajectories.is_answer)]):
        ax.plot(states, color=VERMILLION, linewidth=1.0, marker="o", markersize=2.5, alpha=0.7)
        ax.plot(0, states[0], "o", markersize=7, markerfacecolor="white", markeredgecolor=VERMILLION)
    ax.set(xlabel="step", ylabel="state")
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(MaxNLocator(8, integer=True))
    _show_names(ax.yaxis, "state_names", state_names, None)
    return plain_axes(ax)


def plot_radius_counts(radius: Int[ArrayLike, "S"], *, ax: Axes | None = None) -> Axes:
    """Draws how many states found advice at which radius.

    Args:
      radius: int [S], `Generalization.radius`: 0 on demonstrated states, -1 where nothing was found; these two have
        bars of their own colour.
      ax: axes to draw on; new ones if None.

    Returns:
      The axes.

    Raises:
      ValueError: if the shape does not fit, or an entry is below -1 or not whole.

    Outside jit, vmap and grad only: it draws concrete numbers.

    Example:
      >>> [int(bar.get_height()) for bar in plot_radius_counts([0, 0, 1, 2, 2, -1]).patches]  # from -1 on
      [1, 2, 1, 2]
    """
    radius = checks.as_host_array("radius", radius)
    checks.require_shape("radius", radius, "[S]", radius.ndim == 1 and radius.size > 0)
    whole = (radius == np.floor(radius)) & (radius >= -1)
    checks.require_all("radius", radius, whole, "must be whole and at least -1")
    levels = np.arange(-1, max(int(radius.max()), 1) + 1)
    counts = [(radius == level).sum() for level in levels]
    ax = _axes(ax, height=2.8)
    colors = [PURPLE, VERMILLION, *[BLUE] * (len(levels) - 2)]
    bars = ax.bar(levels, counts, color=colors)
    ax.legend(bars[:3], [*SIGNS, "generalized to"], frameon=False, loc="best")
    steps = levels[2 :: -(-len(levels) // 20)]
    ax.set_xticks([-1, 0, *steps], labels=[*(name[0] for name in SIGNS), *map(str, steps)])
    ax.set(xlabel="steps to the demonstrated states that voted", ylabel="states")
    ax.yaxis.set_major_locator(MaxNLocator(6, integer=True))
    return plain_axes(ax)


def _axes(ax: Axes | None, height: float) -> Axes:
    return plt.subplots(figsize=(8.0, height), layout="constrained")[1] if ax is None else ax


def _show_names(
    axis: Axis, argument: str, names: Sequence[Hashable] | None, count: int | None, *, is_upright: bool = False
) -> None:
    """Names in place of an axis' numbers, if there are few; if `is_upright`, turned where they are long."""
    if names is None:
        return
    if count is not None:
        check_names(argument, names, count)
    if len(names) <= _NAMED:
        texts = [str(name) for name in names]
        is_long = is_upright and sum(map(len, texts)) > _LETTERS
        # A dollar in a name is a dollar, and what no font has is written out.
        texts = [text.encode("utf-8", "backslashreplace").decode() for text in texts]
        axis.set_ticks(range(len(texts)), labels=texts, rotation=90 if is_long else 0, parse_math=False)
