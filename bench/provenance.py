"""Where a row comes from: the commit and the versions of what made it."""

import functools
import pathlib
import platform
import subprocess
from importlib import metadata

ROOT = pathlib.Path(__file__).resolve().parent.parent
RESULTS = ROOT / "bench" / "results"


@functools.cache
def provenance(*packages: str) -> dict[str, str]:
    """The columns `commit` and `versions`, the latter of those packages that are installed."""
    found = []
    for name in ("jaxhom", *packages):
        try:
            found.append(f"{name} {metadata.version(name)}")
        except metadata.PackageNotFoundError:
            continue
    found.append(f"python {platform.python_version()} {platform.machine()}")
    return {"commit": _commit(), "versions": "; ".join(found)}


def _commit() -> str:
    """The commit of the checkout, with "+" if the code differs from it; empty outside a checkout."""

    def git(*arguments):
        command = ["git", "-C", str(ROOT), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        changed = git("status", "--porcelain", "--", "jaxhom", "bench", ":!bench/results")
        return git("rev-parse", "--short=12", "HEAD") + ("+" if changed else "")
    except (OSError, subprocess.CalledProcessError):
        return ""
