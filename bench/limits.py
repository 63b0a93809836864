"""Runs a measurement in a process of its own, with a number of threads and a time limit that holds.

Solvers differ in whether they keep to a time limit, in what they leave in memory and in which threads they start; a
process that can be ended settles all three.
"""

import importlib
import itertools
import os
import pathlib
import pickle
import subprocess
import sys
import tempfile
import time

THREADS = 2
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "RAYON_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def start(module: str, function: str, task: dict, threads: int = THREADS) -> "Job":
    """Starts `bench.MODULE.FUNCTION(**task)`; task and result are pickled."""
    folder = tempfile.TemporaryDirectory()
    task_path, result_path, log_path = (pathlib.Path(folder.name) / name for name in ("task", "result", "log"))
    task_path.write_bytes(pickle.dumps(task))
    # OpenBLAS gains nothing from threads on what is factorised here, and loses much when it has to wait for one.
    environment = os.environ | dict.fromkeys(_THREAD_VARIABLES, str(threads)) | {"OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "bench.limits", module, function, str(task_path), str(result_path)]
    with log_path.open("w") as log:
        process = subprocess.Popen(command, env=environment, stdout=log, stderr=log)
    return Job(process, folder, result_path, log_path)


class Job:
    """A running measurement."""

    def __init__(self, process, folder, result_path: pathlib.Path, log_path: pathlib.Path):
        self._process, self._folder = process, folder
        self._result, self._log = result_path, log_path
        self._start = time.perf_counter()

    def result(self, limit: float):
        """What the function returned, or None if it took longer than `limit` seconds since the start.

        Raises:
          RuntimeError: if the process failed, with the last line that it wrote.
        """
        try:
            left = max(limit - (time.perf_counter() - self._start), 0.0)
            code = self._process.wait(left)
            if code == 0 and self._result.exists():
                return pickle.loads(self._result.read_bytes())
            lines = self._log.read_text(errors="replace").strip().splitlines() or [""]
            raise RuntimeError(f"exit code {code}: {lines[-1][:200]}")
        except subprocess.TimeoutExpired:
            return None
        finally:
            self.stop()

    def stop(self) -> None:
        """Ends the process, if it still runs, and removes its files."""
        self._process.kill()
        self._process.wait()
        self._folder.cleanup()


def side_by_side(module: str, function: str, task: dict, key: str, values, processes: int, limit: float):
    """Shares `values` between processes, each with its part of the threads, and returns what they found, in order.

    None if one of them took longer than `limit` seconds.
    """
    processes = min(processes, len(values))
    threads = THREADS // processes
    cuts = [len(values) * k // processes for k in range(processes + 1)]
    shares = [values[low:high] for low, high in itertools.pairwise(cuts)]
    jobs = [start(module, function, task | {key: share, "threads": threads}, threads) for share in shares]
    try:
        parts = [job.result(limit) for job in jobs]
    finally:
        for job in jobs:
            job.stop()
    return None if any(part is None for part in parts) else parts


def main() -> None:
    """The other side: reads the task, calls the function with its entries, and writes what it returns."""
    module, function, task_path, result_path = sys.argv[1:]
    call = getattr(importlib.import_module(f"bench.{module}"), function)
    result = call(**pickle.loads(pathlib.Path(task_path).read_bytes()))
    pathlib.Path(result_path).write_bytes(pickle.dumps(result))


if __name__ == "__main__":
    main()
