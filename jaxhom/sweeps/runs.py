"""Sweeps: a function, a list of cases, and a file that gets a row for each case that it does not hold yet."""

from __future__ import annotations

import datetime
import os
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from typing import Any, Protocol

from tqdm import tqdm

from jaxhom import checks
from jaxhom.sweeps.cases import Case, Job, Plain, checked_group, checked_jobs
from jaxhom.sweeps.crews import carry, crew_of
from jaxhom.sweeps.dispatch import Dispatch, Outcome
from jaxhom.sweeps.provenance import commit, folder_of
from jaxhom.sweeps.row_files import RowFile


class Rows(Protocol):
    """Where rows are kept."""

    def writing(self) -> Any:
        """A context within which this process alone adds rows."""

    def key(self, case: Case) -> Hashable:
        """What tells a case from others."""

    def done(self, retry: bool) -> set:
        """The keys of the cases that there is nothing more to do about."""

    def add(self, finished: Sequence[tuple[Case, Mapping[str, Plain]]]) -> None:
        """Adds rows, which are safe when it returns."""


def run(
    work: Callable[[Any], Any],
    cases: Iterable[Any],
    file: str | os.PathLike,
    *,
    executor: Executor | int | Any | None = None,
    retry: bool = False,
    group: Callable[[Any], Hashable] | None = None,
    in_flight: int | None = None,
    progress: bool = True,
) -> list[dict[str, Any]]:
    """Calls `work` on every case that `file` does not hold yet, and appends a row for each.

    Rows are on the disk as soon as they are there, each once. Whatever stops a sweep, the same call goes on from there.
    A case that raises is a row with its `error`; one whose worker died is done again, and if it takes its worker with
    it three times, that is its error.

    Args:
      work: from a case to a mapping of names to plain values: text, numbers, truth values, None, or scalars of NumPy
        and JAX. A result with an `error`, a text, is a case that failed. With an executor, it must be possible to
        pickle it; workers unpickle it once each.
      cases: mappings of names to plain values, or dataclasses of those; no two alike. A list of cases among them is a
        batch: `work` gets it as it is, without those that are done, and returns a list of results.
      file: its name ends in .jsonl; `read` reads it, and says what columns there are.
      executor: who does the work. None: this process, one case at a time. A number: so many processes of this machine,
        fresh ones, with the caller's float type, which are replaced if they die. A client of Dask, or any executor of
        `concurrent.futures`.
      retry: do cases with an error once more.
      group: of a case, what it shares with others (a model, say). Cases of one group are never done at the same time
        but one after another, so that what `work` keeps of one serves the next.
      in_flight: how many cases, or batches, are handed out at a time. By default twice the number of workers, or 256
        if the executor does not say how many it has.
      progress: show how far it is.

    Returns:
      The rows of the cases, in their order, as `read` returns them.

    Raises:
      ValueError: if an argument is not what it should be, naming the first such case; if `work` cannot be pickled and
        has to be; if another run is writing to the file.
      RuntimeError: if the executor gave up: it lost its scheduler, was shut down, or cannot import `work`.
      KeyboardInterrupt: at Ctrl-C, once the cases in progress are done; at the second at once.

    Outside jit, vmap and grad only.

    Example:
      >>> import pathlib, tempfile
      >>> import jaxhom
      >>> from jaxhom import sweeps
      >>> def time_in_the_corner(case):
      ...     mdp = jaxhom.gridworld(4, num_regions=4, noise=case["noise"], discount=0.9).mdp
      ...     plan = jaxhom.optimal_policy(mdp, mdp.features[..., 3])
      ...     return {"share": 0.1 * plan.value @ mdp.initial}
      >>> file = pathlib.Path(tempfile.mkdtemp(), "corner.jsonl")
      >>> rows = sweeps.run(time_in_the_corner, [{"noise": 0.0}, {"noise": 0.5}], file, progress=False)
      >>> [f"{row['noise']}: {row['share']:.2f}" for row in rows]
      ['0.0: 0.66', '0.5: 0.44']
    """
    jobs, rows = checked_jobs(cases), RowFile(file)
    run_jobs(work, jobs, rows, executor=executor, retry=retry, group=group, in_flight=in_flight, progress=progress)
    held = rows.rows()
    return [held[case.key] for job in jobs for case in job.cases]


def run_jobs(
    work: Callable[[Any], Any],
    jobs: Sequence[Job],
    rows: Rows,
    *,
    executor: Any = None,
    retry: bool = False,
    group: Callable[[Any], Hashable] | None = None,
    in_flight: int | None = None,
    progress: bool = True,
) -> None:
    """As `run`, of cases that have been checked, into rows of any kind."""
    checks.require_function("work", work)
    if group is not None:
        checks.require_function("group", group)
    in_flight = None if in_flight is None else checks.require_count("in_flight", in_flight)
    with rows.writing():
        done = rows.done(retry)
        left = [job for job in (job.only(lambda case: rows.key(case) not in done) for job in jobs) if job.cases]
        groups = _groups(left, group)
        total, count = sum(len(job.cases) for job in jobs), sum(len(job.cases) for job in left)
        if not left:
            return
        carried = carry(work, executor)
        with crew_of(executor, in_flight) as crew, _bar(total, total - count, progress) as bar:
            found_in = commit(folder_of(work))

            def write(outcomes: list[Outcome]) -> None:
                now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
                finished = [pair for job, found in outcomes for pair in zip(job.cases, found, strict=True)]
                rows.add([(case, _row(columns, now, found_in)) for case, columns in finished])
                bar.update(len(finished))

            Dispatch(carried, groups, crew, write).run()


def _groups(jobs: Sequence[Job], group: Callable[[Any], Hashable] | None) -> list[list[Job]]:
    """Jobs by group, in the order in which each comes first; without a name each has its own."""
    groups: dict[Hashable, list[Job]] = {}
    for index, job in enumerate(jobs):
        name = checked_group(group, job)
        groups.setdefault(("", index) if name is None else (name,), []).append(job)
    return list(groups.values())


def _row(columns: Mapping[str, Plain], time: str, commit: str) -> dict[str, Plain]:
    """What was found, and where it comes from, in one order; what a dead worker cannot say is None."""
    ours: dict[str, Plain] = {
        "error": None,
        "seconds": None,
        "time": time,
        "host": None,
        "x64": None,
        "commit": commit,
        "versions": None,
    }
    ours |= {name: columns[name] for name in ours if name in columns}
    return {**{name: value for name, value in columns.items() if name not in ours}, **ours}


def _bar(total: int, initial: int, progress: bool) -> tqdm:
    return tqdm(total=total, initial=initial, unit="row", disable=not progress, mininterval=1.0)
