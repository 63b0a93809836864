"""Hands out jobs, a bounded number at a time, and hands on what comes back, until nothing is left.

Jobs of one group go one after another. Where a worker died, whatever was in its pool is tried again, one job at a time
with nothing beside it, so that a job that takes its worker with it is found, and no other is blamed.
"""

from __future__ import annotations

import collections
import dataclasses
import queue
import sys
from collections.abc import Callable, Iterable
from concurrent.futures import BrokenExecutor, Executor, Future, wait

from tqdm import tqdm

from jaxhom.sweeps.attempts import Shipped, attempt
from jaxhom.sweeps.cases import Job, Plain
from jaxhom.sweeps.crews import Crew

Outcome = tuple[Job, list[dict[str, Plain]]]
_MOST_DEATHS = 3  # of workers, until a job is given up


@dataclasses.dataclass(slots=True)
class _Group:
    """Jobs of one group that are left, the next one last, and how many workers that one has cost."""

    jobs: list[Job]
    deaths: int = 0


class Dispatch:
    """Jobs on their way.

    Args:
      work: what is called, as its crew takes it.
      groups: the jobs, those of one group together.
      crew: who does them.
      write: gets what has come back.
    """

    def __init__(
        self,
        work: Callable | Shipped,
        groups: Iterable[Iterable[Job]],
        crew: Crew,
        write: Callable[[list[Outcome]], None],
    ):
        self._work, self._crew, self._write = work, crew, write
        self._groups = collections.deque(_Group(list(jobs)[::-1]) for jobs in groups)
        self._suspects: collections.deque[_Group] = collections.deque()
        self._running: dict[Future, tuple[_Group, Executor]] = {}
        self._back: queue.SimpleQueue[Future] = queue.SimpleQueue()

    def run(self) -> None:
        """Until all is written.

        Raises:
          RuntimeError: if the executor gave up.
          KeyboardInterrupt: and whatever else comes in between; first, what is in progress is finished and written.
        """
        try:
            while self._running or self._groups or self._suspects:
                self._hand_out()
                self._take()
        except BaseException:
            self._stop()
            raise

    def _hand_out(self) -> None:
        limit = 1 if self._suspects else self._crew.in_flight
        while len(self._running) < limit and (self._suspects or self._groups):
            source = self._suspects or self._groups
            group = source.popleft()
            job, executor = group.jobs[-1], self._crew.executor
            try:
                future = executor.submit(attempt, self._work, job.given, job.is_batch)
            except BrokenExecutor as error:  # found out before the jobs in it come back
                source.appendleft(group)
                self._renew(executor, error)
                return
            except Exception as error:
                raise RuntimeError(_gave_up(error)) from error
            self._running[future] = group, executor
            future.add_done_callback(self._back.put)

    def _take(self) -> None:
        """Waits for a job, and takes all that are back: they are written to the disk at once."""
        if not self._running:
            return
        outcomes: list[Outcome] = []
        try:
            future = self._back.get()
            while True:
                self._settle(future, outcomes)
                future = self._back.get_nowait()
        except queue.Empty:
            pass
        finally:
            self._write_all(outcomes)

    def _settle(self, future: Future, outcomes: list[Outcome]) -> None:
        group, executor = self._running.pop(future)
        try:
            found = future.result()
        except Exception as error:
            self._lost(group, executor, error, outcomes)
        else:
            self._done(group, found, outcomes)

    def _done(self, group: _Group, found: list[dict[str, Plain]], outcomes: list[Outcome]) -> None:
        outcomes.append((group.jobs[-1], found))
        self._go_on(group)

    def _go_on(self, group: _Group) -> None:
        group.jobs.pop()
        group.deaths = 0
        if group.jobs:
            self._groups.appendleft(group)  # what it shares with the next one is still there

    def _lost(self, group: _Group, executor: Executor, error: Exception, outcomes: list[Outcome]) -> None:
        """A job without an answer: again if its worker died, up to a limit; else the executor itself has failed."""
        if isinstance(error, BrokenExecutor):
            self._renew(executor, error)
            group.deaths += 1
        elif type(error).__name__ == "KilledWorker":  # Dask has tried several times, with others beside it perhaps
            group.deaths = _MOST_DEATHS if group.deaths else 1
        else:
            raise RuntimeError(_gave_up(error)) from error
        job = group.jobs[-1]
        if group.deaths < _MOST_DEATHS:
            self._suspects.append(group)
        elif len(job.cases) > 1:
            self._suspects.extend(_Group([one], _MOST_DEATHS - 1) for one in job.split())
            self._go_on(group)
        else:
            self._done(group, [{"error": "its worker died, again and again"}], outcomes)

    def _write_all(self, outcomes: list[Outcome]) -> None:
        if outcomes:
            self._write(outcomes)

    def _renew(self, executor: Executor, error: Exception) -> None:
        if not self._crew.renew(executor):
            raise RuntimeError(_gave_up(error)) from error

    def _stop(self) -> None:
        """Waits for what cannot be taken back; at a further Ctrl-C not even for that."""
        left = {future: group for future, (group, _) in self._running.items() if not future.cancel()}
        tqdm.write("stopping as soon as what is in progress is done", file=sys.stderr)
        try:
            wait(left)
        finally:
            back = [f for f in left if f.done() and not f.cancelled() and f.exception() is None]
            self._write_all([(left[future].jobs[-1], future.result()) for future in back])


def _gave_up(error: Exception) -> str:
    reason = f"{type(error).__name__}: {error}".rstrip(": ")
    return f"the executor gave up ({reason}); what is finished is written, and the same call goes on from there"
