"""One protocol for whoever is measured, this library included: open, load, solve, close.

    solver = opened(**options)     what the model alone decides, in the solver's own form
    solver.load(lanes)             one lane, or several that are solved together
    solver.solve(seconds)          [(answer, the solver's word, iterations), ...], one for each of these lanes;
                                   a solver with `read(solution)` makes this list of its solution untimed

A lane is loaded again before it is solved again: some solvers would go on from their own answer.

Opening and loading are building (`build_s`); what a first solve takes beyond the next is compiling (`compile_s`); the
rest is `seconds`. Every measurement has a process of its own, with a number of threads and a time limit: solvers differ
in whether they keep to a limit, in what they leave in memory and in which threads they start, and a process that can be
ended settles all three. Its end closes the solver.
"""

import contextlib
import dataclasses
import functools
import importlib
import itertools
import math
import multiprocessing
import os
import pathlib
import resource
import statistics
import sys
import time
from collections.abc import Iterator

THREADS = 2  # the cores of the machine that the committed rows are from
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "RAYON_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
_START_UP = 60.0  # seconds to import, build and compile, beyond the limit
_GOODBYE = 10.0  # seconds for a process to end that has answered
_REPEATS = 3  # an odd number, for the median
_ENOUGH_SECONDS = 0.5  # of repetitions of a lane, so that they cost little
_SHARE_OF_REPEATS = 0.1  # of the limit: a lane that takes longer is not repeated, so that all fit in


class NoAnswer(Exception):
    """Nothing to judge: `fields` say in a row why."""

    def __init__(self, status: str, note: str):
        super().__init__(status, note)
        self.fields = {"status": status, "note": note}


@dataclasses.dataclass(frozen=True)
class Found:
    """What was found for the lanes that ended before the limit.

    Attributes:
      answers, words, iterations: per lane; an answer is None where the solver has none.
      seconds: per lane; of lanes that were solved together, the whole divided by their number.
      build_s, compile_s: see above.
      processes: that shared the lanes.
      peak_gb: the most memory that one of them held.
    """

    answers: list
    words: list[str]
    iterations: list[int]
    seconds: list[float]
    build_s: float
    compile_s: float
    processes: int = 1
    peak_gb: float = 0.0


