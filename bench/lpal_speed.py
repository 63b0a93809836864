"""Measures LPAL by this library and by other solvers on the same instances, judged by one certificate.

A section is an instance of `bench.lpal_instances`; `python -m bench.lpal_speed SECTION` prints its rows as JSON. Each
method has a row for one expectation vector (the median of a few lanes) and one for a batch (seconds per lane); each is
measured in a process of its own with a time limit, all with two threads, batches of peers in two processes with one.

A peer tries each of its `bench.lpal_peers.CANDIDATES` and keeps the fastest. If the certified gap of its worst lane is
larger than what was asked, its tolerance is made ten times smaller, until the gap closes or the time is over.
"""

import dataclasses
import statistics
import time
from collections.abc import Iterator

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

from bench import limits, lpal_peers  # noqa: E402
from bench.lpal_certificate import certified_gap  # noqa: E402
from bench.lpal_instances import INSTANCES  # noqa: E402
from bench.lpal_program import Model  # noqa: E402
from bench.speed_rows import commit, matches, print_section, versions  # noqa: E402

OURS = {"jaxhom": None, "jaxhom interior_point": "interior_point", "jaxhom flow": "flow"}
SEED = 0
LIMIT, QUICK_LIMIT = 300.0, 60.0
LANES, QUICK_LANES = 32, 4
SINGLE_LANES, QUICK_SINGLE_LANES = 3, 1
OUR_LANES = {"grid316": 8}  # what 24 GB hold
_FEWER_LANES = (8, 2)  # of a peer's batch that would take too long
_ONE_THREAD = 1.5  # a peer's lane on one thread may take so much longer than on two
_FIRST_SHARE = 0.2
_LEAST_LIMIT = 10.0  # for a second try
_START_UP = 60.0  # to import, build and compile, beyond the limit
_PACKAGES = ("jax", "moreau", "clarabel", "highspy", "ortools", "mpax", "scipy")


@dataclasses.dataclass(frozen=True)
class Problem:
    """An instance as drawn, and how it is measured.

    Attributes:
      name: of the instance.
      mdp, model: it, for us and for the peers.
      expectations: [B, K].
      gap: the certified gap that is asked for.
      limit: seconds for one row.
      single: lanes that are solved one by one.
    """

    name: str
    mdp: object
    model: Model
    expectations: np.ndarray
    gap: float
    limit: float
    single: int

    @classmethod
    def draw(cls, name: str, quick: bool, limit: float | None) -> "Problem":
        """The instance, with `jaxhom.lpal`'s default tolerance as the gap."""
        lanes = QUICK_LANES if quick else OUR_LANES.get(name, LANES)
        mdp, expectations = INSTANCES[name].draw(SEED, lanes)
        gap = 1e-5 / (1.0 - float(mdp.discount)) * float(jnp.abs(mdp.features).max())
        limit = limit or (QUICK_LIMIT if quick else LIMIT)
        single = min(lanes, QUICK_SINGLE_LANES if quick else SINGLE_LANES)
        return cls(name, mdp, Model.of(mdp), expectations, gap, limit, single)

    def row(self, method: str, lanes: int, **fields) -> dict:
        """One row of the table; what is not given stays empty."""
        model = self.model
        base = {"instance": INSTANCES[self.name].title, "S": model.num_states, "A": model.num_actions}
        base |= {"K": model.num_features, "lanes": lanes, "method": method, "processes": 1, "dtype": "float64"}
        base |= {"device": jax.default_backend() if method in OURS else "cpu", "gap_asked": self.gap}
        return base | {"versions": versions(*_PACKAGES), "commit": commit()} | fields

    def judged(self, answer: lpal_peers.Answer) -> dict:
        """Fields that follow from an answer: its time per lane, and the worst lane's certified gap."""
        gap = float(certified_gap(self.mdp, self.model, answer.x, answer.w, self.expectations, self.gap).max())
        fields = {"compile_s": answer.compile_s, "build_s": answer.build_s, "status": "measured"}
        fields |= {"seconds": statistics.median(answer.seconds), "note": ", ".join(sorted(set(answer.statuses)))}
        return fields | {"gap_certified": gap if np.isfinite(gap) else None, "settled": float(gap <= self.gap)}


# --------------------------------------------------------------------------------------------------------------- ours


def our_row(problem: Problem, method: str, batch: bool) -> dict:
    """One row of this library."""
    vectors = problem.expectations if batch else problem.expectations[: problem.single]
    lanes = len(vectors) if batch else 1
    task = {"name": problem.name, "method": OURS[method], "expectations": vectors, "limit": problem.limit}
    try:
        found = limits.start("lpal_ours", "solve", task | {"batch": batch}).result(2.5 * problem.limit + _START_UP)
    except RuntimeError as error:
        return problem.row(method, lanes, status="failed", note=str(error))
    if found is None:
        return problem.row(method, lanes, status="time limit", note=f"no answer in {problem.limit:g} s")
    answer, iterations = found
    fields = problem.judged(answer) | {"iterations": int(np.median(iterations))}
    if batch and answer.seconds[0] * lanes > problem.limit:
        fields["note"] += f", took longer than {problem.limit:g} s"
    return problem.row(method, lanes, **fields)


def our_rows(problem: Problem, method: str) -> Iterator[dict]:
    """The default method alone and in a batch, the others alone."""
    yield our_row(problem, method, batch=False)
    if OURS[method] is None:
        yield our_row(problem, method, batch=True)


