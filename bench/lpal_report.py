"""The table and the figure of LPAL's speed, from the rows of `bench.lpal_speed` alone."""

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

OVER_STATES = ("grid16", "grid24", "grid32", "grid48", "grid100", "grid316")  # one family: the figure's points
_HEADER = "| method | one, s | gap | against best peer | batch | each, s | gap | against best peer | compile s |"


def best_peers(rows: list[dict]) -> dict[tuple[str, bool], float]:
    """Least seconds per lane of the peers that settle an instance, by section and whether in a batch.

    A peer without a row for a batch would solve one lane after another.
    """
    peers = [row for row in rows if not is_ours(row) and is_settled(row)]
    best = least(((row["section"], is_batch(row)), number(row, "seconds")) for row in peers)
    return {(name, True): seconds for (name, _), seconds in best.items()} | best


def table(rows: list[dict]) -> str:
    """A Markdown table for each instance."""
    best = best_peers(rows)
    lines = ["# Speed of LPAL", "", "Made from the rows of the CSV file of the same name. Seconds per lane, on the"]
    lines += ["machine's two cores, compilation apart; gaps are the worst lane's, as a share of what was asked.", ""]
    for section in dict.fromkeys(row["section"] for row in rows):
        members = sorted((row for row in rows if row["section"] == section), key=lambda row: not is_ours(row))
        sizes = ", ".join(f"{name} = {members[0][name]}" for name in ("S", "A", "K") if members[0].get(name))
        lines += [f"## {members[0]['instance'] or section}", "", f"{sizes}." if sizes else "No answer.", ""]
        lines += [_HEADER, "|:--" + "|--:" * 8 + "|"]
        lines += [_line(method, members, best) for method in dict.fromkeys(row["method"] for row in members)] + [""]
    return "\n".join(lines)


def _line(method: str, members: list[dict], best: dict) -> str:
    own = [row for row in members if row["method"] == method]
    single, batch = (next((row for row in own if is_batch(row) == wanted), None) for wanted in (False, True))
    cells = [method or "-", *_cells(single, best), batch["lanes"] if batch else "", *_cells(batch, best)]
    return line([*cells, shown(single, "compile_s", ".1f")])


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
    members = [row for row in rows if row["section"] in OVER_STATES and is_settled(row)]
    return sorted_curves(members, lambda row: (row["method"], is_batch(row)), "S", "seconds")


def figure(rows: list[dict]) -> Figure | None:
    """Seconds per lane against states."""
    panel = ("LPAL to a certified gap of 1e-5 per step, two cores", curves(rows))
    return over_states([panel], (7.2, 5.6)) if panel[1] else None
