"""What the reports on speed share: reading fields of rows, and log-log figures. Never imports JAX."""

from collections.abc import Callable, Iterable, Sequence

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")  # Okabe and Ito
_MARKERS = "osD^vP*X"

Points = list[tuple[int, float]]  # (size, seconds)
Curves = dict[tuple[str, bool], Points]  # (method, whether in a batch): of the states


def number(row: dict, name: str) -> float | None:
    """A field as a number, None where it is empty."""
    return float(row[name]) if row.get(name) not in (None, "") else None


def shown(row: dict | None, name: str, style: str) -> str:
    """A field in a format; empty where it is."""
    value = None if row is None else number(row, name)
    return "" if value is None else format(value, style)


def is_ours(row: dict) -> bool:
    """Whether a row is of this library."""
    return row["method"].startswith("jaxhom")


def is_batch(row: dict) -> bool:
    """Whether a row is of lanes that are solved together."""
    return (number(row, "lanes") or 1) > 1


def is_settled(row: dict, least: float = 1.0) -> bool:
    """Whether a row has a time, and all its lanes (or at least a share of them) the accuracy that was asked for."""
    return row["status"] == "measured" and (number(row, "settled") or 0.0) >= least


def least(values: Iterable[tuple]) -> dict:
    """The least number of each key, from (key, number)."""
    best: dict = {}
    for key, value in values:
        best[key] = min(best.get(key, float("inf")), value)
    return best


def line(cells: Iterable) -> str:
    """A line of a Markdown table."""
    return "| " + " | ".join(map(str, cells)) + " |"


def style(k: int) -> dict:
    """The k-th colour and marker."""
    return {"color": _COLOURS[k % len(_COLOURS)], "marker": _MARKERS[k % len(_MARKERS)]}


def finish(axes: Axes, curves: Iterable[Points], **legend) -> None:
    """Ticks where there are points, a grid and a legend."""
    ticks = sorted({at for points in curves for at, _ in points})
    axes.set_xticks(ticks, [f"{at:,}" for at in ticks])
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, **legend)


def over_states(panels: Sequence[tuple[str, Curves]], size: tuple[float, float]) -> Figure:
    """Seconds per lane over the number of states: one colour per method, batches dashed, the legend below."""
    figure, all_axes = plt.subplots(1, len(panels), figsize=size, squeeze=False, layout="constrained")
    for axes, (title, curves) in zip(all_axes[0], panels, strict=True):
        methods = list(dict.fromkeys(method for method, _ in curves))
        for (method, batch), points in curves.items():
            k = methods.index(method)
            options = {"linestyle": "--" if batch else "-", "alpha": 1.0 if k < len(_COLOURS) else 0.5, "markersize": 5}
            label = None if batch else method.replace("_", " ")
            axes.loglog(*zip(*points, strict=True), label=label, **style(k), **options)
        axes.plot([], [], linestyle="--", color="grey", label="in a batch")
        axes.set(xlabel="states", title=title)
        finish(axes, curves.values(), ncols=3, loc="upper center", bbox_to_anchor=(0.5, -0.13), frameon=False)
    all_axes[0, 0].set_ylabel("seconds per lane")
    return figure


def sorted_curves(rows: Iterable[dict], key: Callable, x: str, y: str) -> dict:
    """For each key, its points (x, y), the least y of an x, sorted."""
    points: dict = {}
    for (name, at), value in least(((key(row), int(row[x])), number(row, y)) for row in rows).items():
        points.setdefault(name, []).append((at, value))
    return {name: sorted(found) for name, found in points.items()}
