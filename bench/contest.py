"""A contest on one instance: rows of this library and of its peers, for one lane and for a batch.

A method has a row for one lane (the median of a few) and one for a batch (seconds per lane). A peer tries each of its
candidates, which are settings, and keeps the fastest. If its worst lane is not as accurate as was asked, its tolerance
is made ten times smaller, until it is or the time is over. Batches of a peer are shared between two processes, unless
it uses both cores by itself.
"""

import dataclasses
import statistics
import time
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np

from bench.processes import Found, NoAnswer, measure

LANES, QUICK_LANES = 32, 4
_SINGLE_LANES, _QUICK_SINGLE_LANES = 3, 1
_FEWER_LANES = (8, 2)  # of a peer's batch that would take too long
_ONE_THREAD = 1.5  # a peer's lane on one thread may take so much longer than on two
_FIRST_SHARE = 0.2  # of the limit, for the first of several candidates
_LEAST_LIMIT = 10.0  # seconds for the others


@dataclasses.dataclass(frozen=True)
class Contest:
    """An instance as drawn, and how it is measured.

    Attributes:
      fields: of every row.
      lanes: what solvers load.
      judge: (answers) -> fields that say how accurate they are, "settled" among them.
      least_tolerance: that peers are given.
      quick: whether it is to take minutes, not hours.
      limit: seconds for one row.
    """

    fields: dict
    lanes: list
    judge: Callable[[list], dict]
    least_tolerance: float
    quick: bool
    limit: float

    @property
    def single(self) -> int:
        """How many lanes are solved one by one."""
        return min(len(self.lanes), _QUICK_SINGLE_LANES if self.quick else _SINGLE_LANES)

    def row(self, method: str, lanes: int, **fields) -> dict:
        """One row of the table; what is not given stays empty."""
        return self.fields | {"method": method, "lanes": lanes, "processes": 1, "device": "cpu"} | fields

    def judged(self, found: Found) -> dict:
        """Fields that follow from what was found."""
        fields = {"seconds": statistics.median(found.seconds), "compile_s": found.compile_s, "build_s": found.build_s}
        if any(found.iterations):
            fields["iterations"] = int(np.median(found.iterations))
        fields |= {"processes": found.processes, "note": ", ".join(sorted(set(found.words) - {""}))}
        return fields | {"status": "measured"} | self.judge(found.answers)


def matches(method: str, wanted: list[str] | None) -> bool:
    """Whether a method's name begins with one of those that are wanted (all, if None)."""
    return wanted is None or method.startswith(tuple(wanted))


def rows(contest: Contest, ours: dict, peers: dict, methods: list[str] | None) -> Iterator[dict]:
    """All rows of those methods that are wanted: ours, then each peer's.

    Args:
      ours: by method (solver, options, whether it has a row for a batch).
      peers: by method; None if it is not installed.
    """
    for method, (solver, options, has_batch) in ours.items():
        for batch in (False, True)[: 1 + has_batch] if matches(method, methods) else ():
            yield _our_row(contest, method, solver, options, batch)
    for method, peer in peers.items():
        if matches(method, methods) and peer is None:
            yield contest.row(method, 1, status="not installed")
        elif matches(method, methods):
            yield from _peer_rows(contest, method, peer)


def _our_row(contest: Contest, method: str, solver: str, options: dict, batch: bool) -> dict:
    """A row of this library."""
    lanes = contest.lanes if batch else contest.lanes[: contest.single]
    try:
        found = measure(solver, options, lanes, contest.limit, package="jaxhom", together=batch, compiles=True)
        fields = contest.judged(found)
        fields["note"] = ", ".join(filter(None, (fields["note"], f"{found.peak_gb:.2g} GB at most")))
        if batch and sum(found.seconds) > contest.limit:
            fields["note"] += f", took longer than {contest.limit:g} s"
    except NoAnswer as error:
        fields = _late(contest, error)
    return contest.row(method, len(lanes) if batch else 1, **fields | {"device": jax.default_backend()})


