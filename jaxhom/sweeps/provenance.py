"""Where a row comes from: the commit of the code and the versions of what made it."""

from __future__ import annotations

import functools
import inspect
import pathlib
import platform
import subprocess
from collections.abc import Callable
from importlib import metadata

LIBRARIES = ("jax", "jaxlib", "numpy", "scipy")


@functools.cache
def versions(*packages: str) -> str:
    """Those of the library, of the packages that are installed, and of Python."""
    found = []
    for name in ("jaxhom", *packages):
        try:
            found.append(f"{name} {metadata.version(name)}")
        except metadata.PackageNotFoundError:
            continue
    found.append(f"python {platform.python_version()} {platform.machine()}")
    return "; ".join(found)


def commit(folder: pathlib.Path) -> str:
    """The commit of the checkout, with "+" if its Python files differ from it; empty outside a checkout."""

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(folder), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        changed = git("status", "--porcelain", "--", ":/*.py")
        return git("rev-parse", "--short=12", "HEAD") + ("+" if changed else "")
    except (OSError, subprocess.CalledProcessError):
        return ""


def folder_of(work: Callable) -> pathlib.Path:
    """Where the code of a callable is; the current folder if it was typed in."""
    while isinstance(work, functools.partial):
        work = work.func
    try:
        named = inspect.isroutine(work) or inspect.isclass(work)
        source = inspect.getsourcefile(inspect.unwrap(work) if named else type(work))
    except TypeError:  # of Python itself
        source = None
    folder = pathlib.Path(source or "typed in").resolve().parent
    return folder if folder.is_dir() else pathlib.Path.cwd()
