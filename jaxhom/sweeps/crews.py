"""Who does the work: this process, processes of this machine that are replaced when one dies, or a given executor."""

from __future__ import annotations

import contextlib
import multiprocessing
import operator
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from typing import Any

import jax

from jaxhom import checks
from jaxhom.solvers.blas_threads import one_blas_thread
from jaxhom.sweeps.attempts import Shipped, ship

_UNKNOWN = 256  # jobs in flight where nobody says how many workers there are
_CARRIED = ("jax_enable_x64", "jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")


class Crew:
    """An executor, and another one when it breaks.

    Attributes:
      executor: the present one.
      in_flight: how many jobs it gets at a time.
    """

    def __init__(self, executor: Executor, in_flight: int, make: Callable[[], Executor] | None = None):
        self.executor, self.in_flight, self._make = executor, in_flight, make

    def renew(self, broken: Executor) -> bool:
        """Whether there is another executor in place of a broken one."""
        if self._make is not None and self.executor is broken:
            broken.shutdown(wait=False)
            self.executor = self._make()
        return self._make is not None


def carry(work: Callable, executor: Any) -> Callable | Shipped:
    """`work` as an executor takes it.

    Raises:
      ValueError: if it has to be pickled and cannot be.
    """
    return work if executor is None or isinstance(executor, ThreadPoolExecutor) else ship(work)


@contextlib.contextmanager
def crew_of(executor: Any, in_flight: int | None) -> Iterator[Crew]:
    """What `run` calls `executor` as a crew; processes of its own end with it.

    Raises:
      ValueError: if it is none of what it may be.
      RuntimeError: if processes cannot be started.
    """
    if executor is None:
        yield Crew(_Here(), 1)
    elif isinstance(executor, Executor):
        workers = getattr(executor, "_max_workers", None)  # of the standard library's
        yield Crew(executor, in_flight or (2 * workers if isinstance(workers, int) else _UNKNOWN))
    elif hasattr(executor, "get_executor"):  # a client of Dask
        yield Crew(executor.get_executor(pure=False), in_flight or _UNKNOWN)
    else:
        with _processes_of(executor, in_flight) as crew:
            yield crew


@contextlib.contextmanager
def _processes_of(count: Any, in_flight: int | None) -> Iterator[Crew]:
    try:
        operator.index(count)
    except TypeError:
        what = "None, a number of processes, a concurrent.futures.Executor or a client of Dask"
        raise ValueError(f"executor must be {what}, got {checks.in_one_line(count)}") from None
    count = checks.require_count("executor", count)
    crew = Crew(_processes(count), in_flight or 2 * count, lambda: _processes(count))
    try:
        yield crew
    finally:
        crew.executor.shutdown(wait=False, cancel_futures=True)


def _processes(count: int) -> Executor:
    """Fresh processes: JAX has threads, with which a process must not be forked."""
    settings = {name: jax.config.values[name] for name in _CARRIED}
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(count, mp_context=context, initializer=_begin, initargs=(settings,))
    try:
        pool.submit(_begun).result()
    except BrokenExecutor:
        message = "processes do not start; in a script, what calls run must stand below `if __name__ == '__main__':`"
        raise RuntimeError(message) from None
    return pool


def _begin(settings: dict[str, Any]) -> None:
    """Has a new process compute as the caller does, on one core, finish its case at Ctrl-C, and end with the caller."""
    threading.Thread(target=_end_with, args=[multiprocessing.parent_process()], daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for name, value in settings.items():
        jax.config.update(name, value)
    one_blas_thread().__enter__()


def _end_with(caller: Any) -> None:
    """Ends this process once another one has: who is killed tells nobody, and workers would wait for more for ever."""
    caller.join()
    os._exit(1)


def _begun() -> None:
    """Nothing: that it is done says that a process has started."""


class _Here(Executor):
    """Work in this process, one job at a time, done when it is handed out."""

    def submit(self, fn: Callable, /, *args: Any, **options: Any) -> Future:
        future: Future = Future()
        future.set_result(fn(*args, **options))
        return future
