"""Pictures of certificates: how bounds close over iterations."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from jaxhom import checks
from jaxhom.plotting.palette import BLACK, BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILLION


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
