"""Ctrl-C at any moment gives one line and exit code 130; a reader who has seen enough is no error.

A handful of moments here; `interrupt_often` tries as many as one likes.
"""

import os
import signal
import subprocess
import sys
import time

import interrupt_often
import pytest
from cli_cases import Files

from jaxhom import interrupts
from jaxhom.cli import parser
from jaxhom.cli.parser import main

LEARN = ["learn", "--env", "FrozenLake-v1", "--expert", "2", "--method", "maximum-entropy"]


@pytest.mark.parametrize(
    ("job", "seconds"), [("main job", 0.5), ("main job", 5.0), ("learn", 1.5), ("learn, slow LPAL", 7.0)]
)
def test_an_interruption_is_one_line(job, seconds, tmp_path):
    result = interrupt_often.interrupt(interrupt_often.JOBS[job], seconds, tmp_path)
    assert result in ("interrupted", "done before")


def test_a_reader_who_leaves_loses_nothing(tmp_path):
    """`learn | head`, and `learn 2>&1 | head` with a progress bar: on a name that a C locale cannot show."""
    locale = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    folder = os.fsencode(tmp_path) + "/p\N{LATIN SMALL LETTER O WITH DIAERESIS}l".encode()
    with interrupt_often.start([*LEARN, "--progress", "--output", os.fsdecode(folder)], env=locale) as process:
        process.stdout.close()
        process.stderr.close()
    assert process.returncode == 0
    names = sorted(os.fsdecode(name) for name in os.listdir(folder))
    pictures = ["generalization.png", "occupancy.png", "policy.png", "trajectories.png"]
    assert names == sorted([*pictures, "demonstrations.npz", "policy.npz", "report.json"])


def test_a_name_that_the_terminal_cannot_show_is_shown_as_far_as_it_goes(tmp_path):
    files = Files(tmp_path)
    arguments = ["plot", "trajectories", files.path("demos.csv"), "--mdp", files.path("model.npz"), "--output"]
    environment = {**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    target = os.fsencode(tmp_path) + b"/p\xc3\xb6l.png"
    command = [sys.executable, "-m", "jaxhom", *arguments, target]
    done = subprocess.run(command, env=environment, cwd=interrupt_often.ROOT, capture_output=True, check=False)
    assert done.returncode == 0 and done.stderr == b""
    assert os.path.exists(target) and rb"p\udcc3\udcb6l.png" in done.stdout


@pytest.fixture
def watched(monkeypatch):
    """`interrupts` at work in this process, where it leaves nothing behind."""
    monkeypatch.setattr(interrupts, "_AGAIN", 0.05)
    monkeypatch.setattr(interrupts, "_happened", False)
    monkeypatch.setattr(sys, "unraisablehook", sys.unraisablehook)
    handlers = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGALRM)]
    signal.signal(signal.SIGINT, signal.default_int_handler)
    interrupts.watch()
    yield
    interrupts.rest()
    for number, handler in zip((signal.SIGINT, signal.SIGALRM), handlers, strict=True):
        signal.signal(number, handler)


def test_what_somebody_swallows_is_raised_again(watched):
    with pytest.raises(KeyboardInterrupt):
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(1)
    with pytest.raises(KeyboardInterrupt):
        time.sleep(1)
    interrupts.rest()
    time.sleep(0.2)


def test_what_is_swallowed_with_an_object_is_raised_soon_and_says_nothing(watched, monkeypatch, capsys):
    monkeypatch.setattr(interrupts, "_AGAIN", 60.0)

    class Slow:
        def __del__(self):
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.01)

    with pytest.raises(KeyboardInterrupt):
        Slow()
        time.sleep(5)
    assert capsys.readouterr().err == ""


def test_what_an_interruption_turns_into_is_one(watched, monkeypatch, capsys):
    """Compiled programs and callbacks raise errors of their own for it."""

    def run(_):
        try:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(1)
        except KeyboardInterrupt:
            raise RuntimeError("INTERNAL: callback failed\nTraceback") from None

    monkeypatch.setattr(parser.main_job, "run", run)
    assert main([]) == 130
    assert capsys.readouterr().err == "jaxhom: interrupted\n"


def test_an_error_of_ours_is_none(monkeypatch):
    def run(_):
        raise RuntimeError("a defect")

    monkeypatch.setattr(parser.main_job, "run", run)
    with pytest.raises(RuntimeError, match="a defect"):
        main([])


@pytest.mark.parametrize(
    ("command", "is_ours"),
    [
        (["-m", "jaxhom", "learn"], True),
        (["-X", "dev", "-m", "jaxhom"], True),
        (["-m", "other", "jaxhom"], False),
        (["-m", "other", "-m", "jaxhom"], False),
        (["jaxhom"], False),
    ],
)
def test_only_our_own_command_is_watched_while_it_loads(watched, monkeypatch, command, is_ours):
    signal.signal(signal.SIGINT, signal.default_int_handler)
    monkeypatch.setattr(sys, "orig_argv", ["python", *command])
    monkeypatch.setattr(sys, "argv", ["-m"] if "-m" in command else command)
    interrupts.watch_while_loading()
    assert (signal.getsignal(signal.SIGINT) is not signal.default_int_handler) == is_ours


def test_a_parent_that_ignores_the_signal_is_obeyed(watched):
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    interrupts.watch()
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
