"""Threads, processes and executors of others: the same rows as on one core, and none lost when workers die."""

import collections
import contextlib
import functools
import multiprocessing
import os
import pickle
import queue
import signal
import subprocess
import threading
import time
import types
from concurrent.futures import BrokenExecutor, Executor, Future, ThreadPoolExecutor

import jax
import jax.numpy as jnp
import pytest
import sweep_works
from interrupt_often import watching
from sweep_works import NUMBERS, deadly, expected, found, scaled

from jaxhom import sweeps
from jaxhom.sweeps import attempts, crews, dispatch
from jaxhom.sweeps.cases import checked_jobs


class Elsewhere(Executor):
    """Another process, as seen from here: what goes there and comes back is pickled. The least an executor can be."""

    def __init__(self):
        self.most, self.busy, self.lock = 0, 0, threading.Lock()

    def submit(self, fn, /, *args, **options):
        packed, future = pickle.dumps((fn, args, options)), Future()
        future.set_running_or_notify_cancel()
        with self.lock:
            self.busy += 1
            self.most = max(self.most, self.busy)

        def compute():
            try:
                function, positional, named = pickle.loads(packed)
                answer = pickle.dumps(function(*positional, **named))
            except Exception as error:
                future.set_exception(error)
                return
            with self.lock:
                self.busy -= 1
            future.set_result(pickle.loads(answer))

        threading.Thread(target=compute).start()
        return future


def run(work, cases, folder, **options):
    return sweeps.run(work, cases, folder / "rows.jsonl", progress=False, **options)


def test_threads(tmp_path):
    with ThreadPoolExecutor(3) as threads:
        assert found(run(scaled, NUMBERS, tmp_path, executor=threads)) == expected()


def test_any_executor_gets_a_bounded_number_at_a_time(tmp_path):
    executor = Elsewhere()
    assert found(run(scaled, NUMBERS, tmp_path, executor=executor, in_flight=3)) == expected()
    assert executor.most <= 3


def float_type(case):
    """Of JAX, in this worker."""
    return {"dtype": str(jnp.ones(1).dtype)}


def test_processes_compute_in_the_callers_floats_and_are_replaced(tmp_path):
    """One dies in the middle, once; every row is there once, and the first ones were done in parallel processes."""
    cases = [{**case, "kills": "once" if case["x"] == 3 else "no", "marker": str(tmp_path / "m")} for case in NUMBERS]
    rows = run(deadly, cases, tmp_path, executor=1)
    assert [row["y"] for row in rows] == [0.1 * x for x in range(12)] and (tmp_path / "m").exists()
    assert all(row["x64"] for row in rows) and (tmp_path / "rows.jsonl").read_text().count("\n") == 12
    (tmp_path / "again").mkdir()
    work, wide = float_type, jax.config.jax_enable_x64
    assert wide and run(work, [{"x": 1}], tmp_path / "again", executor=Elsewhere())[0]["dtype"] == "float64"


def in_array(array, case):
    """An array that travels with the work."""
    return {"y": float(array[0]), "dtype": str(array.dtype)}


def test_arrays_that_travel_with_the_work_keep_their_width():
    """Also to a worker that somebody else started, in which floats are narrow until the first case."""
    work = attempts.ship(functools.partial(in_array, jnp.array([0.1])))
    attempts._load.cache_clear()
    jax.config.update("jax_enable_x64", False)
    try:
        (row,) = attempts.attempt(work, {"x": 1}, is_batch=False)
    finally:
        jax.config.update("jax_enable_x64", True)
    assert (row["y"], row["dtype"], row["x64"]) == (0.1, "float64", True)


