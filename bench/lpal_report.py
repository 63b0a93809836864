"""The table and the figure of LPAL's speed, from the rows of `bench.lpal_speed` alone."""

import pathlib

from bench.speed_plot import Curves, draw_over_states
from bench.speed_rows import Kind, is_batch, is_ours, is_settled, number

SECTIONS = (  # the instances, small ones first
    *("grid16", "grid16_exact", "grid16_monte_carlo", "grid24", "bumps24", "grid32", "grid48", "grid48_exact"),
    *("grid48_monte_carlo", "garnet", "racetrack_a", "racetrack_b", "bumps48", "grid100", "grid316"),
)
OVER_STATES = ("grid16", "grid24", "grid32", "grid48", "grid100", "grid316")  # one family: the figure's points
QUICK = ("grid16", "racetrack_b")
FIELDS = (
    *("section", "instance", "S", "A", "K", "lanes", "method", "processes", "dtype", "device"),
    *("seconds", "compile_s", "build_s", "gap_asked", "gap_certified", "settled", "iterations"),
    *("status", "note", "versions", "commit"),
)


def best_peers(rows: list[dict]) -> dict[tuple[str, bool], float]:
    """Least seconds per lane of the peers that settle an instance, by section and whether in a batch.

    A peer without a row for a batch would solve one lane after another.
    """
    best: dict[tuple[str, bool], float] = {}
    for row in rows:
        if not is_ours(row) and is_settled(row):
            key = (row["section"], is_batch(row))
            best[key] = min(best.get(key, float("inf")), number(row, "seconds"))
    for (name, batch), seconds in list(best.items()):
        if not batch:
            best.setdefault((name, True), seconds)
    return best


def table(rows: list[dict]) -> str:
    """A Markdown table for each instance."""
    best = best_peers(rows)
    lines = ["# Speed of LPAL", "", "Made from the rows of the CSV file of the same name. Seconds per lane, on the"]
    lines += ["machine's two cores, compilation apart; gaps are the worst lane's, as a share of what was asked.", ""]
    for section in dict.fromkeys(row["section"] for row in rows):
        members = sorted((row for row in rows if row["section"] == section), key=lambda row: not is_ours(row))
        lines += _heading(members)
        lines += [
            "| method | one, s | gap | against best peer | batch | each, s | gap | against best peer | compile s |"
        ]
        lines += ["|:--" + "|--:" * 8 + "|"]
        lines += [_line(method, members, best) for method in dict.fromkeys(row["method"] for row in members)] + [""]
    return "\n".join(lines)


def _heading(members: list[dict]) -> list[str]:
    first = members[0]
    sizes = ", ".join(f"{name} = {first[name]}" for name in ("S", "A", "K") if first.get(name))
    return [f"## {first['instance'] or first['section']}", "", f"{sizes}." if sizes else "No answer.", ""]


def _line(method: str, members: list[dict], best: dict) -> str:
    own = [row for row in members if row["method"] == method]
    single = next((row for row in own if not is_batch(row)), None)
    batch = next((row for row in own if is_batch(row)), None)
    compile_s = number(single, "compile_s") if single else None
    cells = [method or "-", *_cells(single, best), batch["lanes"] if batch else "", *_cells(batch, best)]
    return "| " + " | ".join([*cells, f"{compile_s:.1f}" if compile_s is not None else ""]) + " |"


def _cells(row: dict | None, best: dict) -> list[str]:
    """Time or status, gap, and how many times as fast as the best peer."""
    if row is None:
        return ["", "", ""]
    seconds, gap = number(row, "seconds"), number(row, "gap_certified")
    if row["status"] != "measured" or seconds is None:
        return [row["note"].split(" (")[0] if row["status"] == "time limit" else row["status"], "", ""]
    share = "" if gap is None else f"{gap / number(row, 'gap_asked'):.2g}"
    if not is_settled(row):
        return [f"{seconds:.3g} (open)", share, ""]
    peer = best.get((row["section"], is_batch(row)))
    return [f"{seconds:.3g}", share, f"{peer / seconds:.2g} times" if peer and is_ours(row) else ""]


def curves(rows: list[dict]) -> Curves:
    """For each method, alone and in a batch, (S, seconds per lane) of the instances with perturbed regions."""
    found: Curves = {}
    for row in rows:
        if row["section"] in OVER_STATES and is_settled(row):
            point = (int(row["S"]), number(row, "seconds"))
            found.setdefault((row["method"], is_batch(row)), []).append(point)
    return {name: sorted(points) for name, points in found.items()}


def plot(rows: list[dict], path: pathlib.Path) -> None:
    """Seconds per lane against states."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7.2, 5.6), layout="constrained")
    draw_over_states(axes, curves(rows))
    axes.set(ylabel="seconds per lane", title="LPAL to a certified gap of 1e-5 per step, two cores")
    figure.savefig(path, dpi=130)
    plt.close(figure)


def report(rows: list[dict], path: pathlib.Path) -> None:
    """The table and the figure, beside the CSV file."""
    path.with_suffix(".md").write_text(table(rows))
    if curves(rows):
        plot(rows, path.with_suffix(".png"))


KIND = Kind(
    title="LPAL, against other LP solvers",
    module="lpal_speed",
    sections=SECTIONS,
    quick=QUICK,
    fields=FIELDS,
    shown=("method", "lanes", "seconds", "settled", "status", "note"),
    report=report,
    has_methods=True,
)
