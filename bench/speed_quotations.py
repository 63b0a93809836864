"""What pages say of speed, made from the rows of `bench.speed`, `scale` and `sweep_costs`: for `bench.quotations`."""

from __future__ import annotations

import csv
import math
import pathlib
from collections.abc import Callable, Iterator

import pandas as pd

from bench import scale, sweep_costs
from bench.speed_report import is_batch, is_ours, is_settled, number
from jaxhom import sweeps

_NAMES = {
    "clarabel": "Clarabel",
    "glop": "GLOP",
    "highs_interior_point": "HiGHS",
    "highs_simplex": "HiGHS",
    "moreau": "Moreau",
}
"""Of solvers, as their authors write them."""
_LPAL = {
    "bumps24": "24x24 grid, 64 overlapping bumps",
    "bumps48": "48x48 grid, 64 overlapping bumps",
    "grid100": "100x100 grid, 100 regions, perturbed",
    "racetrack_a": "racetrack (a), 5900 states, Monte Carlo",
    "racetrack_b": "racetrack (b), 5100 states, Monte Carlo",
    "garnet": "dense Garnet, 500 states, 32 features",
    "grid48_exact": "48x48 grid, 64 regions, expectations of a policy",
    "grid48": "48x48 grid, 64 regions, perturbed",
    "grid24": "24x24 grid, 64 regions, perturbed",
    "grid16": "16x16 grid, 64 regions, perturbed",
}
"""What the README calls the sections that it quotes."""
_SIZES = ("3", "5", "8", "13", "25")


def passages(folder: pathlib.Path) -> Iterator[tuple[str, str]]:
    """All passages and the pages that they are on, with the numbers of the rows in a folder."""
    for name, words in {"similarity": _similarity, "first": _first, "lpal": _lpal, "planning": _planning}.items():
        yield from (("README.md", passage) for passage in words(_Rows(folder / f"speed_{name}.csv")))
    yield from (("docs/scale.md", table) for table in scale.tables(sweeps.read(folder / "scale.jsonl")).split("\n\n"))
    yield from (("docs/sweeps.md", line) for line in _sweep_costs(pd.read_csv(folder / "sweep_costs.csv")))


class _Rows:
    """The rows of a benchmark, to take numbers from."""

    def __init__(self, path: pathlib.Path) -> None:
        with path.open(newline="") as file:
            self.rows = list(csv.DictReader(file))

    def quickest(self, keep: Callable[[dict], bool], field: str = "seconds", /, **fields: str) -> dict | None:
        """Of the rows with these fields that are as accurate as was asked, the one with the least of a field."""
        found = [row for row in self.rows if keep(row) and all(row[name] == text for name, text in fields.items())]
        return min(found, key=lambda row: number(row, field), default=None)

    def ours(self, field: str = "seconds", /, **fields: str) -> str:
        """A field of the one row of ours that has these fields, in two digits."""
        (row,) = (row for row in self.rows if is_ours(row) and all(row[name] == fields[name] for name in fields))
        return _digits(number(row, field))


def _digits(value: float) -> str:
    """Two digits, and all of those before the point."""
    return f"{value:.{max(1 - math.floor(math.log10(value)), 0)}f}"


def _round(value: float) -> str:
    """Two digits, the others zeros."""
    return f"{float(f'{value:.2g}'):,.0f}"


def _our_best(row: dict) -> bool:
    return is_ours(row) and is_settled(row, 0.98)


def _peer(row: dict) -> bool:
    return not is_ours(row) and is_settled(row, 0.98)


def _similarity(rows: _Rows) -> Iterator[str]:
    each = "ms_per_pair"
    ours = [rows.quickest(_our_best, each, work="brackets", n=size) for size in _SIZES]
    peers = [rows.quickest(_peer, each, work="brackets", n=size) for size in _SIZES]
    yield f"| `jaxhom`, ms per pair | {' | '.join(_digits(number(row, each)) for row in ours)} |"
    best = (f"{_digits(number(row, each))} {_NAMES[row['method']]}" for row in peers)
    yield f"| best peer, ms per pair | {' | '.join(best)} |"
    decision = rows.ours(each, section="decisions", dtype="float64")
    gradient = rows.ours(each, section="gradients")
    moreau = rows.quickest(_peer, each, section="gradients")
    yield (
        f"Deciding e <= 0.05 instead takes {decision} ms per pair of five states, a value with both gradients "
        f"{gradient} ms (Moreau {_digits(number(moreau, each))})."
    )
    racetrack, first, again = (
        rows.ours(work=work)
        for work in ("racetrack, all pairs, cold", "Algorithm 1, racetrack, cold", "Algorithm 1, racetrack, warm")
    )
    yield (
        f"All 34.8 million pairs of racetrack (a) are bracketed in {racetrack} s, compilation included; Algorithm 1 "
        f"with ten demonstrations takes {first} s the first time and {again} s from then on."
    )
    roads = next(row for row in rows.rows if row["work"] == "road network, decisions")
    yield f"60,000 decisions about a road network of 754 links at distance 2 take {_digits(number(roads, 'seconds'))} s"