def measure(
    solver: str,
    options: dict,
    lanes: list,
    limit: float,
    *,
    package: str = "numpy",
    together: bool = False,
    processes: int = 1,
    repeats: int = _REPEATS,
    compiles: bool = False,
) -> Found:
    """Has `bench.SOLVER`, a "module:function", solve lanes, in `processes` that share them and the threads.

    Args:
      solver, options: how it is opened, beside `threads` and `limit`.
      lanes: what it is given to load.
      limit: seconds for all of them.
      package: to be imported before the clock starts.
      together: load all lanes of a process at once, not one by one.
      processes: if more than one, the time per lane is the slowest one's.
      repeats: of a lane after its first solve; 0 for a solver that would start from its own answer.
      compiles: whether any lane may compile, and not the first alone. All are then solved once before they are timed.

    Raises:
      NoAnswer: if a process failed or was late.
    """
    processes = min(processes, len(lanes))
    cuts = [len(lanes) * k // processes for k in range(processes + 1)]
    shares = [lanes[low:high] for low, high in itertools.pairwise(cuts)]
    threads = THREADS // processes
    patience = limit * (2.5 if compiles else 1.0) + _START_UP  # compiling is not what the limit is for
    task = {"solver": solver, "options": options | {"threads": threads, "limit": limit}, "limit": limit}
    task |= {"package": package, "repeats": repeats, "compiles": compiles}
    with contextlib.ExitStack() as stack:
        workers = []
        for share in shares:
            groups = [share] if together else [[lane] for lane in share]
            worker = Worker("bench.processes", "run", task | {"groups": groups}, threads)
            workers.append(stack.enter_context(contextlib.closing(worker)))
        parts = [worker.receive(patience) for worker in workers]
    if processes == 1:
        return parts[0]
    # The slowest one's time, over all lanes.
    lists = [
        list(itertools.chain(*(getattr(part, name) for part in parts))) for name in ("answers", "words", "iterations")
    ]
    seconds = max(sum(part.seconds) for part in parts) / len(lists[0])
    build, compile_s = (max(getattr(part, name) for part in parts) for name in ("build_s", "compile_s"))
    peak = max(part.peak_gb for part in parts)
    return Found(*lists, [seconds] * len(lists[0]), build, compile_s, processes, peak)


class Worker:
    """A process that iterates over `MODULE.FUNCTION(**arguments)`, and sends what it finds.

    With a number of threads it is a silent one: solvers print.
    """

    def __init__(self, module: str, function: str, arguments: dict, threads: int | None = None):
        context = multiprocessing.get_context("spawn")
        self._is_heard = False
        self._pipe, other = context.Pipe(duplex=False)
        self._process = context.Process(target=_work, args=(other, module, function, arguments, threads is not None))
        self._start, before = time.perf_counter(), dict(os.environ)
        if threads is not None:
            # OpenBLAS gains nothing from threads on what is factorised here, and loses much when it waits for one.
            os.environ.update(dict.fromkeys(_THREAD_VARIABLES, str(threads)) | {"OPENBLAS_NUM_THREADS": "1"})
        self._process.start()
        os.environ.clear()
        os.environ.update(before)
        other.close()

    def receive(self, patience: float = math.inf):
        """The next thing that it sends, until `patience` seconds after its start; None after the last.

        Raises:
          NoAnswer: if it failed, or is late.
        """
        left = max(patience - (time.perf_counter() - self._start), 0.0)
        if not self._pipe.poll(None if math.isinf(left) else left):
            raise NoAnswer("time limit", f"no answer in {patience:g} s")
        try:
            found = self._pipe.recv()
        except EOFError:
            self._process.join()
            raise NoAnswer("failed", f"exit code {self._process.exitcode}") from None
        if isinstance(found, NoAnswer):
            raise found
        self._is_heard = True
        return found

    def close(self) -> None:
        """Ends the process, at once if it is late, else once it has put its things away."""
        self._process.join(_GOODBYE if self._is_heard else 0.0)
        self._process.kill()
        self._process.join()


def _work(pipe, module: str, function: str, arguments: dict, is_silent: bool) -> None:
    """The other side."""
    if is_silent:
        for stream in (1, 2):
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
    try:
        for found in getattr(importlib.import_module(module), function)(**arguments):
            pipe.send(found)
        pipe.send(None)
    except Exception as error:  # whatever a solver raises is for a row to say
        pipe.send(NoAnswer("failed", f"{type(error).__name__}: {error}"[:200]))


def timed(call, repeats: int = _REPEATS, *, wait: float = math.inf, enough: float = math.inf, between=None) -> tuple:
    """(result, seconds of the first call, median of the next ones, or the first's if there are none).

    A first call of more than `wait` seconds is not repeated; more than `enough` seconds of repetitions are not needed.
    `between()` comes before each of them, untimed.
    """

    def once():
        start = time.perf_counter()
        result = call()
        return result, time.perf_counter() - start

    (result, first), later = once(), []
    while first <= wait and len(later) < repeats and sum(later) <= enough:
        if between is not None:
            between()
        result, seconds = once()
        later.append(seconds)
    return result, first, statistics.median(later or [first])


def run(
    solver: str, options: dict, groups: list[list], limit: float, package: str, repeats: int, compiles: bool
) -> Iterator[Found]:
    """Opens a solver, and has it load and solve group after group; in a process of its own."""
    module, name = solver.split(":")
    opened = getattr(importlib.import_module(f"bench.{module}"), name)
    importlib.import_module(package)
    begin = time.perf_counter()
    found = opened(**options)
    start = time.perf_counter()
    build, compile_s, slowest = start - begin, 0.0, 0.0
    enough = _SHARE_OF_REPEATS * limit if compiles else _ENOUGH_SECONDS
    answers, seconds = [], []
    for group in groups:
        left = limit - (time.perf_counter() - start)
        if answers and slowest > left:
            break
        load = functools.partial(found.load, group)
        _, build_s, _ = timed(load, 0)
        # A lane that need not be solved twice is repeated only where that costs nothing.
        wait = limit if compiles else enough if answers else _SHARE_OF_REPEATS * limit
        solve = functools.partial(found.solve, left)
        solved, first, median = timed(solve, repeats, wait=wait, enough=enough, between=load)
        if not answers:
            compile_s = max(first - median, 0.0)
        build, slowest = build + build_s, max(slowest, median)
        answers += getattr(found, "read", list)(solved)
        seconds += [median / len(group)] * len(group)
    yield Found(*map(list, zip(*answers, strict=True)), seconds, build, compile_s, peak_gb=peak_gb())


def peak_gb() -> float:
    """The most memory that this process held, in 1e9 bytes."""
    status = pathlib.Path("/proc/self/status")
    if status.exists():  # `getrusage` begins at what the parent held
        lines = (line.split() for line in status.read_text().splitlines())
        return next((1024e-9 * int(words[1]) for words in lines if words[0] == "VmHWM:"), 0.0)
    unit = 1.0 if sys.platform == "darwin" else 1024.0
    return 1e-9 * unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
