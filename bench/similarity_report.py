"""The table and the figure of the similarity engine's speed, from the rows of `bench.similarity_speed` alone."""

import pathlib

from bench.speed_rows import COLOURS, MARKERS, Kind, is_ours, number

FIELDS = (
    *("section", "work", "n", "m", "actions", "pairs", "method", "dtype", "device", "devices", "processes"),
    *("gap_asked", "gap_certified", "settled", "compile_s", "build_s", "seconds", "ms_per_pair"),
    *("gflops", "peak_fraction", "gbytes_per_s", "status", "note", "versions", "commit"),
)
SECTIONS = (
    *("peak", "brackets", "counts", "decisions", "gradients", "peers"),
    *("racetrack", "algorithm1", "global", "global_large"),
)
QUICK = ("brackets", "decisions", "gradients", "peers")
_MIN_SETTLED = 0.98


def best_peers(rows: list[dict]) -> dict[tuple[str, str], float]:
    """Least time per pair among the peers that certify nearly every pair, by work and n.

    The peers have no decisions: a solve in full stands in for one.
    """
    best: dict[tuple[str, str], float] = {}
    for row in rows:
        if is_ours(row) or row["status"] != "measured" or (number(row, "settled") or 0.0) < _MIN_SETTLED:
            continue
        works = ("brackets", "decisions") if row["work"] == "brackets" else (row["work"],)
        for work in works:
            key = (work, row["n"])
            best[key] = min(best.get(key, float("inf")), float(row["ms_per_pair"]))
    return best


def table(rows: list[dict]) -> str:
    """A Markdown table for each kind of work."""
    best = best_peers(rows)
    lines = ["# Speed of the similarity engine", "", "Made from the rows of the CSV file of the same name.", ""]
    for work in dict.fromkeys(row["work"] for row in rows):
        if work in ("peak", "one PDHG iteration"):
            continue
        lines += [
            f"## {work}",
            "",
            "| n | m | pairs | method | type | devices | processes | gap | settled | compile s | s |"
            " ms/pair | against best peer |",
            "|" + "---|" * 13,
        ]
        members = [row for row in rows if row["work"] == work]
        lines += [_table_line(row, best) for row in sorted(members, key=lambda row: number(row, "n") or 0.0)] + [""]
    return "\n".join(lines + _peak_table(rows))


def _table_line(row: dict, best: dict) -> str:
    time, peer = number(row, "ms_per_pair"), best.get((row["work"], row["n"]))
    ratio = f"{peer / time:.1f} times" if time and peer and is_ours(row) else ""
    method = row["method"] + (f" ({row['status']})" if row["status"] != "measured" else "")
    cells = [row["n"], row["m"], row["pairs"], method, row["dtype"], row["devices"], row["processes"]]
    for name, style in (("gap_certified", ".1e"), ("settled", ".3f"), ("compile_s", ".1f"), ("seconds", ".3g")):
        value = number(row, name)
        cells.append("" if value is None else format(value, style))
    return "| " + " | ".join([*cells, f"{time:.3g}" if time else "", ratio]) + " |"


def _peak_table(rows: list[dict]) -> list[str]:
    found = [row for row in rows if row["work"] in ("peak", "one PDHG iteration")]
    if not found:
        return []
    lines = ["## Distance from the machine's peak", "", "| work | n | type | us | GFLOP/s | of the peak | GB/s |"]
    lines.append("|" + "---|" * 7)
    for row in found:
        fraction, rate = number(row, "peak_fraction"), number(row, "gbytes_per_s")
        cells = [f"{row['work']}: {row['method']}", row["n"], row["dtype"], f"{1e6 * float(row['seconds']):.3g}"]
        cells += [f"{float(row['gflops']):.3g}", f"{fraction:.1%}" if fraction else "", f"{rate:.3g}" if rate else ""]
        lines.append("| " + " | ".join(cells) + " |")
    return [*lines, ""]


def curves(rows: list[dict], work: str, by: str) -> dict[str, list[tuple[int, float]]]:
    """For each method and type, (rows' `by`, ms per pair)."""
    found: dict[str, list[tuple[int, float]]] = {}
    for row in rows:
        if row["work"] == work and row["status"] == "measured" and (number(row, "settled") or 0.0) >= _MIN_SETTLED:
            name = row["method"].replace("_", " ") + (", float32" if row["dtype"] == "float32" else "")
            found.setdefault(name, []).append((int(row[by]), float(row["ms_per_pair"])))
    return {name: sorted(points) for name, points in found.items()}


def plot(rows: list[dict], path: pathlib.Path) -> None:
    """Time per pair against the size of the models and against the number of pairs, all axes logarithmic."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    panels = (
        ("brackets", "n", "states of each model (n = m)", "the more states"),
        ("counts", "pairs", "pairs of five states", "the more pairs"),
    )
    styles: dict[str, dict] = {}
    figure, all_axes = plt.subplots(1, 2, figsize=(10.4, 4.4), layout="constrained", sharey=True)
    for axes, (work, by, label, title) in zip(all_axes, panels, strict=True):
        for name, points in curves(rows, work, by).items():
            k = len(styles)
            line = "-" if name.startswith("jaxhom") else "--"
            style = {"color": COLOURS[k % len(COLOURS)], "marker": MARKERS[k % len(MARKERS)], "linestyle": line}
            axes.loglog(*zip(*points, strict=True), label=name, **styles.setdefault(name, style))
        ticks = sorted({at for points in curves(rows, work, by).values() for at, _ in points})
        axes.set_xticks(ticks, [str(at) for at in ticks])
        axes.minorticks_off()
        axes.set(xlabel=label, title=title)
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    all_axes[0].set_ylabel("milliseconds per pair")
    figure.suptitle("Certified brackets of 1e-4, random pairs with 4 actions, two cores")
    figure.savefig(path, dpi=130)
    plt.close(figure)


def report(rows: list[dict], path: pathlib.Path) -> None:
    """The table and the figure, beside the CSV file."""
    path.with_suffix(".md").write_text(table(rows))
    if curves(rows, "brackets", "n"):
        plot(rows, path.with_suffix(".png"))


KIND = Kind(
    title="local and global homomorphisms, against other LP solvers",
    module="similarity_speed",
    sections=SECTIONS,
    quick=QUICK,
    fields=FIELDS,
    shown=("work", "method", "dtype", "n", "pairs", "ms_per_pair"),
    report=report,
)
