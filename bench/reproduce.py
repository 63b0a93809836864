"""Computes rows: `python -m bench.reproduce SWEEP`, of which `--help` lists the names.

Rows go to `<output>/raw/*.csv` as they are computed, summaries to `<output>/*.csv` at the end. A sweep that was stopped
goes on where it was when it is started again; `--draws` may grow in between. `--scheduler` has the workers of a Dask
cluster compute, in a checkout like this one. `python -m bench.report` turns rows into tables, figures and words.
"""

import argparse
import contextlib
import dataclasses
import sys
from collections.abc import Iterator, Sequence

import jax

from bench import guarantees, learners, methods, queries, relations, settings, summaries, sweep
from bench.provenance import add_output, require_clean
from bench.rows import RowFile
from bench.sweep import Sweep
from jaxhom import programs

SWEEPS = {
    "table1": {"table1": Sweep(settings.table1(), methods.TABLE1, draws=100, sampled=True)},
    "figure1": {"figure1": Sweep(settings.figure1(), methods.FIGURE1, draws=50)},
    "questions": {
        "threshold": Sweep(settings.threshold_question(), methods.THRESHOLD),
        "noise": Sweep(settings.noise_question(), methods.THRESHOLD),
        "enough": Sweep(settings.enough_question(), methods.ENOUGH),
        "normalisation": Sweep(settings.normalisation_question(), methods.NORMALISATION),
    },
    "relations": {
        "relations": Sweep(settings.relations_question(), relations.WITHOUT_LABELS, draws=50),
        "roads": Sweep(settings.roads_question(), relations.WITH_LABELS, draws=50),
        "transfer": Sweep(settings.transfer_question(), relations.ACROSS, draws=50),
    },
    "learners": {"learners": Sweep(settings.learners_question(), learners.LEARNERS, draws=50)},
    "guarantees": {"guarantees": Sweep(settings.guarantees_question(), guarantees.GUARANTEES, draws=50)},
    "queries": {"queries": Sweep(settings.queries_question(), queries.QUERIES, draws=50)},
}
"""By command, and by the name of the sweep's files."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command and returns its exit code: 0 done, 1 some rows failed, 2 wrong input, 130 stopped."""
    options = (command := parser()).parse_args(arguments)
    require_clean(command, options)
    jax.config.update("jax_enable_x64", True)
    programs.keep_programs()
    try:
        chosen = [(name, work, RowFile(options.output / "raw" / f"{name}.csv")) for name, work in _chosen(options)]
    except ValueError as error:
        print(f"bench: error: {error}", file=sys.stderr)
        return 2
    try:
        with _crew(options) as crew:
            failed = sum(_run(name, work, file, options, crew) for name, work, file in chosen)
    except KeyboardInterrupt:
        print("bench: stopped; the same command goes on from here", file=sys.stderr)
        return 130
    except (ImportError, OSError, RuntimeError, ValueError) as error:
        print(f"bench: error: {error}", file=sys.stderr)
        return 2
    return 1 if failed else 0


@contextlib.contextmanager
def _crew(options: argparse.Namespace) -> Iterator[dict]:
    """Who computes: threads, or the cluster of a scheduler, whose workers keep their compiled programs too.

    Raises:
      OSError: if no scheduler answers.
      ValueError: if it has no workers.
    """
    if options.scheduler is None:
        yield {"workers": options.workers or 2}
        return
    from distributed import Client

    with Client(options.scheduler) as client:
        workers = options.workers or sum(client.nthreads().values())
        if not workers:
            raise ValueError(f"--scheduler {options.scheduler}: it has no workers")
        client.run(programs.keep_programs)
        yield {"executor": client, "workers": workers}


def _chosen(options: argparse.Namespace) -> list[tuple[str, Sweep]]:
    """The sweeps, with the settings and methods that the user asks for; those without any are left out.

    Raises:
      ValueError: if an option is out of range or names nothing that there is.
    """
    sweeps = SWEEPS[options.sweep]
    if options.draws is not None and options.draws < 1:
        raise ValueError(f"--draws must be at least 1, got {options.draws}")
    if options.workers is not None and options.workers < 1:
        raise ValueError(f"--workers must be at least 1, got {options.workers}")
    for pattern in options.rows:
        if not any(_begins_like(setting.name, pattern) for work in sweeps.values() for setting in work.settings):
            raise ValueError(f"--rows {pattern}: no setting of {options.sweep} begins like that")
    names = {name for work in sweeps.values() for name in work.methods}
    for name in options.methods:
        if name not in names:
            raise ValueError(f"--methods {name}: not one of {sorted(names)}")
    found = []
    for name, work in sweeps.items():
        rows = [s for s in work.settings if not options.rows or any(_begins_like(s.name, p) for p in options.rows)]
        wanted = {key: method for key, method in work.methods.items() if not options.methods or key in options.methods}
        changes = {"settings": rows, "methods": wanted, "draws": options.draws or work.draws, "seed": options.seed}
        if rows and wanted:
            found.append((name, dataclasses.replace(work, **changes)))
    return found


def _begins_like(name: str, pattern: str) -> bool:
    """Whether a setting's name begins like the pattern, part by part: grid16, grid16/64, track_a/2."""
    parts = pattern.split("/")
    return name.split("/")[: len(parts)] == parts


def _run(name: str, work: Sweep, file: RowFile, options: argparse.Namespace, crew: dict) -> int:
    """Runs one sweep, writes its summary, and returns how many of its rows have failed."""
    sweep.run(work, file, retry=options.retry, **crew)
    rows = [row for row in file.read() if row.seed == options.seed]
    failed = sum(bool(row.error) for row in rows)
    summaries.write(name, rows, options.output)
    print(f"{options.output / name}.csv: {len(rows)} rows, {failed} failed")
    return failed


def parser() -> argparse.ArgumentParser:
    """The command line's options."""
    made = argparse.ArgumentParser(prog="python -m bench.reproduce", description=__doc__.splitlines()[0])
    made.add_argument("sweep", choices=SWEEPS)
    made.add_argument("--draws", "--sets", type=int, help="draws per row (default: table1 100, questions 20, else 50)")
    made.add_argument("--rows", nargs="+", default=[], help="only these settings: grid16, grid16/64, track_a/2")
    made.add_argument("--methods", nargs="+", default=[], help="only these methods")
    made.add_argument("--seed", type=int, default=0, help="of all random numbers (default 0)")
    made.add_argument("--retry", action="store_true", help="compute rows that failed once more")
    made.add_argument("--scheduler", help="address of a Dask scheduler whose workers compute: tcp://host:8786")
    made.add_argument("--workers", type=int, help="batches at a time (default: 2 threads, or all of a cluster)")
    add_output(made)
    return made


if __name__ == "__main__":
    sys.exit(main())
