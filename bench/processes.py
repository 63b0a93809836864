"""One protocol for whoever is measured, this library included: open, load, solve, close.

    solver = opened(**options)     what the model alone decides, in the solver's own form
    solver.load(lanes)             one lane, or several that are solved together
    solver.solve(seconds)          [(answer, the solver's word, iterations), ...], one for each of these lanes;
                                   a solver with `read(solution)` makes this list of its solution untimed

Opening and loading are building (`build_s`); what a first solve takes beyond the next is compiling (`compile_s`); the
rest is `seconds`. Every measurement has a process of its own, with a number of threads and a time limit: solvers differ
in whether they keep to a limit, in what they leave in memory and in which threads they start, and a process that can be
ended settles all three. Its end closes the solver.
"""

import contextlib
import dataclasses
import importlib
import itertools
import math
import os
import pathlib
import pickle
import statistics
import subprocess
import sys
import tempfile
import time

THREADS = 2  # the cores of the machine that the committed rows are from
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "RAYON_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
_START_UP = 60.0  # seconds to import, build and compile, beyond the limit
_REPEATS = 3  # an odd number, for the median
_ENOUGH_SECONDS = 0.5  # of repetitions of a lane: from then on its noise is below a few percent
_SHARE_OF_REPEATS = 0.1  # of the limit: a lane that takes longer is not repeated, so that all fit in


class NoAnswer(Exception):
    """Nothing to judge: `fields` say in a row why."""

    def __init__(self, status: str, note: str):
        super().__init__(f"{status}: {note}")
        self.fields = {"status": status, "note": note}


@dataclasses.dataclass(frozen=True)
class Found:
    """What was found for the lanes that ended before the limit.

    Attributes:
      answers, words, iterations: per lane; an answer is None where the solver has none.
      seconds: per lane; of lanes that were solved together, the whole divided by their number.
      build_s, compile_s: see above.
      processes: that shared the lanes.
    """

    answers: list
    words: list[str]
    iterations: list[int]
    seconds: list[float]
    build_s: float
    compile_s: float
    processes: int = 1


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
        jobs = []
        for share in shares:
            groups = [share] if together else [[lane] for lane in share]
            jobs.append(stack.enter_context(_started(task | {"groups": groups}, threads)))
        parts = [_result(*job, patience) for job in jobs]
    return parts[0] if processes == 1 else _joined(parts)


def _joined(parts: list[Found]) -> Found:
    """One answer of processes that ran side by side: the slowest one's time, over all lanes."""
    lists = [list(itertools.chain(*(getattr(part, name) for part in parts))) for name in ("answers", "words")]
    iterations = [count for part in parts for count in part.iterations]
    seconds = max(sum(part.seconds) for part in parts) / len(iterations)
    build, compile_s = (max(getattr(part, name) for part in parts) for name in ("build_s", "compile_s"))
    return Found(*lists, iterations, [seconds] * len(iterations), build, compile_s, len(parts))


@contextlib.contextmanager
def _started(task: dict, threads: int):
    """A process at work on a task, and the folder that holds its files; both are gone afterwards."""
    # OpenBLAS gains nothing from threads on what is factorised here, and loses much when it has to wait for one.
    environment = os.environ | dict.fromkeys(_THREAD_VARIABLES, str(threads)) | {"OPENBLAS_NUM_THREADS": "1"}
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        (folder / "task").write_bytes(pickle.dumps(task))
        with (folder / "log").open("w") as log:
            command = [sys.executable, "-m", "bench.processes", name]
            process = subprocess.Popen(command, env=environment, stdout=log, stderr=log)
        try:
            yield process, folder, time.perf_counter()
        finally:
            process.kill()
            process.wait()


def _result(process, folder: pathlib.Path, start: float, patience: float) -> Found:
    try:
        code = process.wait(max(patience - (time.perf_counter() - start), 0.0))
    except subprocess.TimeoutExpired:
        raise NoAnswer("time limit", f"no answer in {patience:g} s") from None
    if code or not (folder / "result").exists():
        lines = (folder / "log").read_text(errors="replace").strip().splitlines() or [""]
        raise NoAnswer("failed", f"exit code {code}: {lines[-1][:200]}")
    return pickle.loads((folder / "result").read_bytes())


def timed(call, repeats: int = _REPEATS, *, wait: float = math.inf, enough: float = math.inf) -> tuple:
    """(result, seconds of the first call, median of the next ones, or the first's if there are none).

    A first call of more than `wait` seconds is not repeated; more than `enough` seconds of repetitions are not needed.
    """

    def once():
        start = time.perf_counter()
        result = call()
        return result, time.perf_counter() - start

    (result, first), later = once(), []
    while first <= wait and len(later) < repeats and sum(later) <= enough:
        result, seconds = once()
        later.append(seconds)
    return result, first, statistics.median(later or [first])


def run(
    solver: str, options: dict, groups: list[list], limit: float, package: str, repeats: int, compiles: bool
) -> Found:
    """Opens a solver, and has it load and solve group after group; to be called in a process of its own."""
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
        _, build_s, _ = timed(lambda group=group: found.load(group), 0)
        # A lane that need not be solved twice is repeated only where that costs nothing.
        wait = limit if compiles else enough if answers else _SHARE_OF_REPEATS * limit
        solved, first, median = timed(lambda left=left: found.solve(left), repeats, wait=wait, enough=enough)
        if not answers:
            compile_s = max(first - median, 0.0)
        build, slowest = build + build_s, max(slowest, median)
        answers += getattr(found, "read", list)(solved)
        seconds += [median / len(group)] * len(group)
    return Found(*map(list, zip(*answers, strict=True)), seconds, build, compile_s)


def main() -> None:
    """The other side: reads the task, and writes what is found."""
    folder = pathlib.Path(sys.argv[1])
    found = run(**pickle.loads((folder / "task").read_bytes()))
    (folder / "result").write_bytes(pickle.dumps(found))


if __name__ == "__main__":
    importlib.import_module("bench.processes").main()  # what is pickled must not be of __main__
