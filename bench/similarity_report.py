"""The table and the figure of the similarity engine's speed, from the rows of `bench.similarity_speed` alone."""

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from bench.speed_report import Points, finish, is_ours, is_settled, least, line, number, shown, sorted_curves, style

_MIN_SETTLED = 0.98  # a method that leaves more pairs open is not compared
_PEAK = ("peak", "one PDHG iteration")  # work of another table
_HEADER = (
    "| n | m | pairs | method | type | devices | processes | gap | settled | compile s | s |"
    " ms/pair | against best peer |"
)


def _best_peers(rows: list[dict]) -> dict[tuple[str, str], float]:
    """Least time per pair among the peers that certify nearly every pair, by work and n.

    The peers have no decisions: a solve in full stands in for one.
    """
    peers = [row for row in rows if not is_ours(row) and is_settled(row, _MIN_SETTLED)]
    works = {"brackets": ("brackets", "decisions")}
    return least(
        ((work, row["n"]), number(row, "ms_per_pair"))
        for row in peers
        for work in works.get(row["work"], (row["work"],))
    )


def table(rows: list[dict]) -> str:
    """A Markdown table for each kind of work."""
    best = _best_peers(rows)
    lines = ["# Speed of the similarity engine", "", "Made from the rows of the CSV file of the same name.", ""]
    for work in dict.fromkeys(row["work"] for row in rows if row["work"] not in _PEAK):
        members = sorted((row for row in rows if row["work"] == work), key=lambda row: number(row, "n") or 0.0)
        lines += [f"## {work}", "", _HEADER, "|" + "---|" * 13]
        lines += [_line(row, best.get((work, row["n"]))) for row in members] + [""]
    return "\n".join(lines + _peak_table([row for row in rows if row["work"] in _PEAK]))


def _line(row: dict, peer: float | None) -> str:
    time = number(row, "ms_per_pair")
    ratio = f"{peer / time:.1f} times" if time and peer and is_ours(row) else ""
    method = row["method"] + (f" ({row['status']})" if row["status"] != "measured" else "")
    cells = [row["n"], row["m"], row["pairs"], method, row["dtype"], row["devices"], row["processes"]]
    styles = {"gap_certified": ".1e", "settled": ".3f", "compile_s": ".1f", "seconds": ".3g", "ms_per_pair": ".3g"}
    return line([*cells, *(shown(row, *style) for style in styles.items()), ratio])


def _peak_table(rows: list[dict]) -> list[str]:
    if not rows:
        return []
    lines = ["## Distance from the machine's peak", "", "| work | n | type | us | GFLOP/s | of the peak | GB/s |"]
    lines.append("|" + "---|" * 7)
    for row in rows:
        cells = [f"{row['work']}: {row['method']}", row["n"], row["dtype"], f"{1e6 * float(row['seconds']):.3g}"]
        styles = {"gflops": ".3g", "peak_fraction": ".1%", "gbytes_per_s": ".3g"}
        lines.append(line([*cells, *(shown(row, *style) for style in styles.items())]))
    return [*lines, ""]


def _curves(rows: list[dict], work: str, by: str) -> dict[str, Points]:
    """For each method and type, (rows' `by`, ms per pair)."""

    def name(row):
        return row["method"].replace("_", " ") + (", float32" if row["dtype"] == "float32" else "")

    members = [row for row in rows if row["work"] == work and is_settled(row, _MIN_SETTLED)]
    return sorted_curves(members, name, by, "ms_per_pair")


def figure(rows: list[dict]) -> Figure | None:
    """Time per pair against the size of the models and against the number of pairs, all axes logarithmic."""
    panels = {
        ("brackets", "n"): {"xlabel": "states of each model (n = m)", "title": "the more states"},
        ("counts", "pairs"): {"xlabel": "pairs of five states", "title": "the more pairs"},
    }
    curves = {panel: _curves(rows, *panel) for panel in panels}
    if not curves["brackets", "n"]:
        return None
    names = list(dict.fromkeys(name for found in curves.values() for name in found))
    figure, all_axes = plt.subplots(1, 2, figsize=(10.4, 4.4), layout="constrained", sharey=True)
    for axes, (panel, words) in zip(all_axes, panels.items(), strict=True):
        for name, points in curves[panel].items():
            line_style = "-" if name.startswith("jaxhom") else "--"
            axes.loglog(*zip(*points, strict=True), label=name, linestyle=line_style, **style(names.index(name)))
        axes.set(**words)
        if curves[panel]:
            finish(axes, curves[panel].values())
    all_axes[0].set_ylabel("milliseconds per pair")
    figure.suptitle("Certified brackets of 1e-4, random pairs with 4 actions, two cores")
    return figure
