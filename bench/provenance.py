"""Where a row comes from: the commit and the versions of what made it."""

import argparse
import functools
import pathlib

from jaxhom.sweeps.provenance import commit, versions

ROOT = pathlib.Path(__file__).resolve().parent.parent
RESULTS = ROOT / "bench" / "results"


def add_output(parser: argparse.ArgumentParser, default: pathlib.Path = RESULTS) -> None:
    """The options of a command that writes rows: where to, and whether from a tree with changes."""
    kind = "file" if default.suffix else "folder"
    named = default.relative_to(ROOT) if default.is_relative_to(ROOT) else default
    parser.add_argument("--output", type=pathlib.Path, default=default, help=f"{kind} (default {named})")
    parser.add_argument("--dirty", action="store_true", help="also from a tree with changes; not to be committed")


def require_clean(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """Ends the command if the tree has changes, `--output` is where committed rows are, and `--dirty` was not given."""
    if not options.dirty and options.output.resolve().is_relative_to(RESULTS) and commit(ROOT).endswith("+"):
        parser.error("the tree has changes: commit them, or write elsewhere (--output), or for a trial --dirty")


@functools.cache
def provenance(*packages: str) -> dict[str, str]:
    """The columns `commit` and `versions`, the latter of those packages that are installed."""
    return {"commit": commit(ROOT), "versions": versions(*packages)}
