"""Tables and figures of the benchmarks of speed, from their rows alone. Never imports JAX.

A row is a line of the CSV file, all of it text. Ratios say how many times as fast as the best peer we are, of those
peers that are as accurate as was asked.
"""

from collections.abc import Callable, Iterable, Sequence

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")  # Okabe and Ito
_MARKERS = "osD^vP*X"
MADE = "Made from the rows of the CSV file of the same name."

Curves = dict[tuple[str, bool], list[tuple[int, float]]]  # (method, whether in a batch): of (size, seconds)


def number(row: dict | None, name: str) -> float | None:
    """A field as a number, None where it is empty or there is no row."""
    return float(row[name]) if row and row.get(name) not in (None, "") else None


def shown(row: dict | None, **formats: str) -> list[str]:
    """Fields in their formats; empty where they are."""
    numbers = {name: number(row, name) for name in formats}
    return ["" if numbers[name] is None else format(numbers[name], style) for name, style in formats.items()]


def is_ours(row: dict) -> bool:
    """Whether a row is of this library."""
    return row["method"].startswith("jaxhom")


def is_batch(row: dict) -> bool:
    """Whether a row is of lanes that are solved together."""
    return (number(row, "lanes") or 1) > 1


def is_settled(row: dict, share: float = 1.0) -> bool:
    """Whether a row has a time, and all its lanes (or at least a share of them) the accuracy that was asked for."""
    return row["status"] == "measured" and (number(row, "settled") or 0.0) >= share


def least(rows: Iterable[dict], key: Callable, name: str) -> dict:
    """The least value of a field among the rows of each key."""
    best: dict = {}
    for row in rows:
        best[key(row)] = min(best.get(key(row), float("inf")), number(row, name))
    return best


def document(title: str, words: str, parts: Iterable[tuple[str, list[str], list[Sequence]]]) -> str:
    """Markdown: a title, words, and per part a heading, the lines above its table, and the table's cells."""
    lines = [f"# {title}", "", words, ""]
    for heading, above, cells in parts:
        lines += [f"## {heading}", "", *above, *("| " + " | ".join(map(str, row)) + " |" for row in cells), ""]
    return "\n".join(lines)


def curves(rows: Iterable[dict], method: Callable, x: str, y: str) -> Curves:
    """For each method, alone and in a batch, its points (x, y), the least y of an x, sorted."""
    found: Curves = {}
    best = least(rows, lambda row: ((method(row).replace("_", " "), is_batch(row)), int(row[x])), y)
    for (key, at), value in best.items():
        found[key] = sorted([*found.get(key, []), (at, value)])
    return found


def figure(panels: dict[tuple[str, str], Curves], size: tuple[float, float], what: str) -> Figure | None:
    """A log-log panel for each (title, what its x is): one colour per method, batches dashed, the legend below."""
    panels = {words: found for words, found in panels.items() if found}
    if not panels:
        return None
    methods = list(dict.fromkeys(method for found in panels.values() for method, _ in found))
    width, height = size
    made, all_axes = plt.subplots(
        1, len(panels), figsize=(width * len(panels), height), squeeze=False, sharey=True, layout="constrained"
    )
    for axes, ((title, xlabel), found) in zip(all_axes[0], panels.items(), strict=True):
        for (method, batch), points in found.items():
            k = methods.index(method)
            options = {"color": COLOURS[k % len(COLOURS)], "marker": _MARKERS[k % len(_MARKERS)], "markersize": 5}
            options |= {"linestyle": "--" if batch else "-", "alpha": 1.0 if k < len(COLOURS) else 0.5}
            axes.loglog(*zip(*points, strict=True), label=None if batch else method, **options)
        if any(batch for _, batch in found):
            axes.plot([], [], linestyle="--", color="grey", label="in a batch")
        ticks = sorted({at for points in found.values() for at, _ in points})
        axes.set_xticks(ticks, [f"{at:,}" for at in ticks])
        axes.minorticks_off()
        axes.grid(alpha=0.3)
        axes.set(xlabel=xlabel, title=title)
        axes.legend(fontsize=8, ncols=3, loc="upper center", bbox_to_anchor=(0.5, -0.13), frameon=False)
    all_axes[0, 0].set_ylabel(what)
    return made


# --------------------------------------------------------------------------------------------------------- similarity

_MIN_SETTLED = 0.98  # a method that leaves more pairs open is not compared
_PEAK = ("peak", "one PDHG iteration")  # work of another table
_SIMILARITY_HEADER = [
    "| n | m | pairs | method | type | devices | processes | gap | settled | compile s | s | ms/pair"
    " | against best peer |",
    "|" + "---|" * 13,
]
_PEAK_HEADER = ["| work | n | type | us | GFLOP/s | of the peak | GB/s |", "|" + "---|" * 7]


