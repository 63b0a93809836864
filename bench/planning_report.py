"""The tables and the figure of planning's speed, from the rows of `bench.planning_speed` alone."""

import pathlib

from bench.speed_plot import Curves, draw_over_states
from bench.speed_rows import Kind, is_batch, is_ours, is_settled, number

SECTIONS = (
    *("grid16", "grid32", "grid48", "grid100", "grid316"),
    *("racetrack_a", "garnet_dense", "garnet_sparse"),
)
QUICK = ("grid16", "garnet_sparse")
WORKS = {
    "planning": "The value of an optimal policy",
    "occupancy": "Occupancies of a policy",
    "policy_value": "The value of a policy",
}
FIELDS = (
    *("section", "instance", "work", "S", "A", "lanes", "method", "processes", "dtype", "device"),
    *("seconds", "compile_s", "build_s", "error_asked", "error", "settled", "iterations"),
    *("status", "note", "versions", "commit"),
)


def best_peers(rows: list[dict]) -> dict[tuple[str, str, bool], float]:
    """Least seconds per lane of the peers that are accurate enough, by section, work and whether in a batch."""
    best: dict[tuple[str, str, bool], float] = {}
    for row in rows:
        if not is_ours(row) and is_settled(row):
            key = (row["section"], row["work"], is_batch(row))
            best[key] = min(best.get(key, float("inf")), number(row, "seconds"))
    return best


def table(rows: list[dict]) -> str:
    """A Markdown table for each kind of work: methods by rows, one lane and a batch."""
    best = best_peers(rows)
    lines = ["# Speed of planning and of occupancies", "", "Made from the rows of the CSV file of the same name."]
    lines += ["Seconds per lane on the machine's two cores, compilation apart; errors are the worst lane's.", ""]
    for work, title in WORKS.items():
        order = {section: k for k, section in enumerate(SECTIONS)}
        members = [row for row in rows if row["work"] == work]
        members.sort(key=lambda row: (order[row["section"]], not is_ours(row), row["method"], is_batch(row)))
        if not members:
            continue
        lines += [f"## {title}", ""]
        lines += ["| instance | S | lanes | method | s | error | to best peer | compile s |"]
        lines += ["|:--|--:|--:|:--|--:|--:|--:|--:|"] + [_line(row, best) for row in members] + [""]
    failed = [row for row in rows if row["work"] not in WORKS]
    lines += [f"{row['section']}: {row['status']}, {row['note']}" for row in failed]
    return "\n".join(lines)


def _line(row: dict, best: dict) -> str:
    seconds, error, compile_s = (number(row, name) for name in ("seconds", "error", "compile_s"))
    peer = best.get((row["section"], row["work"], is_batch(row)))
    time = row["status"] if seconds is None else f"{seconds:.3g}" + ("" if is_settled(row) else " (inaccurate)")
    ratio = f"{peer / seconds:.2g} times" if peer and seconds and is_ours(row) and is_settled(row) else ""
    cells = [row["instance"], row["S"], row["lanes"], row["method"], time, "" if error is None else f"{error:.1e}"]
    return "| " + " | ".join([*cells, ratio, f"{compile_s:.1f}" if compile_s is not None else ""]) + " |"


def curves(rows: list[dict], work: str) -> Curves:
    """For each package, alone and in a batch, (S, seconds per lane) of the fastest of its methods on the grids."""
    found: dict[tuple[str, bool], dict[int, float]] = {}
    for row in rows:
        if row["work"] == work and row["section"].startswith("grid") and is_settled(row):
            curve, states = found.setdefault((row["method"].split()[0], is_batch(row)), {}), int(row["S"])
            curve[states] = min(curve.get(states, float("inf")), number(row, "seconds"))
    return {name: sorted(curve.items()) for name, curve in found.items()}


def plot(rows: list[dict], path: pathlib.Path) -> None:
    """Seconds per lane against the grids' states, a panel for each kind of work."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    works = [work for work in WORKS if curves(rows, work)]
    figure, all_axes = plt.subplots(1, len(works), figsize=(5.2 * len(works), 5.0), squeeze=False, layout="constrained")
    for axes, work in zip(all_axes[0], works, strict=True):
        draw_over_states(axes, curves(rows, work))
        axes.set_title(WORKS[work])
    all_axes[0, 0].set_ylabel("seconds per lane")
    figure.savefig(path, dpi=130)
    plt.close(figure)


def report(rows: list[dict], path: pathlib.Path) -> None:
    """The tables and the figure, beside the CSV file."""
    path.with_suffix(".md").write_text(table(rows))
    if curves(rows, "planning"):
        plot(rows, path.with_suffix(".png"))


KIND = Kind(
    title="planning and occupancies, against MDP toolboxes and SciPy",
    module="planning_speed",
    sections=SECTIONS,
    quick=QUICK,
    fields=FIELDS,
    shown=("work", "method", "lanes", "seconds", "settled", "status", "note"),
    report=report,
    has_methods=True,
)
