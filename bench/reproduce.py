"""Computes rows: `python -m bench.reproduce table1 | figure1 | questions`.

Rows go to `<output>/raw/*.csv` as they are computed, summaries to `<output>/*.csv` at the end. A sweep that was stopped
goes on where it was when it is started again; `--draws` may grow in between. `python -m bench.report` turns rows into
tables, figures and words.
"""

import argparse
import dataclasses
import pathlib
import sys
from collections.abc import Callable, Sequence

import jax

from bench import methods, settings, summaries, sweep
from bench.rows import ROOT, Row, RowFile


@dataclasses.dataclass(frozen=True)
class Experiment:
    """A sweep by name: what it computes and how its rows are summed up.

    Attributes:
      name: of its files. settings: makes them. methods: by name. draws: of each setting, unless the user says.
      summarise: lines of `columns` from rows. sampled: whether policies are also tried out in 1000 trials.
    """

    name: str
    settings: Callable[[], list[settings.Setting]]
    methods: dict[str, methods.Method]
    draws: int = 20
    summarise: Callable[[Sequence[Row]], list[dict]] = summaries.summarise_question
    columns: Sequence[str] = summaries.QUESTION_COLUMNS
    sampled: bool = False


EXPERIMENTS = {
    "table1": [
        Experiment(
            name="table1",
            settings=settings.table1,
            methods=methods.TABLE1,
            draws=100,
            summarise=summaries.summarise_table1,
            columns=summaries.TABLE1_COLUMNS,
            sampled=True,
        )
    ],
    "figure1": [
        Experiment(
            name="figure1",
            settings=settings.figure1,
            methods=methods.FIGURE1,
            draws=50,
            summarise=summaries.summarise_figure1,
            columns=summaries.FIGURE1_COLUMNS,
        )
    ],
    "questions": [
        Experiment("threshold", settings.threshold_question, methods.THRESHOLD),
        Experiment("noise", settings.noise_question, methods.NOISE),
        Experiment("enough", settings.enough_question, methods.ENOUGH),
        Experiment("normalisation", settings.normalisation_question, methods.NORMALISATION),
    ],
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command and returns its exit code: 0 done, 1 some rows failed, 2 wrong input, 130 stopped."""
    options = parser().parse_args(arguments)
    jax.config.update("jax_enable_x64", True)
    try:
        chosen = [(e, work, RowFile(options.output / "raw" / f"{e.name}.csv")) for e, work in _chosen(options)]
    except ValueError as error:
        print(f"bench: error: {error}", file=sys.stderr)
        return 2
    try:
        failed = sum(_run(experiment, work, file, options) for experiment, work, file in chosen)
    except KeyboardInterrupt:
        print("bench: stopped; the same command goes on from here", file=sys.stderr)
        return 130
    return 1 if failed else 0


def _chosen(options: argparse.Namespace) -> list[tuple[Experiment, sweep.Sweep]]:
    """The experiments, with the settings and methods that the user asks for; those without any are left out.

    Raises:
      ValueError: if an option is out of range or names nothing that there is.
    """
    if options.draws is not None and options.draws < 1:
        raise ValueError(f"--draws must be at least 1, got {options.draws}")
    experiments = EXPERIMENTS[options.sweep]
    everything = [setting.name for experiment in experiments for setting in experiment.settings()]
    for pattern in options.rows:
        if not any(_begins_like(name, pattern) for name in everything):
            raise ValueError(f"--rows {pattern}: no setting of {options.sweep} begins like that")
    for name in options.methods:
        if not any(name in experiment.methods for experiment in experiments):
            raise ValueError(f"--methods {name}: not one of {sorted({m for e in experiments for m in e.methods})}")
    found = []
    for experiment in experiments:
        rows = [
            s for s in experiment.settings() if not options.rows or any(_begins_like(s.name, p) for p in options.rows)
        ]
        names = {name: m for name, m in experiment.methods.items() if not options.methods or name in options.methods}
        if rows and names:
            draws = options.draws or experiment.draws
            found.append((experiment, sweep.Sweep(rows, names, draws, experiment.sampled, options.seed)))
    return found


def _begins_like(name: str, pattern: str) -> bool:
    """Whether a setting's name begins like the pattern, part by part: grid16, grid16/64, track_a/2."""
    parts = pattern.split("/")
    return name.split("/")[: len(parts)] == parts


def _run(experiment: Experiment, work: sweep.Sweep, file: RowFile, options: argparse.Namespace) -> int:
    """Runs one experiment, writes its summary, and returns how many of its rows have failed."""
    sweep.run(work, file, retry=options.retry)
    rows = [row for row in file.read() if row.seed == options.seed]
    summary = options.output / f"{experiment.name}.csv"
    summaries.write_csv(summary, experiment.columns, experiment.summarise(rows))
    failed = sum(bool(row.error) for row in rows)
    print(f"{summary}: {len(rows)} rows, {failed} failed")
    return failed


def parser() -> argparse.ArgumentParser:
    """The command line's options."""
    made = argparse.ArgumentParser(prog="python -m bench.reproduce", description=__doc__.splitlines()[0])
    made.add_argument("sweep", choices=EXPERIMENTS)
    made.add_argument("--draws", "--sets", type=int, help="draws per row (default: table1 100, figure1 50, else 20)")
    made.add_argument("--rows", nargs="+", default=[], help="only these settings: grid16, grid16/64, track_a/2")
    made.add_argument("--methods", nargs="+", default=[], help="only these methods")
    made.add_argument("--seed", type=int, default=0, help="of all random numbers (default 0)")
    made.add_argument("--retry", action="store_true", help="compute rows that failed once more")
    output = ROOT / "bench" / "results"
    made.add_argument("--output", type=pathlib.Path, default=output, help="folder (default bench/results)")
    return made


if __name__ == "__main__":
    sys.exit(main())
