"""Pictures of certificates: how bounds close over iterations.

The solvers report their last bounds alone, and these hold whenever one stops: stop at more and more
iterations to get a history, for LPAL

    history = [(n, s.margin, s.margin_bound) for n in (1, 2, 4, 8) for s in [lpal(mdp, expectations, max_iterations=n)]]

and for a pair of states, where PDHG looks at its bounds every 16 iterations,

    options = {"method": "pdhg", "tolerance": 1e-9}
    brackets = {n: local_similarity(mdp, [s], [t], max_iterations=n, **options) for n in (16, 32, 64, 128, 256)}
    history = [(n, bracket.lower[0], bracket.upper[0]) for n, bracket in brackets.items()]
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from jaxhom import checks
from jaxhom.plotting.style import BLACK, BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILLION, plain_axes

if TYPE_CHECKING:
    from jaxtyping import ArrayLike, Float

_LOG_RANGE = 20  # of iterations, from which on their axis is logarithmic


def plot_bounds(
    history: Float[ArrayLike, "T 3"] | Sequence[tuple[float, float, float]],
    *,
    value: str = "value",
    ax: Axes | None = None,
) -> Axes:
    """Draws both sides of a certificate over iterations: what is bounded lies in the band between them.

    Lines are the best bounds so far, triangles those of the iteration itself: pointing up for lower bounds, down for
    upper ones. The iterations are on a log axis where they span a factor of 20 or more.

    Args:
      history: [T, 3], rows (iteration, lower bound, upper bound), in any order; the module says how to get one.
      value: what is bounded, for the axis: "best margin", for instance.
      ax: axes to draw on; new ones if None.

    Returns:
      The axes, with a legend that says how far apart the bounds are in the end.

    Raises:
      ValueError: if the shape does not fit, or a number is not finite.

    Outside jit, vmap and grad only: it draws concrete numbers.

    Example:
      >>> ax = plot_bounds([(1, 0.0, 1.0), (2, 0.2, 0.9), (4, 0.5, 0.6)], value="best margin")
      >>> ax.get_legend().get_title().get_text()
      '1.0e-01 apart'
    """
    history = checks.as_host_array("history", history)
    good = history.ndim == 2 and history.shape[1] == 3 and len(history) > 0
    checks.require_shape("history", history, "[T, 3] with T >= 1", good)
    history = checks.require_floats("history", history)
    iterations, lower, upper = history[np.argsort(history[:, 0], kind="stable")].T
    if ax is None:
        _, ax = plt.subplots(figsize=(6.0, 3.8), layout="constrained")
    best = np.maximum.accumulate(lower), np.minimum.accumulate(upper)
    ax.fill_between(iterations, *best, step="post", color=SKY, alpha=0.25, linewidth=0)
    sides = zip(("lower bound", "upper bound"), (lower, upper), best, (BLUE, VERMILLION), "^v", strict=True)
    for label, own, line, color, marker in sides:
        ax.step(iterations, line, where="post", color=color, linewidth=1.8)
        ax.plot(iterations, own, linestyle="", marker=marker, color=color, markersize=6, label=label)
    if iterations[0] > 0 and iterations[-1] >= _LOG_RANGE * iterations[0]:
        ax.set_xscale("log")
        ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        ax.xaxis.set_major_formatter("{x:g}")
        ax.xaxis.set_minor_formatter(NullFormatter())
    else:
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set(xlabel="iterations", ylabel=value)
    ax.legend(frameon=False, title=f"{best[1][-1] - best[0][-1]:.1e} apart", loc="best")
    return plain_axes(ax)


def plot_certificate(
    lower: Float[ArrayLike, "T"],
    upper: Float[ArrayLike, "T"],
    *,
    iterations: Float[ArrayLike, "T"] | None = None,
    label: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draws how a certificate closes: the gap between two bounds over iterations, on a log axis.

    Bounds stay true, so the line is the gap between the best of each so far; pale dots are the gap of the iteration's
    own pair. A gap of zero is drawn at the rounding of the bounds. Several certificates on the same axes differ in
    colour, marker and line.

    Args:
      lower: [T], lower bounds on the optimum after each of T iterations.
      upper: [T], upper bounds.
      iterations: [T], their numbers; 1 ... T if None.
      label: the line's name in a legend.
      ax: axes to draw on; new ones if None.

    Returns:
      The axes.

    Raises:
      ValueError: if a shape does not fit, or a number is not finite.

    Outside jit, vmap and grad only: it draws concrete numbers.

    Example:
      >>> plot_certificate([0.0, 0.2, 0.5], [1.0, 0.9, 0.6], label="PDHG").get_yscale()
      'log'
    """
    lower = checks.require_floats("lower", checks.as_host_array("lower", lower))
    checks.require_shape("lower", lower, "[T] with T >= 1", lower.ndim == 1 and lower.size > 0)
    upper = checks.require_floats("upper", checks.as_host_array("upper", upper))
    checks.require_shape("upper", upper, str(lower.shape), upper.shape == lower.shape)
    iterations = np.arange(1, len(lower) + 1) if iterations is None else iterations
    iterations = checks.require_floats("iterations", checks.as_host_array("iterations", iterations))
    checks.require_shape("iterations", iterations, str(lower.shape), iterations.shape == lower.shape)
    if ax is None:
        _, ax = plt.subplots(figsize=(6.0, 3.8), layout="constrained")
    # A line and its dots make two entries: the next certificate takes the next colour.
    number = len(ax.lines) // 2
    color = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY, BLACK)[number % 7]
    line: dict[str, Any] = {
        "linestyle": ("-", "--", "-.", ":")[number % 4],
        "marker": "os^DvPX"[number % 7],
        "markersize": 4.5,
    }
    rounding = np.finfo(float).eps * max(np.abs(lower).max(), np.abs(upper).max(), 1e-300)
    best = np.minimum.accumulate(upper) - np.maximum.accumulate(lower)
    every = max(1, len(best) // 12)
    ax.plot(iterations, np.maximum(best, rounding), color=color, linewidth=2.0, label=label, markevery=every, **line)
    own = np.maximum(upper - lower, rounding)
    ax.plot(iterations, own, ".", color=color, markersize=3.5, alpha=0.3)
    ax.set(yscale="log", xlabel="iterations", ylabel="upper bound - lower bound")
    return plain_axes(ax)
