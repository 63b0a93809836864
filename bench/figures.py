"""Figure 1 of the paper and the figures of the questions, from summary lines. Bands are 95% confidence intervals.

Colours are those of Okabe and Ito (2008), and every curve has a marker and a line style of its own; ordinal families
(numbers of samples) run through cividis.
"""

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from bench.summaries import paper_table1
from jaxhom.plotting import BLACK, BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILLION

_GREY = "#777777"
STYLES = {
    "expert": ("expert", BLACK, "", "-"),
    "uniform": ("uniform policy", "#BBBBBB", "", "--"),
    "lpal_zeros": ("LPAL fed with zeros", BLACK, "1", ":"),
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
_DOMAINS = {"track_a": "racetrack (a)", "track_b": "racetrack (b)", "track_corner": "corner track", "road": "roads"}
_KINDS = {
    "grid": "gridworld {0} x {0}",
    "wrong": "gridworld {0} x {0}, wrong features",
    "lake": "lake {0} x {0}",
    "tiles": "lake {0} x {0}, tiles",
}


def figure1(lines: pd.DataFrame) -> Figure:
    """Six panels: a row per track; reward, steps and off-roads against the number of demonstrations."""
    tracks, metrics = lines["track"].unique(), [name for name in _METRICS if name in set(lines["metric"])]
    figure, panels = panels_of(len(tracks), len(metrics), (12.5, 3.6 * len(tracks) + 0.9))
    names = iter("abcdefghij")
    for (track, metric), ax in zip(((t, m) for t in tracks for m in metrics), panels.flat, strict=True):
        _draw_methods(ax, pick(lines, track=track, metric=metric), "demonstrations", metric)
        ax.set_title(f"({next(names)}) racetrack ({track})", loc="left", fontsize="medium")
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    return with_legend(figure, columns=3)


def threshold_figure(lines: pd.DataFrame) -> Figure:
    """Off-roads and reward against epsilon, a column per track and distance."""
    columns = list(dict.fromkeys(zip(lines["domain"], lines["distance"], strict=True)))
    figure, panels = panels_of(2, len(columns), (4.2 * len(columns), 6.5), sharex="col")
    for (domain, distance), column in zip(columns, panels.T, strict=True):
        for metric, ax in zip(("off_roads", "reward_per_step"), column, strict=True):
            _draw_methods(ax, pick(lines, metric=metric, domain=domain, distance=distance), "threshold", metric)
        column[0].set_title(f"{_DOMAINS[domain]}, d = {distance}", loc="left", fontsize="medium")
    return with_legend(figure, columns=4)


def noise_figure(lines: pd.DataFrame) -> Figure:
    """Off-roads and reward against epsilon, a curve per number of samples of each transition."""
    figure, panels = panels_of(2, 1, (6.5, 6.5), sharex="col")
    soft = pick(lines, method="soft_local_homomorphism")
    samples = sorted(soft["samples"].unique(), key=lambda count: count or np.inf)
    colors = plt.get_cmap("cividis")(np.linspace(0.0, 0.85, len(samples)))
    for metric, ax in zip(("off_roads", "ratio"), panels.flat, strict=True):
        for count, color, marker in zip(samples, colors, "osD^vPX", strict=False):
            label = f"{count} samples" if count else "true model"
            draw_curve(ax, pick(soft, metric=metric, samples=count), "threshold", label, color, marker, "-")
        here = pick(lines, metric=metric, samples=0, method="manhattan_knn")
        draw_curve(ax, here, "threshold", "k-NN, true model", VERMILLION, "", "--")
        _finish(ax, "threshold", metric)
    return with_legend(figure, columns=3)


def enough_figure(lines: pd.DataFrame) -> Figure:
    """Reward as a share of the expert's against the number of demonstrations, a panel per domain."""
    domains = lines["domain"].unique()
    columns = min(3, len(domains))
    height = -(-len(domains) // columns)
    figure, panels = panels_of(height, columns, (4.2 * columns, 3.3 * height + 0.7))
    for ax in panels.flat[len(domains) :]:
        ax.set_visible(False)
    for domain, ax in zip(domains, panels.flat, strict=False):
        here = pick(lines, metric="ratio", domain=domain)
        _draw_methods(ax, here[here["method"] != "expert"], "demonstrations", "ratio")
        ax.axhline(0.99, color=BLACK, linewidth=0.8, linestyle=(0, (1, 1)))
        ax.set(xscale="log", ylim=(None, 1.02))
        ax.set_title(domain_name(domain), loc="left", fontsize="medium")
    return with_legend(figure, columns=4)


def normalisation_figure(lines: pd.DataFrame) -> Figure:
    """Monte Carlo's reward in the rows of Table I, by two normalisations of its expectations, and as printed."""
    rows = list(dict.fromkeys(zip(lines["domain"], lines["regions"], strict=True)))
    figure, panels = panels_of(1, 1, (8.0, 3.8))
    ax = panels[0, 0]
    for shift, method in ((-0.12, "monte_carlo"), (0.12, "monte_carlo_per_step")):
        label, color, marker, _ = STYLES[method]
        here = pick(lines, metric="reward_per_step", method=method)
        at = [rows.index(row) + shift for row in zip(here["domain"], here["regions"], strict=True)]
        half, style = 0.5 * (here["ci_high"] - here["ci_low"]), {"color": color, "marker": marker, "label": label}
        ax.errorbar(at, here["mean"], half, linestyle="none", capsize=3, **style)
    printed = [paper_table1().get((int(domain[4:]), regions, "monte_carlo")) for domain, regions in rows]
    ax.plot(range(len(rows)), printed, color=BLACK, marker="_", markersize=14, linestyle="none", label="printed")
    names = [f"{domain[4:]} x {domain[4:]}\n{regions}" for domain, regions in rows]
    _finish(ax, "grid and regions", "reward_per_step", axis="y")
    ax.set(xticks=range(len(rows)), xticklabels=names)
    ax.set_ylim(bottom=0.0)
    return with_legend(figure, columns=3)


def heat_map(lines: pd.DataFrame, base: str, base_name: str) -> Figure:
    """Percent of the expert's reward, a row per method, a column per setting; coloured by the difference to `base`."""
    lines = pick(lines, metric="ratio")
    methods = [name for name in lines["method"].unique() if name != "expert"]
    columns = list(dict.fromkeys(zip(lines["domain"], lines["demonstrations"], strict=True)))
    cells = lines.set_index(["method", "domain", "demonstrations"])
    index = pd.MultiIndex.from_tuples([(name, *column) for name in methods for column in columns])
    table, high = (
        100.0 * cells[name].reindex(index).to_numpy(float).reshape(len(methods), -1) for name in ("mean", "ci_high")
    )
    half = high - table
    number = methods.index(base)
    figure, panels = panels_of(1, 1, (2.6 + 0.72 * len(columns), 1.6 + 0.3 * len(methods)))
    ax = panels[0, 0]
    image = ax.imshow(table - table[number], cmap="PuOr_r", vmin=-20.0, vmax=20.0, aspect="auto")
    for (row, column), value in np.ndenumerate(table):
        if not np.isfinite(value):
            continue
        difference = value - table[number, column]
        is_clear = abs(difference) > np.hypot(half[row, column], half[number, column])
        color = "white" if abs(difference) > 14.0 else BLACK
        weight = "bold" if is_clear else "normal"
        ax.text(column, row, f"{value:.1f}", ha="center", va="center", fontsize=7, color=color, fontweight=weight)
    names = [f"{domain_name(domain)}\n{count}" for domain, count in columns]
    ax.set_xticks(range(len(columns)), names, fontsize=7, rotation=90)
    ax.set_yticks(range(len(methods)), methods, fontsize=8)
    ax.set_xlabel("domain, number of demonstrations")
    figure.colorbar(image, ax=ax, label=f"points above {base_name}", extend="both", fraction=0.03)
    return figure


def domain_name(domain: str) -> str:
    """A domain for people."""
    if domain in _DOMAINS:
        return _DOMAINS[domain]
    kind, size = domain.rstrip("0123456789"), domain.lstrip("abcdefghijklmnopqrstuvwxyz_")
    return _KINDS[kind].format(size)


def _draw_methods(ax: Axes, lines: pd.DataFrame, x: str, metric: str) -> None:
    """A curve per method, in the order of `STYLES`."""
    for method, style in STYLES.items():
        here = pick(lines, method=method)
        if len(here):
            draw_curve(ax, here, x, *style)
    _finish(ax, x, metric)


def draw_curve(ax: Axes, lines: pd.DataFrame, x: str, label: str, color, marker: str, style: str) -> None:
    """One curve with its band."""
    lines = lines.sort_values(x)
    # Hollow and larger: where the program as printed becomes k-NN, both curves are to be seen.
    hollow = {"markerfacecolor": "none", "markersize": 8, "zorder": 3} if marker == "D" else {"markersize": 4.5}
    options = {"color": color, "marker": marker, "linestyle": style, "linewidth": 1.4, "label": label}
    ax.plot(lines[x], lines["mean"], **options, **hollow)
    ax.fill_between(lines[x], lines["ci_low"], lines["ci_high"], color=color, alpha=0.15, linewidth=0)


def _finish(ax: Axes, x: str, metric: str, axis: str = "both") -> None:
    """Names of the axes, and a grid."""
    ax.set(xlabel=r"threshold $\epsilon$" if x == "threshold" else x, ylabel=_METRICS[metric])
    ax.spines[["top", "right"]].set_visible(False)
    ax.grid(color="#DDDDDD", linewidth=0.6, axis=axis)


def panels_of(rows: int, columns: int, size: tuple[float, float], **options) -> tuple[Figure, np.ndarray]:
    return plt.subplots(rows, columns, figsize=size, squeeze=False, layout="constrained", **options)


def with_legend(figure: Figure, columns: int) -> Figure:
    """One legend for all panels, below."""
    handles = {}
    for ax in figure.axes:
        handles |= dict(zip(*reversed(ax.get_legend_handles_labels()), strict=True))
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=columns, frameon=False)
    return figure


def pick(lines: pd.DataFrame, **wanted) -> pd.DataFrame:
    """The lines with the given values."""
    return lines[np.logical_and.reduce([lines[name] == value for name, value in wanted.items()])]
