"""Rows of single steps and of commands, each in fresh processes: without kept programs, and with those of a run before.

Of a step a row has the seconds of its first call (`bench.first_steps`), of a command those of the whole process.
"""

import json
import os
import pathlib
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator

from bench import first_steps

ROOT = pathlib.Path(__file__).resolve().parents[1]
_LAKE = "learn --env FrozenLake-v1 map_name=8x8 --expert 5 --lpal --features states --output out --no-pictures"
COMMANDS = {
    "python -m jaxhom": ["--picture", "policies.png"],
    "python -m jaxhom learn, FrozenLake 8x8 with LPAL": _LAKE.split(),
}
_REPEATS, _PATIENCE = 3, 900.0  # processes of a row, whose median counts; seconds


def rows(quick: bool) -> Iterator[dict]:
    """Of every step by us and by peers, then of every command; one step if quick."""
    for step, methods in {"import jaxhom beside jax": {"jaxhom": None}, **first_steps.STEPS}.items():
        for method in methods:
            for cache in ("none", "kept") if method == "jaxhom" else ("none",):
                yield {"instance": step, "method": method, "cache": cache} | _step(step, method, cache, quick)
        if quick:
            return
    for title, arguments in COMMANDS.items():
        for cache in ("none", "kept"):
            yield {"instance": title, "method": "jaxhom", "cache": cache} | _command(arguments, cache)


def _step(step: str, method: str, cache: str, quick: bool) -> dict:
    def once(folder: str, variables: dict) -> dict:
        return json.loads(_output(["-m", "bench.first_steps", step, method], folder, variables).splitlines()[-1])

    found = _in_fresh_processes(once, cache, 1 if quick else _REPEATS)
    names = set.intersection(*map(set, found))
    return {name: statistics.median(one[name] for one in found) for name in names}


def _command(arguments: list[str], cache: str) -> dict:
    def once(folder: str, variables: dict) -> float:
        begun = time.perf_counter()
        _output(["-m", "jaxhom", *arguments], folder, variables)
        return time.perf_counter() - begun

    return {"first_s": statistics.median(_in_fresh_processes(once, cache, _REPEATS))}


def _in_fresh_processes(once, cache: str, repeats: int) -> list:
    """What `once` returns, so many times: all without a folder for programs, or all but one with what that one kept."""
    with tempfile.TemporaryDirectory() as folder:
        if cache == "none":  # neither JAX nor Numba finds anything
            numba = [os.path.join(folder, f"numba{number}") for number in range(repeats)]
            return [once(folder, {"JAXHOM_CACHE": "off", "NUMBA_CACHE_DIR": place}) for place in numba]
        return [once(folder, {"JAXHOM_CACHE": os.path.join(folder, "kept")}) for _ in range(1 + repeats)][1:]


def _output(arguments: list[str], folder: str, variables: dict) -> str:
    variables = os.environ | {"PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg"} | variables
    command = [sys.executable, *arguments]
    ended = subprocess.run(command, cwd=folder, env=variables, capture_output=True, text=True, timeout=_PATIENCE)
    if ended.returncode:
        raise RuntimeError(f"{' '.join(arguments)}: {ended.stderr.strip().splitlines()[-1]}")
    return ended.stdout
