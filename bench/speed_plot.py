"""Seconds per lane over the number of states, as the figures of LPAL and of planning show them."""

from bench.speed_rows import COLOURS, MARKERS

Curves = dict[tuple[str, bool], list[tuple[int, float]]]  # (method, whether in a batch): (S, seconds per lane)


def draw_over_states(axes, curves: Curves) -> None:
    """Both axes logarithmic, one colour per method, batches dashed, the legend below."""
    methods = list(dict.fromkeys(method for method, _ in curves))
    for (method, batch), points in curves.items():
        k = methods.index(method)
        style = {"color": COLOURS[k % len(COLOURS)], "marker": MARKERS[k % len(MARKERS)], "markersize": 5}
        style |= {"linestyle": "--" if batch else "-", "alpha": 1.0 if k < len(COLOURS) else 0.5}
        axes.loglog(*zip(*points, strict=True), label=None if batch else method.replace("_", " "), **style)
    axes.plot([], [], linestyle="--", color="grey", label="in a batch")
    ticks = sorted({states for points in curves.values() for states, _ in points})
    axes.set_xticks(ticks, [f"{states:,}" for states in ticks])
    axes.minorticks_off()
    axes.set_xlabel("states")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, ncols=3, loc="upper center", bbox_to_anchor=(0.5, -0.13), frameon=False)
