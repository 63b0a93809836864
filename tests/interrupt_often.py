"""Ctrl-C at many random moments of the main job and of `learn`, by hand: `python tests/interrupt_often.py 100`.

Each run must end with exit code 130 and one line on stderr, and what was finished must be there whole.
`test_interrupts` tries a handful of moments by the same rules.
"""

import collections
import os
import pathlib
import random
import re
import signal
import subprocess
import sys
import tempfile
import time

import numpy as np

ROOT = pathlib.Path(__file__).resolve().parent.parent
LEARN = ["learn", "--env", "FrozenLake-v1", "--expert", "2", "--lpal", "--features", "states", "--output", "out"]
JOBS = {
    "main job": ["--grid", "6", "--regions", "4", "--demonstrations", "2", "--sets", "2"],
    "learn": LEARN,
    "learn, slow LPAL": [*LEARN, "--method", "maximum-entropy", "--lpal-tolerance", "1e-300"],
}
_STARTED = 0.3  # seconds by which Python itself has started, so that the library is there to answer


_WATCH = "import os, signal, sys; signal.signal(signal.SIGINT, signal.SIG_DFL); os.execv(sys.argv[1], sys.argv[1:])"


def watching(*arguments) -> list[str]:
    """A command for Python that watches for Ctrl-C, even where its parent runs in the background and ignores it."""
    return [sys.executable, "-ISc", _WATCH, sys.executable, *arguments]


def start(arguments, **options) -> subprocess.Popen:
    """The command line, watching for Ctrl-C."""
    options["env"] = {**os.environ, "PYTHONPATH": str(ROOT), **options.get("env", {})}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(watching("-m", "jaxhom", *arguments), **pipes, **options)


def interrupt(arguments, seconds: float, folder) -> str:
    """Interrupts a run after so many seconds, twice, as impatient people do.

    Returns:
      "interrupted" if all is as it should be, "done before" if there was nothing left to interrupt; else what is wrong.
    """
    process = start(arguments, cwd=folder)
    try:
        output, error = process.communicate(timeout=seconds)
        return "done before" if process.returncode == 0 and not error else f"exit code {process.returncode}: {error}"
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGINT)
        process.send_signal(signal.SIGINT)
    try:
        output, error = process.communicate(timeout=60)
    except subprocess.TimeoutExpired:
        process.kill()
        return "goes on for a minute"
    if process.returncode == 0 and not error and re.search(r"^(Written|Picture)", output, re.MULTILINE):
        return "done before"  # within the last instant
    if process.returncode != 130 or error.count("\n") != 1 or not error.startswith("jaxhom: interrupted"):
        return f"exit code {process.returncode}: {error!r}"
    return what_is_missing(pathlib.Path(folder), output, error) or "interrupted"


def what_is_missing(folder: pathlib.Path, output: str, error: str) -> str:
    """What an interrupted run does not keep of what it had finished; empty if nothing."""
    if half := [str(path) for path in folder.rglob("*.partial")]:
        return f"left behind: {half}"
    if output and not output.endswith("\n"):
        return f"half a line: {output[-80:]!r}"
    named = error.partition("written so far: ")[2].strip()
    for path in folder.rglob("*.*"):
        if path.suffix == ".npz":
            with np.load(path) as archive:
                assert all(archive[name].size for name in archive.files), path
        if path.suffix == ".png" and not path.read_bytes().endswith(b"IEND\xaeB`\x82"):
            return f"half a picture: {path}"
    missing = [name for name in named.split(", ") if named not in ("", "nothing") and not (folder / name).exists()]
    return f"said to be written: {missing}" if missing else ""


def _duration(arguments) -> float:
    """Seconds of a run that nobody interrupts, 30 at most."""
    with tempfile.TemporaryDirectory() as folder:
        begin = time.monotonic()
        process = start(arguments, cwd=folder)
        try:
            process.communicate(timeout=30)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
        return time.monotonic() - begin


def main(count: int) -> int:
    """Interrupts each job so often; prints what happened; the number of runs that were not as they should be."""
    rng, wrong = random.Random(0), 0
    for name, arguments in JOBS.items():
        longest, seen = _duration(arguments), collections.Counter()
        for _ in range(count):
            moment = rng.uniform(_STARTED, longest)
            with tempfile.TemporaryDirectory() as folder:
                result = interrupt(arguments, moment, folder)
            seen[result] += 1
            if result not in ("interrupted", "done before"):
                wrong += 1
                print(f"{name}, after {moment:.2f} s: {result}", flush=True)
        print(f"{name} ({longest:.1f} s), {count} times:", dict(seen), flush=True)
    return wrong


if __name__ == "__main__":
    sys.exit(min(main(int(sys.argv[1]) if len(sys.argv) > 1 else 100), 125))