class Fragile(Executor):
    """A pool of one thread that breaks, with all that is in it, when it takes up a deadly case.

    `deadly`: how often each case is, by its number.
    """

    def __init__(self, deadly):
        self.deadly, self.thread, self.is_broken = deadly, ThreadPoolExecutor(1), False

    def submit(self, fn, /, work, given, is_batch):
        if self.is_broken:
            raise BrokenExecutor("broken before")
        return self.thread.submit(self.do, fn, work, given, is_batch)

    def do(self, fn, work, given, is_batch):
        for case in () if self.is_broken else given if is_batch else [given]:
            if self.deadly[case["x"]] > 0:
                self.deadly[case["x"]] -= 1
                self.is_broken = True
        if self.is_broken:
            raise BrokenExecutor("a worker died")
        return fn(work, given, is_batch)


def dispatched(cases, deadly, pool=Fragile):
    """Rows of `scaled` by a pool that is replaced, and how many pools there were."""
    pools, rows = [], []

    def make():
        pools.append(pool(deadly))
        return pools[-1]

    def write(outcomes):
        for job, results in outcomes:
            rows.extend({**case.columns, **result} for case, result in zip(job.cases, results, strict=True))

    crew = crews.Crew(make(), 4, make)
    dispatch.Dispatch(sweep_works.each(scaled), [[job] for job in checked_jobs(cases)], crew, write).run()
    for one in pools:
        one.thread.shutdown()
    return sorted(rows, key=lambda row: row["x"]), len(pools)


DEAD = "its worker died, again and again"


def test_a_case_that_takes_its_workers_with_it_is_found_and_no_other_is_blamed():
    rows, pools = dispatched(NUMBERS, collections.Counter({2: 99, 4: 1, 9: 2}))
    assert rows[2] == {**NUMBERS[2], "error": DEAD} and pools == 1 + 3 + 1 + 2
    errors = {row["x"]: row["error"] for row in rows if row.get("error")}
    assert errors == {2: DEAD, 5: "ValueError: five is right out"} and len(rows) == 12
    assert [row["y"] for row in rows if not row.get("error")] == [0.1 * x for x in range(12) if x not in errors]


class KilledWorker(Exception):
    """As Dask says it, whose clusters do not break."""


class Cluster(Fragile):
    def do(self, fn, work, given, is_batch):
        try:
            return super().do(fn, work, given, is_batch)
        except BrokenExecutor:
            self.is_broken = False
            raise KilledWorker(given) from None


def test_what_dask_gives_up_is_tried_alone_once_more():
    rows, pools = dispatched(NUMBERS, collections.Counter({2: 99, 4: 1}), pool=Cluster)
    assert {row["x"]: row["error"] for row in rows if row["x"] in (2, 4) and "error" in row} == {2: DEAD}
    assert pools == 1 and [row["x"] for row in rows] == list(range(12)) and rows[4]["y"] == 0.1 * 4


def test_of_a_batch_the_deadly_case_is_found():
    rows, pools = dispatched([NUMBERS[:4], NUMBERS[6:8], NUMBERS[8:]], collections.Counter({2: 99, 9: 1}))
    assert {row["x"]: row["error"] for row in rows if row.get("error")} == {2: DEAD} and len(rows) == 10
    assert pools == 1 + 3 + 1 + 1  # the batch three times, the case once more; the other batch once


def test_a_given_pool_that_breaks_is_not_replaced(tmp_path):
    """What was finished stays, and the same call goes on."""
    pool = Fragile(collections.Counter({7: 1}))
    message = r"gave up \(BrokenExecutor: .*\); what is finished is written, and the same call goes on from there"
    with pool.thread, pytest.raises(RuntimeError, match=message):
        run(scaled, NUMBERS, tmp_path, executor=pool, in_flight=2)
    held = sweeps.read(tmp_path / "rows.jsonl")
    assert 5 <= len(held) <= 7 and found(held) == expected(NUMBERS[: len(held)])
    rows = run(scaled, NUMBERS, tmp_path, executor=Fragile(collections.Counter()))
    assert found(rows) == expected() and rows[: len(held)] == held


