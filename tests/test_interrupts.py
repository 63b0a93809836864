"""Ctrl-C at any moment gives one line and exit code 130; a reader who has seen enough is no error.

`JAXHOM_INTERRUPTS=100 python -m pytest -n 0 tests/test_interrupts.py` tries as many moments as that.
"""

import os
import pathlib
import random
import signal
import subprocess
import sys
import time

import pytest

from jaxhom import interrupts

ROOT = pathlib.Path(__file__).resolve().parent.parent
MAIN_JOB = ["--grid", "6", "--regions", "4", "--demonstrations", "2", "--sets", "2"]
LEARN = ["learn", "--env", "FrozenLake-v1", "--expert", "2", "--no-pictures"]
MOMENTS = random.Random(0).choices(range(300, 9000), k=int(os.environ.get("JAXHOM_INTERRUPTS", 4)))  # milliseconds


def start(arguments, **options):
    """The command line, watching for Ctrl-C even where the tests themselves run in the background."""
    command = [sys.executable, "-m", "jaxhom", *arguments]
    restore = lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)  # noqa: E731
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "env": environment}
    return subprocess.Popen(command, **pipes, preexec_fn=restore, **options)


@pytest.mark.parametrize("number", range(len(MOMENTS)))
def test_an_interruption_is_one_line(number, tmp_path):
    arguments = [*LEARN, "--output", str(tmp_path / "out")] if number % 2 else MAIN_JOB
    process = start(arguments, cwd=tmp_path)
    time.sleep(MOMENTS[number] / 1000)
    process.send_signal(signal.SIGINT)
    process.send_signal(signal.SIGINT)  # an impatient second one changes nothing
    _, error = process.communicate(timeout=120)
    if process.returncode:
        assert process.returncode == interrupts.INTERRUPTED
        assert error.decode().startswith("jaxhom: interrupted") and error.count(b"\n") == 1
    assert not list(tmp_path.rglob("*.partial"))


def test_a_reader_who_leaves_loses_nothing(tmp_path):
    with start([*LEARN, "--output", str(tmp_path / "out")]) as process:
        process.stdout.close()
        error = process.stderr.read()
    assert process.returncode == 0 and error == b""
    assert (tmp_path / "out" / "policy.npz").exists() and (tmp_path / "out" / "report.json").exists()


def test_a_name_that_the_terminal_cannot_show(tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    target = os.fsencode(tmp_path) + "/p\N{LATIN SMALL LETTER O WITH DIAERESIS}l.npz".encode()
    command = [sys.executable, "-m", "jaxhom", *LEARN, "--output", target]
    done = subprocess.run(command, env=environment, capture_output=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr.decode(errors="replace")
    assert os.path.exists(target)


def test_what_somebody_swallows_is_raised_again(monkeypatch):
    monkeypatch.setattr(interrupts, "_AGAIN", 0.05)
    handlers = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGALRM)]
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        interrupts.watch()
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(1)
        with pytest.raises(KeyboardInterrupt):
            time.sleep(1)
        interrupts.rest()
        time.sleep(0.2)
    finally:
        interrupts.rest()
        for number, handler in zip((signal.SIGINT, signal.SIGALRM), handlers, strict=True):
            signal.signal(number, handler)
