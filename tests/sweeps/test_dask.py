"""A Dask cluster of two worker processes on this machine: the same rows, whoever dies in the middle."""

import os
import pathlib
import signal
import subprocess
import sys
import threading
import time

import dask
import distributed
import pytest
import sweep_works
from sweep_works import NUMBERS, expected, found, scaled

from bench import methods, reproduce, settings, sweep
from bench.rows import RowFile
from jaxhom import sweeps


@pytest.fixture(scope="module")
def client():
    """Of two processes of one thread each."""
    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    with distributed.LocalCluster(processes=True, **options) as cluster, distributed.Client(cluster) as client:
        yield client


def run(work, cases, folder, **options):
    return sweeps.run(work, cases, folder / "rows.jsonl", progress=False, **options)


def test_the_same_rows_as_on_one_core(client, tmp_path):
    """By the client itself and by its executor; functions that were typed in are sent too."""
    assert found(run(scaled, NUMBERS, tmp_path, executor=client)) == expected()
    typed_in = lambda case: sweep_works.scaled(case)  # noqa: E731
    (tmp_path / "again").mkdir()
    assert found(run(typed_in, NUMBERS, tmp_path / "again", executor=client.get_executor())) == expected()


def test_a_worker_that_is_killed_in_the_middle(client, tmp_path):
    """Nothing is lost or doubled."""
    log, file = tmp_path / "log", tmp_path / "rows.jsonl"
    cases = [{"x": x, "log": str(log), "pause": 0.1} for x in range(30)]
    pids = client.run(os.getpid)

    def kill():
        while not file.exists() or file.read_bytes().count(b"\n") < 5:
            time.sleep(0.01)
        os.kill(min(pids.values()), signal.SIGKILL)

    thread = threading.Thread(target=kill)
    thread.start()
    rows = run(sweep_works.slow, cases, tmp_path, executor=client)
    thread.join()
    assert [row["y"] for row in rows] == [0.1 * x for x in range(30)] and not any(row["error"] for row in rows)
    assert file.read_bytes().count(b"\n") == 30
    begun = [int(line) for line in log.read_text().splitlines()]
    assert sorted({*begun}) == list(range(30)) and len(begun) > 30  # what the dead one was at was begun again
    assert {row["pid"] for row in rows} >= {*pids.values()}


LOCAL = """
import time, distributed
with distributed.LocalCluster(
    processes=False, protocol="tcp", n_workers=1, threads_per_worker=2, dashboard_address=None
) as cluster:
    print(cluster.scheduler_address, flush=True)
    time.sleep(600)
"""


@pytest.mark.filterwarnings("ignore")
def test_a_scheduler_that_is_killed_and_another_that_goes_on(client, tmp_path):
    file = tmp_path / "rows.jsonl"
    cases = [{"x": x, "pause": 0.1} for x in range(40)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "text": True, "env": environment}
    with subprocess.Popen([sys.executable, "-c", LOCAL], **options) as process:

        def kill():
            while not file.exists() or file.read_bytes().count(b"\n") < 3:
                time.sleep(0.01)
            process.kill()

        with distributed.Client(process.stdout.readline().strip(), set_as_default=False) as doomed:
            thread = threading.Thread(target=kill)
            thread.start()
            with pytest.raises(RuntimeError, match="the executor gave up .* the same call goes on from there"):
                run(sweep_works.slow, cases, tmp_path, executor=doomed)
            thread.join()
    before = file.read_bytes()
    held = sweeps.read(file)
    assert 3 <= len(held) < 40
    rows = run(sweep_works.slow, cases, tmp_path, executor=client)
    assert [row["y"] for row in rows] == [0.1 * x for x in range(40)]
    assert file.read_bytes().startswith(before) and file.read_bytes().count(b"\n") == 40


def test_the_benchmarks_run_on_a_cluster(client, tmp_path, monkeypatch):
    """The same rows as in this process."""
    chosen = {name: getattr(methods, name) for name in ("expert", "manhattan_knn")}
    tiny = sweep.Sweep([settings.Setting("grid4", 4, 2, 2, 5, 5, threshold=0.1 * i) for i in range(2)], chosen, draws=2)
    monkeypatch.setitem(reproduce.SWEEPS, "questions", {"tiny": tiny})
    address = client.cluster.scheduler_address
    assert reproduce.main(["questions", "--output", str(tmp_path), "--scheduler", address, "--workers", "1"]) == 0
    there = RowFile(tmp_path / "raw" / "tiny.csv").read()
    sweep.run(tiny, RowFile(tmp_path / "here.csv"))
    here = RowFile(tmp_path / "here.csv").read()
    assert len(here) == 8 and {row.key: row.reward_per_step for row in there} == {
        row.key: row.reward_per_step for row in here
    }
    assert {row.dtype for row in there} == {"float64"} and pathlib.Path(tmp_path / "tiny.csv").exists()


def test_a_scheduler_that_is_not_there_is_said(tmp_path, capsys):
    with dask.config.set({"distributed.comm.timeouts.connect": "0.5s"}):
        options = ["--output", str(tmp_path), "--scheduler", "tcp://127.0.0.1:9"]
        assert reproduce.main(["table1", *options]) == 2
    assert "bench: error: " in capsys.readouterr().err
