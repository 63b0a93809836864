"""Figure 1 of the paper and the figures of the questions, from summary lines. Bands are 95% confidence intervals.

Colours are those of Okabe and Ito (2008), and every curve has a marker and a line style of its own; ordinal families
(numbers of samples) run through cividis.
"""

from collections.abc import Callable, Iterable, Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from bench.summaries import paper_table1
from jaxhom.plotting import BLACK, BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILLION

_GREY = "#777777"
STYLES = {
    "expert": ("expert", BLACK, "", "-"),
    "lpal_full_policy": ("LPAL with the complete policy", _GREY, "x", ":"),
    "soft_local_homomorphism": ("soft local homomorphism (anchored)", VERMILLION, "o", "-"),
    "soft_local_homomorphism_mutual": ("soft local homomorphism, both directions", ORANGE, "^", "--"),
    "soft_local_homomorphism_printed": ("soft local homomorphism, as printed", PURPLE, "D", ":"),
    "manhattan_knn": ("k-NN (Manhattan)", BLUE, "s", "-"),
    "euclidean_knn": ("k-NN (Euclidean)", SKY, "P", "--"),
    "maximum_entropy": ("maximum entropy", GREEN, "v", "-."),
    "monte_carlo": ("LPAL with Monte Carlo", PURPLE, "X", ":"),
    "monte_carlo_per_step": ("LPAL with Monte Carlo, per step", ORANGE, "o", ":"),
    "regression": ("regression", _GREY, "*", "-."),
    "lpal_soft_local_homomorphism": ("LPAL with soft local homomorphism", SKY, "v", "-."),
    "lpal_manhattan_knn": ("LPAL with k-NN", GREEN, "P", "--"),
}
"""Per method: label, colour, marker, line."""
_METRICS = {
    "reward_per_step": "average reward per step",
    "steps": "steps to the finish",
    "off_roads": "off-roads per step",
    "ratio": "reward per step / expert's",
}
_DOMAINS = {"track_a": "racetrack (a)", "track_b": "racetrack (b)", "track_corner": "corner track"}


def figure1(lines: Sequence[dict]) -> Figure:
    """Six panels: a row per track; reward, steps and off-roads against the number of demonstrations."""
    tracks = list(dict.fromkeys(line["track"] for line in lines))
    metrics = [metric for metric in _METRICS if any(line["metric"] == metric for line in lines)]
    figure, panels = plt.subplots(
        len(tracks), len(metrics), figsize=(12.5, 3.6 * len(tracks) + 0.9), squeeze=False, layout="constrained"
    )
    names = iter("abcdefghij")
    for track, row in zip(tracks, panels, strict=True):
        for metric, ax in zip(metrics, row, strict=True):
            here = [line for line in lines if (line["track"], line["metric"]) == (track, metric)]
            _draw_methods(ax, here, "demonstrations")
            ax.set(xlabel="demonstrations", ylabel=_METRICS[metric])
            ax.set_title(f"({next(names)}) racetrack ({track})", loc="left", fontsize="medium")
            ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    _legend_below(figure, panels.flat, columns=3)
    return figure


def threshold_figure(lines: Sequence[dict]) -> Figure:
    """Off-roads and reward against epsilon, a column per track and distance."""
    columns = _ordered((line["domain"], line["distance"]) for line in lines)
    metrics = ("off_roads", "reward_per_step")
    figure, panels = _grid_of_panels(metrics, columns)
    for (domain, distance), column in zip(columns, panels.T, strict=True):
        for metric, ax in zip(metrics, column, strict=True):
            here = _pick(lines, metric=metric, domain=domain, distance=distance)
            _draw_methods(ax, here, "threshold")
            ax.set(xlabel=r"threshold $\epsilon$", ylabel=_METRICS[metric])
        column[0].set_title(f"{_DOMAINS[domain]}, d = {distance}", loc="left", fontsize="medium")
    _legend_below(figure, panels.flat, columns=4)
    return figure


def noise_figure(lines: Sequence[dict]) -> Figure:
    """Off-roads and reward against epsilon, a curve per number of samples of each transition."""
    metrics = ("off_roads", "ratio")
    figure, panels = _grid_of_panels(metrics, [None], width=6.5)
    soft = [line for line in lines if line["method"] == "soft_local_homomorphism"]
    samples = sorted({line["samples"] for line in soft}, key=lambda count: count or np.inf)
    colors = plt.get_cmap("cividis")(np.linspace(0.0, 0.85, len(samples)))
    for metric, ax in zip(metrics, panels[:, 0], strict=True):
        for count, color, marker in zip(samples, colors, "osD^vPX", strict=False):
            here = _pick(soft, metric=metric, samples=count)
            label = f"{count} samples" if count else "true model"
            _draw_curve(ax, here, "threshold", label, color, marker, "-")
        here = _pick(lines, metric=metric, samples=0, method="manhattan_knn")
        _draw_curve(ax, here, "threshold", "k-NN, true model", VERMILLION, "", "--")
        ax.set(xlabel=r"threshold $\epsilon$", ylabel=_METRICS[metric])
    _legend_below(figure, panels.flat, columns=3)
    return figure