def _first(rows: _Rows) -> Iterator[str]:
    ours = [rows.ours("first_s", section=f"pairs_{count}", method="jaxhom") for count in (100, 1000, 10_000)]
    peers = []
    for count in (100, 1000, 10_000):
        peer = next(row for row in rows.rows if row["section"] == f"pairs_{count}" and not is_ours(row))
        peers.append(_digits(count * number(peer, "seconds")))
    yield (
        f"a hundred such pairs take {ours[0]} s, a thousand {ours[1]} and ten thousand {ours[2]} "
        f"(HiGHS's simplex on one core: {peers[0]}, {peers[1]} and {peers[2]})"
    )
    mixed, decided = (rows.ours("first_s", section=f"{work}_mixed") for work in ("pairs", "decisions"))
    highs = rows.quickest(_peer, "first_s", section="pairs_mixed", method="highs_interior_point")
    yield (
        f"sixty pairs of mixed sizes, up to 25 states and sparse, take {mixed} s (HiGHS's interior point "
        f"{_digits(number(highs, 'first_s'))}), and deciding them {decided}."
    )
    way, lpal, planning = (
        rows.ours("first_s", section="steps", instance=step, cache="none")
        for step in ("the whole way", "LPAL", "planning")
    )
    quantecon = next(row for row in rows.rows if row["method"] == "quantecon")
    yield (
        f"The whole way from a model to the learned policy takes {way} s; LPAL on the 16x16 grid {lpal} s, planning "
        f"{planning} s (QuantEcon, with Numba's compilation, {_digits(number(quantecon, 'first_s'))})."
    )
    draw, compiled = (
        rows.ours(field, section="draws_grid16", method="jaxhom jit vmap") for field in ("seconds", "first_s")
    )
    yield f"As one program of a key the way takes {_digits(1000.0 * float(draw))} ms a draw, after {compiled} s of"


def _lpal(rows: _Rows) -> Iterator[str]:
    for section, title in _LPAL.items():
        cells = []
        for is_wanted in (_is_default, _peer):
            one = rows.quickest(lambda row, w=is_wanted: w(row) and not is_batch(row), section=section)
            # Who has no row for a batch would solve one after another.
            each = rows.quickest(lambda row, w=is_wanted: w(row) and is_batch(row), section=section) or one
            cells.append((one, each))
        ours, peers = cells
        yield f"| {title} | {_times(*ours)} | {_named_times(*peers)} |"
    batches = [row for row in rows.rows if _is_default(row) and is_batch(row)]
    compiling = [seconds for row in batches if (seconds := number(row, "compile_s") or 0.0)]  # one run shows none
    yield f"A first batch also compiles, for {min(compiling):.0f} to {max(compiling):.0f} s"


def _is_default(row: dict) -> bool:
    return row["method"] == "jaxhom" and is_settled(row)


def _times(one: dict | None, each: dict | None) -> str:
    if one is None:
        return "not settled"
    return f"{_digits(number(one, 'seconds'))} / {_digits(number(each, 'seconds'))}"


def _named_times(one: dict | None, each: dict | None) -> str:
    if one is None:
        return "not measured"
    first, second = (_NAMES[row["method"]] for row in (one, each))
    times = _times(one, each).split(" / ")
    return f"{first} {times[0]} / {times[1]}" if first == second else f"{first} {times[0]} / {second} {times[1]}"


def _sweep_costs(rows: pd.DataFrame) -> Iterator[str]:
    """A line for each executor: milliseconds per row with nothing to do, here, and with Algorithm 1."""
    for name in sweep_costs.EXECUTORS:
        lines = rows[rows["executor"] == name].sort_values("workers")
        idle, busy = (lines[lines["work"] == work] for work in sweep_costs.WORK)
        here = idle["cpu_ms_here"].iloc[0]
        yield (
            f"| {name} | {' / '.join(f'{value:.1f}' for value in idle['ms_per_row'])} | {_digits(here)} | "
            f"{' / '.join(f'{value:.0f}' for value in busy['ms_per_row'])} |"
        )
    ours, dask = (
        1e-3
        * rows[(rows["executor"] == name) & (rows["work"] == "nothing")].sort_values("workers")["cpu_ms_here"].iloc[0]
        for name in ("processes", "Dask")
    )
    for seconds in (0.1, 1, 60):
        yield f"| {seconds} | {_round(seconds / ours)} | {_round(seconds / dask)} |"


def _planning(rows: _Rows) -> Iterator[str]:
    def pair(section: str, work: str, peer: str) -> tuple[str, str]:
        one = {"section": section, "work": work, "lanes": "1"}
        ours = rows.ours(**one)
        other = rows.quickest(lambda row: _peer(row) and row["method"].startswith(peer), **one)
        return ours, _digits(number(other, "seconds"))

    grid, large = (pair(section, "planning", "quantecon") for section in ("grid48", "grid316"))
    each = rows.ours(section="grid316", work="planning", lanes="32")
    yield (
        f"Planning for one reward takes {grid[0]} s on the 48x48 grid and {large[0]} s on 100,000 states (QuantEcon "
        f"{grid[1]} and {large[1]}); of 32 rewards there, {each} s each."
    )
    grid, large = (pair(section, "occupancy", "scipy") for section in ("grid48", "grid316"))
    yield f"Occupancies of one policy take {grid[0]} and {large[0]} s (SciPy's sparse LU {grid[1]} and {large[1]})."
