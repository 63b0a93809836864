"""The table and the bars of `python -m bench.speed first`, from its rows alone. Never imports JAX."""

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from bench.speed_report import COLOURS, MADE, document, is_ours, number, shown

_WORDS = f"""{MADE}
A step is measured in fresh processes, three for a row, in which nothing else was computed: the first call, and the
second one. "kept" is with the programs that a run before has left in the folder for caches. Of a command the whole
process counts. The other sections are processes of their own, in which the first call compiles what it needs. Pairs
are random local models; a draw goes from a key to the value of the learned policy. "settled" is the share of pairs that
are, or of draws whose votes and radii are those of the plain calls, and whose certificates overlap theirs and are
closed; of draws without plain calls beside them, the share of closed certificates."""
_STEPS_HEADER = ["| step | method | programs | first call s | second ms |", "|:--|:--|:--|--:|--:|"]
_HEADER = [
    "| method | number | devices | prepared s | first call s | ms each | GB | settled |",
    "|:--|--:|--:|--:|--:|--:|--:|--:|",
]
_KINDS = {
    "jaxhom": lambda row: is_ours(row) and row["cache"] == "none",
    "jaxhom, programs kept": lambda row: row["cache"] == "kept",
    "peer": lambda row: not is_ours(row),
}


def table(rows: list[dict]) -> str:
    """The steps in one table, and one for each domain: a line per row."""
    measured = [row for row in rows if row["status"] == "measured"]
    steps = [row for row in measured if row["section"] == "steps"]
    parts = [("steps and commands in fresh processes", _STEPS_HEADER, [_step_cells(row) for row in steps])] * bool(
        steps
    )
    others = [row for row in measured if row["section"] != "steps"]
    for title in dict.fromkeys(row["instance"] for row in others):
        members = [row for row in others if row["instance"] == title]
        parts.append((title, _HEADER, [_cells(row) for row in members]))
    failed = [f"{row['section']}: {row['status']}, {row['note']}" for row in rows if row["status"] != "measured"]
    return "\n".join([document("The first answer", _WORDS, parts), *failed])


def _step_cells(row: dict) -> list:
    seconds = number(row, "seconds")
    second = "" if seconds is None else f"{1e3 * seconds:.3g}"
    return [row["instance"], row["method"], row["cache"], *shown(row, first_s=".2g"), second]


def figure(rows: list[dict]) -> Figure | None:
    """Bars: seconds of the first call of every step, cold, with kept programs, and of a peer."""
    rows = [row for row in rows if row["section"] == "steps" and row["status"] == "measured"]
    steps = list(dict.fromkeys(row["instance"] for row in rows))[::-1]
    if not steps:
        return None
    drawn, axes = plt.subplots(figsize=(7.0, 0.5 * len(steps) + 1.0), layout="constrained")
    height = 0.8 / len(_KINDS)
    for place, (label, belongs) in enumerate(_KINDS.items()):
        members = {row["instance"]: row for row in rows if belongs(row)}
        seconds = [number(members.get(step), "first_s") for step in steps]
        at = [where + (1 - place) * height for where in range(len(steps))]
        axes.barh(at, [one or 0.0 for one in seconds], height, color=COLOURS[place], label=label)
        for y, x, step in zip(at, seconds, steps, strict=True):
            if x is not None:
                name = "" if is_ours(members[step]) else members[step]["method"].split("_")[0]
                axes.annotate(f" {x:.2g} {name}", (x, y), va="center", fontsize=7)
    axes.set(xscale="log", xlabel="seconds of the first call in a fresh process")
    axes.set_yticks(range(len(steps)), steps, fontsize=8)
    axes.margins(x=0.15, y=0.02)
    drawn.legend(fontsize=8, loc="outside upper right", ncols=len(_KINDS))
    return drawn


def _cells(row: dict) -> list:
    times = shown(row, prepare_s=".2g", first_s=".2g")
    seconds = number(row, "seconds")
    draw = "" if seconds is None else f"{1e3 * seconds:.3g}"
    return [row["method"], row["draws"], row["devices"], *times, draw, *shown(row, peak_gb=".2g", settled=".0%")]