def similarity_table(rows: list[dict]) -> str:
    """A table for each kind of work, and one of the distance from the machine's peak."""
    peers = [row for row in rows if not is_ours(row) and is_settled(row, _MIN_SETTLED)]
    best = least(peers, lambda row: (row["work"], row["n"]), "ms_per_pair")
    # The peers have no decisions: a solve in full stands in for one.
    best |= {("decisions", n): time for (work, n), time in best.items() if work == "brackets"}
    parts = []
    for work in dict.fromkeys(row["work"] for row in rows if row["work"] not in _PEAK):
        members = sorted((row for row in rows if row["work"] == work), key=lambda row: number(row, "n") or 0.0)
        cells = [_similarity_cells(row, best.get((work, row["n"]))) for row in members]
        parts.append((work, _SIMILARITY_HEADER, cells))
    if peak := [row for row in rows if row["work"] in _PEAK]:
        parts.append(("Distance from the machine's peak", _PEAK_HEADER, [_peak_cells(row) for row in peak]))
    return document("Speed of the similarity engine", MADE, parts)


def _similarity_cells(row: dict, peer: float | None) -> list:
    time = number(row, "ms_per_pair")
    ratio = f"{peer / time:.1f} times" if time and peer and is_ours(row) else ""
    method = row["method"] + (f" ({row['status']})" if row["status"] != "measured" else "")
    formats = {"gap_certified": ".1e", "settled": ".3f", "compile_s": ".1f", "seconds": ".3g", "ms_per_pair": ".3g"}
    texts = [row["n"], row["m"], row["pairs"], method, row["dtype"], row["devices"], row["processes"]]
    return [*texts, *shown(row, **formats), ratio]


def _peak_cells(row: dict) -> list:
    texts = [f"{row['work']}: {row['method']}", row["n"], row["dtype"], f"{1e6 * number(row, 'seconds'):.3g}"]
    return [*texts, *shown(row, gflops=".3g", peak_fraction=".1%", gbytes_per_s=".3g")]


def similarity_figure(rows: list[dict]) -> Figure | None:
    """Time per pair against the size of the models and against the number of pairs."""

    def method(row: dict) -> str:
        return row["method"] + (", float32" if row["dtype"] == "float32" else "")

    def panel(work: str, x: str) -> Curves:
        members = [row for row in rows if row["work"] == work and is_settled(row, _MIN_SETTLED)]
        return curves(members, method, x, "ms_per_pair")

    panels = {
        ("Brackets of 1e-4, random pairs, 4 actions", "states of each model (n = m)"): panel("brackets", "n"),
        ("The more pairs at once", "pairs of five states"): panel("counts", "pairs"),
    }
    return figure(panels, (5.2, 4.8), "milliseconds per pair, two cores")


# --------------------------------------------------------------------------------------------------------------- LPAL

OVER_STATES = ("grid16", "grid24", "grid32", "grid48", "grid100", "grid316")  # one family: the figure's points
_LPAL_WORDS = f"""{MADE} Seconds per lane, on the
machine's two cores, compilation apart; gaps are the worst lane's, as a share of what was asked."""
_LPAL_HEADER = [
    "| method | one, s | gap | against best peer | batch | each, s | gap | against best peer | compile s |",
    "|:--" + "|--:" * 8 + "|",
]
_OURS_HEADER = [
    "| instance | one: quickest of ours | s | default takes | batch: quickest of ours | each, s | default takes |",
    "|:--|:--|--:|--:|:--|--:|--:|",
]
_DEFAULT = "jaxhom"


def lpal_best_peers(rows: list[dict]) -> dict[tuple[str, bool], float]:
    """Least seconds per lane of the peers that settle an instance, by section and whether in a batch.

    A peer without a row for a batch would solve one lane after another.
    """
    peers = [row for row in rows if not is_ours(row) and is_settled(row)]
    best = least(peers, lambda row: (row["section"], is_batch(row)), "seconds")
    return {(name, True): seconds for (name, _), seconds in best.items()} | best


def lpal_quickest_of_ours(rows: list[dict]) -> dict[tuple[str, bool], tuple[dict, float | None]]:
    """By section and whether in a batch: our quickest row, and how many times as long the default method takes.

    None where the default has no row, or leaves lanes open.
    """
    found: dict = {}
    for row in sorted(filter(is_ours, filter(is_settled, rows)), key=lambda row: number(row, "seconds")):
        found.setdefault((row["section"], is_batch(row)), []).append(row)
    times = {}
    for key, members in found.items():
        default = next((row for row in members if row["method"] == _DEFAULT), None)
        times[key] = members[0], number(default, "seconds") / number(members[0], "seconds") if default else None
    return times