def enough_figure(lines: Sequence[dict]) -> Figure:
    """Reward as a share of the expert's against the number of demonstrations, a panel per domain."""
    domains = _ordered(line["domain"] for line in lines)
    columns = min(3, len(domains))
    height = -(-len(domains) // columns)
    figure, panels = plt.subplots(
        height, columns, figsize=(4.2 * columns, 3.3 * height + 0.7), squeeze=False, layout="constrained"
    )
    for ax in panels.flat[len(domains) :]:
        ax.set_visible(False)
    for domain, ax in zip(domains, panels.flat, strict=False):
        _draw_methods(ax, _pick(lines, metric="ratio", domain=domain), "demonstrations", without=("expert",))
        ax.axhline(0.99, color=BLACK, linewidth=0.8, linestyle=(0, (1, 1)))
        ax.set(xscale="log", xlabel="demonstrations", ylabel=_METRICS["ratio"], ylim=(None, 1.02))
        ax.set_title(domain_name(domain), loc="left", fontsize="medium")
    _legend_below(figure, panels.flat, columns=4)
    return figure


def normalisation_figure(lines: Sequence[dict]) -> Figure:
    """Monte Carlo's reward in the rows of Table I, by two normalisations of its expectations, and as printed."""
    rows = _ordered((line["domain"], line["regions"]) for line in lines)
    figure, ax = plt.subplots(figsize=(8.0, 3.8), layout="constrained")
    for shift, method in ((-0.12, "monte_carlo"), (0.12, "monte_carlo_per_step")):
        label, color, marker, _ = STYLES[method]
        here = [_pick(lines, metric="reward_per_step", method=method, domain=d, regions=k) for d, k in rows]
        at = [place + shift for place, found in enumerate(here) if found]
        found = [found[0] for found in here if found]
        mean = np.array([line["mean"] for line in found])
        half = [0.5 * (line["ci_high"] - line["ci_low"]) for line in found]
        ax.errorbar(at, mean, half, color=color, marker=marker, linestyle="none", label=label, capsize=3)
    printed = [paper_table1().get((int(domain[4:]), regions, "monte_carlo")) for domain, regions in rows]
    ax.plot(range(len(rows)), printed, color=BLACK, marker="_", markersize=14, linestyle="none", label="printed")
    names = [f"{domain[4:]} x {domain[4:]}\n{regions}" for domain, regions in rows]
    ax.set(xticks=range(len(rows)), xticklabels=names, xlabel="grid and regions", ylabel=_METRICS["reward_per_step"])
    ax.set_ylim(bottom=0.0)
    ax.spines[["top", "right"]].set_visible(False)
    ax.grid(color="#DDDDDD", linewidth=0.6, axis="y")
    _legend_below(figure, [ax], columns=3)
    return figure


def domain_name(domain: str) -> str:
    """A domain for people."""
    size = domain.removeprefix("grid")
    return _DOMAINS.get(domain, f"gridworld {size} x {size}")


def _draw_methods(ax: Axes, lines: Sequence[dict], x: str, without: Sequence[str] = ()) -> None:
    """A curve per method, in the order of `STYLES`."""
    for method, (label, color, marker, style) in STYLES.items():
        here = [line for line in lines if line["method"] == method]
        if here and method not in without:
            _draw_curve(ax, here, x, label, color, marker, style)


def _draw_curve(ax: Axes, lines: Sequence[dict], x: str, label: str, color, marker: str, style: str) -> None:
    """One curve with its band."""
    lines = sorted(lines, key=lambda line: line[x])
    at, mean, low, high = ([line[name] for line in lines] for name in (x, "mean", "ci_low", "ci_high"))
    # Hollow and larger: where the program as printed becomes k-NN, both curves are to be seen.
    hollow = {"markerfacecolor": "none", "markersize": 8, "zorder": 3} if marker == "D" else {"markersize": 4.5}
    ax.plot(at, mean, color=color, marker=marker, linestyle=style, label=label, linewidth=1.4, **hollow)
    ax.fill_between(at, low, high, color=color, alpha=0.15, linewidth=0)
    ax.spines[["top", "right"]].set_visible(False)
    ax.grid(color="#DDDDDD", linewidth=0.6)


def _grid_of_panels(metrics: Sequence[str], columns: Sequence, width: float = 4.2):
    size = (width * len(columns), 2.9 * len(metrics) + 0.7)
    return plt.subplots(len(metrics), len(columns), figsize=size, squeeze=False, layout="constrained", sharex="col")


def _legend_below(figure: Figure, panels: Iterable[Axes], columns: int) -> None:
    """One legend for all panels."""
    handles = {}
    for ax in panels:
        handles |= dict(zip(*reversed(ax.get_legend_handles_labels()), strict=True))
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=columns, frameon=False)


def _pick(lines: Sequence[dict], **wanted) -> list[dict]:
    """The lines with the given values."""
    return [line for line in lines if all(line[name] == value for name, value in wanted.items())]


def _ordered(values: Iterable, key: Callable | None = None) -> list:
    """Different values, in the order of their first occurrence or sorted by `key`."""
    values = list(dict.fromkeys(values))
    return values if key is None else sorted(values, key=key)
