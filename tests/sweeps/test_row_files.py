"""Files of rows: killed writers, other people's files, two runs at a time."""

import errno
import json
import os
import signal
import subprocess
import sys
import time

import pandas as pd
import pytest
from sweep_works import NUMBERS, expected, found, scaled

from jaxhom import sweeps
from jaxhom.sweeps.line_files import LineFile


@pytest.fixture
def file(tmp_path):
    """Rows of the first three cases."""
    sweeps.run(scaled, NUMBERS[:3], tmp_path / "rows.jsonl", progress=False)
    return tmp_path / "rows.jsonl"


@pytest.mark.parametrize("length", [1, 10, -2, -1])
def test_a_line_cut_short_is_dropped_and_done_again(file, length):
    whole = file.read_bytes()
    lines = whole.splitlines(keepends=True)
    file.write_bytes(b"".join(lines[:-1]) + lines[-1][:length])
    assert len(sweeps.read(file)) == 2
    assert found(sweeps.run(scaled, NUMBERS, file, progress=False)) == expected()
    assert len(file.read_bytes().splitlines()) == 12


def test_pandas_reads_the_file(file):
    sweeps.run(lambda case: {"y": float("nan"), "z": float("inf")}, [{"x": 7}], file, progress=False)
    frame = pd.read_json(file, lines=True)
    assert frame["x"].tolist() == [0, 1, 2, 7] and frame["y"].tolist()[:3] == [0.0, 0.1, 0.2]
    assert frame["y"].isna()[3] and frame["z"][3] == float("inf")
    assert pd.DataFrame(sweeps.read(file))["y"].isna().tolist() == [False, False, False, True]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"x,y\n1,2\n", r"line 1 is no row of a sweep: 'x,y'"),
        (b'{"x": 1}\n', r"line 1 is no row of a sweep"),
        (b'{"x": 1, "case": ["z"]}\n', r"line 1 is no row of a sweep"),
        (b'{"x": 1, "case": 3}\n', r"line 1 is no row of a sweep"),
        (b"[1]\n", r"line 1 is no row of a sweep"),
        (b'{"x": 1}', r"ends in what is no row of a sweep: '\{\"x\": 1\}'"),
        (b"[1, 2", r"ends in what is no row of a sweep"),
        (b"3", r"ends in what is no row of a sweep"),
        (b"\xff\xfe\n", r"cannot be read as text"),
    ],
)
def test_what_is_no_file_of_rows_is_refused_and_left_alone(tmp_path, content, message):
    path = tmp_path / "other.jsonl"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=rf"other\.jsonl.*{message}"):
        sweeps.run(scaled, NUMBERS, path, progress=False)
    assert path.read_bytes() == content


def test_a_bad_line_in_the_middle_is_named(file):
    lines = file.read_text().splitlines(keepends=True)
    file.write_text(lines[0] + lines[1][:20] + "\n" + lines[2])
    with pytest.raises(ValueError, match=r"rows\.jsonl, line 2 is no row of a sweep"):
        sweeps.read(file)


def test_bad_names_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"rows\.csv: rows are lines of JSON, in files whose names end in \.jsonl"):
        sweeps.run(scaled, NUMBERS, tmp_path / "rows.csv")
    with pytest.raises(ValueError, match=r"none\.jsonl does not exist"):
        sweeps.read(tmp_path / "none.jsonl")
    (tmp_path / "folder.jsonl").mkdir()
    with pytest.raises(ValueError, match=r"folder\.jsonl cannot be written to: Is a directory"):
        sweeps.run(scaled, NUMBERS, tmp_path / "folder.jsonl")
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match=r"rows\.jsonl cannot be written to: "):
        sweeps.run(scaled, NUMBERS, tmp_path / "file" / "rows.jsonl")


def test_two_runs_on_one_file_are_refused(file):
    before = file.read_bytes()

    def greedy(case):
        with pytest.raises(ValueError, match=r"rows\.jsonl: another run is writing to it"):
            sweeps.run(scaled, NUMBERS, file, progress=False)
        return {"y": len(sweeps.read(file))}  # reading is always possible

    rows = sweeps.run(greedy, [{"x": 10}], file, progress=False)
    assert rows[0]["y"] == 3 and file.read_bytes().startswith(before)


def test_a_full_disk_leaves_whole_lines(file, monkeypatch):
    before, write = file.read_bytes(), os.write

    def half(descriptor, data):
        if len(data) < 20:
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(descriptor, data[: len(data) // 2])

    monkeypatch.setattr(os, "write", half)
    with pytest.raises(OSError, match="No space left"):
        sweeps.run(scaled, NUMBERS, file, progress=False)
    assert file.read_bytes() == before


KILLED = """
import os, signal, sys
from jaxhom import sweeps

def work(case):
    if case["x"] == 8 and sys.argv[2] == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    return {"y": 0.1 * case["x"]}

sweeps.run(work, [{"x": x, "scale": 0.1} for x in range(12)], sys.argv[1], progress=False)
"""


def test_a_killed_run_goes_on(tmp_path):
    """No lock is left, and no row is done twice."""
    path = tmp_path / "rows.jsonl"
    killed = subprocess.run([sys.executable, "-c", KILLED, str(path), "kill"], capture_output=True, check=False)
    assert killed.returncode == -signal.SIGKILL and len(sweeps.read(path)) == 8
    rows = sweeps.run(scaled, NUMBERS, path, progress=False)
    assert [row["y"] for row in rows] == [0.1 * x for x in range(12)]
    assert [json.loads(line)["x"] for line in path.read_text().splitlines()] == list(range(12))


@pytest.mark.filterwarnings("ignore:.*fork")
def test_a_process_that_was_forked_off_holds_no_lock(tmp_path):
    lines, (ready, say) = LineFile(tmp_path / "lines"), os.pipe()
    with lines.writing():
        child = os.fork()
        if child == 0:
            os.write(say, b"x")
            time.sleep(30)
            os._exit(0)
    os.read(ready, 1)
    try:
        with lines.writing():
            pass
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        os.close(ready)
        os.close(say)