def _ours_cells(name: str, section: str, quickest: dict) -> list[str]:
    """One line: the instance, and for one lane and for a batch who is the quickest."""
    cells = [name]
    for batch in (False, True):
        row, ratio = quickest.get((section, batch), (None, None))
        method = "" if row is None else "default" if row["method"] == _DEFAULT else row["method"].split()[-1]
        cells += [method.replace("_", " "), *shown(row, seconds=".3g"), "" if ratio is None else f"{ratio:.2f} times"]
    return cells


def lpal_table(rows: list[dict]) -> str:
    """Who of ours is the quickest, and a table for each instance: a line per method, one lane and a batch."""
    best, quickest = lpal_best_peers(rows), lpal_quickest_of_ours(rows)
    names = {row["section"]: row.get("instance") or row["section"] for row in rows}
    ours = [_ours_cells(name, section, quickest) for section, name in names.items()]
    parts = [("The default against each of our methods", _OURS_HEADER, ours)]
    for section in dict.fromkeys(row["section"] for row in rows):
        members = sorted((row for row in rows if row["section"] == section), key=lambda row: not is_ours(row))
        sizes = ", ".join(f"{name} = {members[0][name]}" for name in ("S", "A", "K") if members[0].get(name))
        above = [f"{sizes}." if sizes else "No answer.", "", *_LPAL_HEADER]
        found = {(row["method"], is_batch(row)): row for row in reversed(members)}
        cells = []
        for method in dict.fromkeys(row["method"] for row in members):
            one, batch = found.get((method, False)), found.get((method, True))
            lanes = batch["lanes"] if batch else ""
            middle = [*_lpal_cells(one, best), lanes, *_lpal_cells(batch, best)]
            cells.append([method or "-", *middle, *shown(one, compile_s=".1f")])
        parts.append((members[0]["instance"] or section, above, cells))
    return document("Speed of LPAL", _LPAL_WORDS, parts)


def _lpal_cells(row: dict | None, best: dict) -> list[str]:
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


def lpal_curves(rows: list[dict]) -> Curves:
    """(S, seconds per lane) of the instances with perturbed regions."""
    members = [row for row in rows if row["section"] in OVER_STATES and is_settled(row)]
    return curves(members, lambda row: row["method"], "S", "seconds")


def lpal_figure(rows: list[dict]) -> Figure | None:
    """Seconds per lane against states."""
    title = "LPAL to a certified gap of 1e-5 per step, two cores"
    return figure({(title, "states"): lpal_curves(rows)}, (7.2, 5.6), "seconds per lane")


# ----------------------------------------------------------------------------------------------------------- planning

WORKS = {
    "planning": "The value of an optimal policy",
    "occupancy": "Occupancies of a policy",
    "policy_value": "The value of a policy",
}
_PLANNING_WORDS = f"""{MADE}
Seconds per lane on the machine's two cores, compilation apart; errors are the worst lane's."""
_PLANNING_HEADER = [
    "| instance | S | lanes | method | s | error | to best peer | compile s |",
    "|:--|--:|--:|:--|--:|--:|--:|--:|",
]


def planning_table(rows: list[dict]) -> str:
    """A table for each kind of work: a line per instance, method and number of lanes."""

    def case(row: dict) -> tuple:
        return row["section"], row["work"], is_batch(row)

    best = least([row for row in rows if not is_ours(row) and is_settled(row)], case, "seconds")
    sections, parts = list(dict.fromkeys(row["section"] for row in rows)), []
    for work in WORKS:
        members = [row for row in rows if row["work"] == work]
        members.sort(key=lambda row: (sections.index(row["section"]), not is_ours(row), row["method"], is_batch(row)))
        if members:
            cells = [_planning_cells(row, best.get(case(row))) for row in members]
            parts.append((WORKS[work], _PLANNING_HEADER, cells))
    failed = [f"{row['section']}: {row['status']}, {row['note']}" for row in rows if row["work"] not in WORKS]
    return "\n".join([document("Speed of planning and of occupancies", _PLANNING_WORDS, parts), *failed])


def _planning_cells(row: dict, peer: float | None) -> list:
    seconds = number(row, "seconds")
    time = row["status"] if seconds is None else f"{seconds:.3g}" + ("" if is_settled(row) else " (inaccurate)")
    ratio = f"{peer / seconds:.2g} times" if peer and seconds and is_ours(row) and is_settled(row) else ""
    texts = [row["instance"], row["S"], row["lanes"], row["method"], time]
    return [*texts, *shown(row, error=".1e"), ratio, *shown(row, compile_s=".1f")]


def planning_figure(rows: list[dict]) -> Figure | None:
    """Seconds per lane against the grids' states, for each kind of work; of a package the fastest of its methods."""
    panels = {}
    for work, title in WORKS.items():
        grids = [row for row in rows if row["work"] == work and row["section"].startswith("grid") and is_settled(row)]
        panels[title, "states"] = curves(grids, lambda row: row["method"].split()[0], "S", "seconds")
    return figure(panels, (5.2, 5.0), "seconds per lane")