def _late(contest: Contest, error: NoAnswer, settings: str = "") -> dict:
    if error.fields["status"] != "time limit":
        return error.fields
    return {"status": "time limit", "note": f"no answer in {contest.limit:g} s{settings}"}


@dataclasses.dataclass(frozen=True)
class Peer:
    """A peer in a contest.

    Attributes:
      solver, package: see `bench.processes.measure`.
      options: settings -> options.
      candidates: settings, each with a `tolerance`; the best of them is taken.
      together: whether it solves a batch at once. is_hot: in a batch it starts from the lane before.
      both_cores: whether it uses them by itself.
    """

    solver: str
    package: str
    options: Callable[[Any], dict]
    candidates: tuple
    together: bool = False
    is_hot: bool = False
    both_cores: bool = False


def _peer_rows(contest: Contest, method: str, peer: Peer) -> Iterator[dict]:
    """A peer's rows; its batch is as large as the time limit lets expect, and has the tolerance that the single had."""
    fields, settings = _best(contest, peer)
    yield contest.row(method, 1, **fields)
    if not fields.get("settled"):
        return
    expected = _ONE_THREAD * (fields["seconds"] + fields["build_s"] / contest.single) / 2.0
    for lanes in (len(contest.lanes), *_FEWER_LANES):
        if lanes * expected <= contest.limit:
            yield contest.row(method, lanes, **_batch_fields(contest, peer, settings, lanes))
            return


def _batch_fields(contest: Contest, peer: Peer, settings, lanes: int) -> dict:
    """Fields of a batch, with the settings that were best for a single one, or others where a lane stays open."""
    others = [s for s in peer.candidates if dataclasses.replace(s, tolerance=settings.tolerance) != settings]
    found = []
    for candidate in (settings, *others):
        found.append(_settled(contest, peer, candidate, lanes)[0])
        if found[-1].get("settled"):
            return found[-1]
    return found[0]


def _best(contest: Contest, peer: Peer) -> tuple[dict, Any]:
    """Fields and settings of the fastest candidate.

    Each has a share of the time limit, later ones not much longer than the best so far took. If none of them gives an
    answer in that time, the first has all of it.
    """
    chosen, several = None, len(peer.candidates) > 1
    limit = _FIRST_SHARE * contest.limit if several else contest.limit
    for candidate in peer.candidates:
        fields, settings = _settled(dataclasses.replace(contest, limit=limit), peer, candidate)
        if fields.get("settled") and (chosen is None or fields["seconds"] < chosen[0]["seconds"]):
            chosen = fields, settings
            limit = min(limit, (contest.single + 2) * fields["seconds"] + _LEAST_LIMIT)
    if chosen is None and several:
        return _settled(contest, peer, peer.candidates[0])
    return chosen or (fields, settings)


def _settled(contest: Contest, peer: Peer, settings, batch: int = 0) -> tuple[dict, Any]:
    """Fields of the first tolerance that is accurate enough, or of the last there was time for; `batch`: its lanes."""
    lanes, spent, fields = contest.lanes[: batch or contest.single], 0.0, {}
    options = {"package": peer.package, "together": bool(batch) and peer.together}
    options |= {"processes": 2 if batch and not peer.both_cores else 1}
    options |= {"repeats": 0} if batch and peer.is_hot else {}
    while True:
        start = time.perf_counter()
        try:
            opening = peer.options(settings) | ({"hot": True} if batch and peer.is_hot else {})
            found = measure(peer.solver, opening, lanes, contest.limit - spent, **options)
            if batch and len(found.answers) < batch:
                raise NoAnswer("time limit", "")
        except NoAnswer as error:
            return fields or _late(contest, error), settings
        spent += time.perf_counter() - start
        fields = contest.judged(found)
        fields["note"] = "; ".join(filter(None, (str(settings), fields["note"])))
        tighter = dataclasses.replace(settings, tolerance=0.1 * settings.tolerance)
        if fields["settled"]:
            return fields, settings
        if spent > contest.limit or len(found.answers) < len(lanes):
            return fields | _late(contest, NoAnswer("time limit", ""), f" ({settings})"), settings
        if tighter.tolerance < contest.least_tolerance:
            return fields, settings
        settings = tighter
