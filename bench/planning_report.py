"""The tables and the figure of planning's speed, from the rows of `bench.planning_speed` alone."""

from matplotlib.figure import Figure

from bench.speed_report import (
    Curves,
    is_batch,
    is_ours,
    is_settled,
    least,
    line,
    number,
    over_states,
    shown,
    sorted_curves,
)

SECTIONS = ("grid16", "grid32", "grid48", "grid100", "grid316", "racetrack_a", "garnet_dense", "garnet_sparse")
WORKS = {
    "planning": "The value of an optimal policy",
    "occupancy": "Occupancies of a policy",
    "policy_value": "The value of a policy",
}


def _case(row: dict) -> tuple[str, str, bool]:
    return row["section"], row["work"], is_batch(row)


def table(rows: list[dict]) -> str:
    """A Markdown table for each kind of work: methods by rows, one lane and a batch."""
    best = least((_case(row), number(row, "seconds")) for row in rows if not is_ours(row) and is_settled(row))
    lines = ["# Speed of planning and of occupancies", "", "Made from the rows of the CSV file of the same name."]
    lines += ["Seconds per lane on the machine's two cores, compilation apart; errors are the worst lane's.", ""]
    for work, title in WORKS.items():
        members = [row for row in rows if row["work"] == work]
        if not members:
            continue
        members.sort(key=lambda row: (SECTIONS.index(row["section"]), not is_ours(row), row["method"], is_batch(row)))
        lines += [f"## {title}", ""]
        lines += ["| instance | S | lanes | method | s | error | to best peer | compile s |"]
        lines += ["|:--|--:|--:|:--|--:|--:|--:|--:|"] + [_line(row, best.get(_case(row))) for row in members] + [""]
    failed = [row for row in rows if row["work"] not in WORKS]
    lines += [f"{row['section']}: {row['status']}, {row['note']}" for row in failed]
    return "\n".join(lines)


def _line(row: dict, peer: float | None) -> str:
    seconds = number(row, "seconds")
    time = row["status"] if seconds is None else f"{seconds:.3g}" + ("" if is_settled(row) else " (inaccurate)")
    ratio = f"{peer / seconds:.2g} times" if peer and seconds and is_ours(row) and is_settled(row) else ""
    cells = [row["instance"], row["S"], row["lanes"], row["method"], time, shown(row, "error", ".1e"), ratio]
    return line([*cells, shown(row, "compile_s", ".1f")])


def curves(rows: list[dict], work: str) -> Curves:
    """For each package, alone and in a batch, (S, seconds per lane) of the fastest of its methods on the grids."""
    members = [r for r in rows if r["work"] == work and r["section"].startswith("grid") and is_settled(r)]
    return sorted_curves(members, lambda row: (row["method"].split()[0], is_batch(row)), "S", "seconds")


def figure(rows: list[dict]) -> Figure | None:
    """Seconds per lane against the grids' states, a panel for each kind of work."""
    panels = [(title, found) for work, title in WORKS.items() if (found := curves(rows, work))]
    return over_states(panels, (5.2 * len(panels), 5.0)) if panels else None
