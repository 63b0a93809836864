"""Compiled programs in the user's folder for caches: kept by the command line, found again, moved, turned off."""

import os
import pathlib
import subprocess
import sys

import pytest

from jaxhom import programs

LEARN = ["learn", "--mdp", "walk.track", "--expert", "2", "--steps", "6", "--output", "out", "--no-pictures"]
TRACK = "XXXXXX\nXS  FX\nXXXXXX\n"


def learn(folder, *arguments, command=(), **variables):
    """The command line in a process of its own, at home in the folder; the files of programs that are below it then."""
    (folder / "walk.track").write_text(TRACK)
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("JAX", "XDG_"))}
    own = {"HOME": str(folder), "PYTHONPATH": str(pathlib.Path(programs.__file__).parents[1])}
    ended = subprocess.run(
        [sys.executable, "-m", "jaxhom", *command, *LEARN, *arguments],
        cwd=folder,
        env=kept | own | variables,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert (ended.returncode, ended.stderr) == (0, "")
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*-cache"))


def test_a_second_run_finds_what_the_first_one_kept(tmp_path):
    first = learn(tmp_path)
    assert first and all(name.startswith(os.path.join(".cache", "jaxhom", "")) for name in first)
    assert learn(tmp_path) == first


@pytest.mark.parametrize("how", ["after", "before", "variable"])
def test_nothing_is_kept(how, tmp_path):
    options = {
        "after": {"arguments": ["--no-cache"]},
        "before": {"command": ["--no-cache"]},
        "variable": {"JAXHOM_CACHE": "off"},
    }[how]
    assert learn(tmp_path, *options.pop("arguments", ()), **options) == []


@pytest.mark.parametrize("name", ["JAXHOM_CACHE", "JAX_COMPILATION_CACHE_DIR", "XDG_CACHE_HOME"])
def test_another_folder(name, tmp_path):
    more = {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}  # JAX's own folder keeps what takes long, by default
    found = learn(tmp_path, **{name: str(tmp_path / "elsewhere")} | more)
    assert found and all(name.startswith("elsewhere") for name in found)


def test_a_folder_that_cannot_be_made(tmp_path):
    (tmp_path / "file").write_text("")
    assert learn(tmp_path, JAXHOM_CACHE=str(tmp_path / "file")) == []


def test_where_systems_keep_what_can_be_made_again(monkeypatch, tmp_path):
    monkeypatch.setattr(pathlib.Path, "home", lambda: tmp_path)
    for name in ("XDG_CACHE_HOME", "LOCALAPPDATA", "JAXHOM_CACHE"):
        monkeypatch.delenv(name, raising=False)
    places = {"linux": ".cache", "darwin": "Library/Caches", "win32": "AppData/Local"}
    for system, place in places.items():
        monkeypatch.setattr(sys, "platform", system)
        folder = programs.folder_for_programs()
        assert folder.parent == tmp_path / place / "jaxhom" and folder.is_dir()