def test_an_executor_that_was_shut_down_is_said(tmp_path):
    with ThreadPoolExecutor(1) as threads:
        pass
    with pytest.raises(RuntimeError, match="gave up .*cannot schedule new futures after shutdown.*goes on from there"):
        run(scaled, NUMBERS, tmp_path, executor=threads)


def test_work_that_workers_cannot_load_is_said_and_no_row(tmp_path):
    work = Unloadable()
    with pytest.raises(RuntimeError, match=r"gave up \(ModuleNotFoundError: No module named 'nowhere'\)"):
        run(work, NUMBERS, tmp_path, executor=Elsewhere())
    assert sweeps.read(tmp_path / "rows.jsonl") == []


class Unloadable:
    def __call__(self, case):
        return {}

    def __reduce__(self):
        return __import__, ("nowhere",)


def test_ctrl_c_in_a_thread_keeps_what_is_in_progress(tmp_path, capsys):
    """The case in the other thread is finished and written, those behind it are not begun."""
    begun = threading.Event()

    def work(case):
        if case["x"] == 1:
            begun.wait(10)
            raise KeyboardInterrupt
        begun.set()
        time.sleep(0.1)
        return {"y": 0.1 * case["x"]}

    with ThreadPoolExecutor(2) as threads, pytest.raises(KeyboardInterrupt):
        run(work, NUMBERS, tmp_path, executor=threads)
    held = sweeps.read(tmp_path / "rows.jsonl")
    assert held[0]["x"] == 0 and len(held) <= 3 and "stopping" in capsys.readouterr().err


STOPPED = """
import sys
from sweep_works import slow
from jaxhom import sweeps

if __name__ == "__main__":
    cases = [{"x": x, "pause": 0.2, "log": sys.argv[1] + ".log"} for x in range(200)]
    sweeps.run(slow, cases, sys.argv[1], executor=1, progress=False)
"""


def test_ctrl_c_with_processes(tmp_path):
    """The processes, which get the signal too, finish what they are at; what was begun is what is written."""
    script, file = tmp_path / "script.py", tmp_path / "rows.jsonl"
    script.write_text(STOPPED)
    here = os.path.dirname(__file__)
    options = {"stderr": subprocess.PIPE, "start_new_session": True}
    options["env"] = os.environ | {"PYTHONPATH": os.pathsep.join([here, os.path.dirname(os.path.dirname(here))])}
    with subprocess.Popen(watching(str(script), str(file)), **options) as process:
        deadline = time.monotonic() + 120
        while (not file.exists() or file.read_bytes().count(b"\n") < 2) and time.monotonic() < deadline:
            assert process.poll() is None, process.stderr.read()
            time.sleep(0.01)
        os.killpg(process.pid, signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    assert process.returncode and errors.decode().strip().endswith("KeyboardInterrupt"), errors.decode()
    begun = [int(line) for line in (tmp_path / "rows.jsonl.log").read_text().splitlines()]
    assert 2 <= len(begun) < 20 and [row["x"] for row in sweeps.read(file)] == begun


def test_processes_that_do_not_start_are_no_fault_of_the_cases(tmp_path, monkeypatch):
    """As in a script that starts them while they import it."""
    monkeypatch.setattr(crews, "_begin", os._exit)
    with pytest.raises(
        RuntimeError, match="processes do not start; in a script, .* below `if __name__ == '__main__':`"
    ):
        run(scaled, NUMBERS, tmp_path, executor=1)
    assert sweeps.read(tmp_path / "rows.jsonl") == []


def test_processes_end_when_their_caller_is_killed(monkeypatch):
    """It cannot tell them."""
    killed, ended = threading.Event(), queue.SimpleQueue()
    monkeypatch.setattr(multiprocessing, "parent_process", lambda: types.SimpleNamespace(join=killed.wait))
    monkeypatch.setattr(os, "_exit", ended.put)
    monkeypatch.setattr(crews, "one_blas_thread", contextlib.nullcontext)
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    crews._begin({})
    assert ended.empty()
    killed.set()
    assert ended.get(timeout=10) == 1