# -------------------------------------------------------------------------------------------------------------- peers


def peer_rows(problem: Problem, method: str) -> Iterator[dict]:
    """A peer's rows; its batch is as large as the time limit lets expect, and has the tolerance that the single had."""
    if not lpal_peers.is_installed(method):
        yield problem.row(method, 1, status="not installed")
        return
    fields, settings = best(problem, method)
    yield problem.row(method, 1, **fields)
    if not fields.get("settled"):
        return
    expected = _ONE_THREAD * fields["seconds"] / 2.0
    for lanes in (len(problem.expectations), *_FEWER_LANES):
        if lanes * expected <= problem.limit:
            yield problem.row(method, lanes, **batch_fields(problem, method, settings, lanes))
            return


def batch_fields(problem: Problem, method: str, settings: lpal_peers.Settings, lanes: int) -> dict:
    """Fields of a batch, with the settings that were best for a single one, or others where a lane stays open."""
    first, _ = settled(problem, method, settings, batch=True, lanes=lanes)
    if first.get("settled"):
        return first
    for other in lpal_peers.CANDIDATES[method]:
        if dataclasses.replace(other, tolerance=settings.tolerance) != settings:
            fields, _ = settled(problem, method, other, batch=True, lanes=lanes)
            if fields.get("settled"):
                return fields
    return first


def best(problem: Problem, method: str) -> tuple[dict, lpal_peers.Settings]:
    """Fields and settings of the fastest candidate.

    Each has a share of the time limit, later ones not much longer than the best so far took. If none of them gives an
    answer in that time, the first has all of it.
    """
    candidates, chosen = lpal_peers.CANDIDATES[method], None
    limit = _FIRST_SHARE * problem.limit if len(candidates) > 1 else problem.limit
    for settings in candidates:
        fields, settings = settled(dataclasses.replace(problem, limit=limit), method, settings, batch=False)
        if fields.get("settled") and (chosen is None or fields["seconds"] < chosen[0]["seconds"]):
            chosen = fields, settings
            limit = min(limit, (problem.single + 2) * fields["seconds"] + _LEAST_LIMIT)
    if chosen is None and len(candidates) > 1:
        return settled(problem, method, candidates[0], batch=False)
    return chosen or (fields, settings)


def settled(
    problem: Problem, method: str, settings, batch: bool, lanes: int | None = None
) -> tuple[dict, lpal_peers.Settings]:
    """Fields of the first tolerance whose certified gap is small enough, or of the last that there was time for."""
    vectors = problem.expectations[: lanes or problem.single]
    spent, fields = 0.0, {}
    while True:
        start = time.perf_counter()
        found, processes = solve(problem, method, settings, vectors, problem.limit - spent, batch)
        spent += time.perf_counter() - start
        if isinstance(found, dict):
            return fields or found, settings
        fields = problem.judged(found) | {"processes": processes}
        fields["note"] = f"{settings}; {fields['note']}"
        tighter = dataclasses.replace(settings, tolerance=0.1 * settings.tolerance)
        if fields["settled"]:
            return fields, settings
        out_of_time = spent > problem.limit or len(found.x) < len(vectors)
        if out_of_time or tighter.tolerance < lpal_peers.LEAST_TOLERANCE:
            late = {"status": "time limit", "note": f"no answer in {problem.limit:g} s ({settings})"}
            return fields | (late if out_of_time else {}), settings
        settings = tighter


def solve(problem: Problem, method: str, settings, vectors: np.ndarray, limit: float, batch: bool):
    """(`Answer` or the fields of a row without one, number of processes)."""
    processes = 2 if batch and method not in lpal_peers.USES_BOTH_CORES else 1
    task = {"method": method, "settings": settings, "model": problem.model, "limit": limit, "batch": batch}
    try:
        parts = limits.side_by_side("lpal_peers", "solve", task, "expectations", vectors, processes, limit + _START_UP)
    except RuntimeError as error:
        return {"status": "failed", "note": str(error)}, processes
    if parts is None or (batch and sum(len(part.x) for part in parts) < len(vectors)):
        return {"status": "time limit", "note": f"no answer in {problem.limit:g} s"}, processes
    return (_joined(parts, len(vectors)) if batch else parts[0]), len(parts)


def _joined(parts: list[lpal_peers.Answer], lanes: int) -> lpal_peers.Answer:
    """One answer of processes that ran side by side: the slower one's time, over all lanes."""
    x, w, statuses = ([entry for part in parts for entry in getattr(part, name)] for name in ("x", "w", "statuses"))
    seconds = max(sum(part.seconds) for part in parts) / lanes
    build, compile_s = (max(getattr(part, name) for part in parts) for name in ("build_s", "compile_s"))
    return lpal_peers.Answer(x, w, [seconds] * len(x), statuses, build, compile_s)


def section(name: str, quick: bool, methods: list[str] | None, limit: float | None) -> Iterator[dict]:
    """All rows of an instance: ours, then each peer's."""
    problem = Problem.draw(name, quick, limit)
    for method in (*OURS, *lpal_peers.MODULES):
        if matches(method, methods):
            yield from (our_rows if method in OURS else peer_rows)(problem, method)


if __name__ == "__main__":
    print_section(section, INSTANCES)
