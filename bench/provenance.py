"""Where a row comes from: the commit and the versions of what made it."""

import functools
import pathlib

from jaxhom.sweeps.provenance import commit, versions

ROOT = pathlib.Path(__file__).resolve().parent.parent
RESULTS = ROOT / "bench" / "results"


@functools.cache
def provenance(*packages: str) -> dict[str, str]:
    """The columns `commit` and `versions`, the latter of those packages that are installed."""
    return {"commit": commit(ROOT), "versions": versions(*packages)}
