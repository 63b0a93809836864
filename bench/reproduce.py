"""Computes rows: `python -m bench.reproduce table1 | figure1 | questions`.

Rows go to `<output>/raw/*.csv` as they are computed, summaries to `<output>/*.csv` at the end. A sweep that was stopped
goes on where it was when it is started again; `--draws` may grow in between.
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
    """A sweep by name: what it computes and how its rows are summed up."""

    name: str
    settings: Callable[[], list[settings.Setting]]
    methods: dict[str, methods.Method]
    draws: int
    summarise: Callable[[Sequence[Row]], list[dict]]
    columns: Sequence[str]
    sampled: bool = False


def _question(name: str, make: Callable[[], list[settings.Setting]], chosen: dict) -> Experiment:
    return Experiment(name, make, chosen, 20, summaries.summarise_question, summaries.QUESTION_COLUMNS)


EXPERIMENTS = {
    "table1": [
        Experiment(
            *("table1", settings.table1, methods.TABLE1, 100),
            *(summaries.summarise_table1, summaries.TABLE1_COLUMNS),
            sampled=True,
        )
    ],
    "figure1": [
        Experiment(
            *("figure1", settings.figure1, methods.FIGURE1, 50),
            *(summaries.summarise_figure1, summaries.FIGURE1_COLUMNS),
        )
    ],
    "questions": [
        _question("threshold", settings.threshold_question, methods.THRESHOLD),
        _question("noise", settings.noise_question, methods.NOISE),
        _question("enough", settings.enough_question, methods.ENOUGH),
    ],
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command and returns its exit code: 0 done, 1 some rows failed, 2 wrong input, 130 stopped."""
    options = parser().parse_args(arguments)
    jax.config.update("jax_enable_x64", True)
    failed = 0
    try:
        for experiment in EXPERIMENTS[options.sweep]:
            failed += _run(experiment, options)
    except ValueError as error:
        print(f"bench: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("bench: stopped; the same command goes on from here", file=sys.stderr)
        return 130
    return 1 if failed else 0


def _run(experiment: Experiment, options: argparse.Namespace) -> int:
    """Runs one experiment, writes its summary, and returns how many of its rows have failed."""
    chosen = [s for s in experiment.settings() if _is_wanted(s.name, options.rows)]
    wanted = {name: m for name, m in experiment.methods.items() if not options.methods or name in options.methods}
    file = RowFile(options.output / "raw" / f"{experiment.name}.csv")
    if chosen and wanted:
        work = sweep.Sweep(chosen, wanted, options.draws or experiment.draws, experiment.sampled, options.seed)
        sweep.run(work, file, retry=options.retry)
    rows = [row for row in file.read() if row.seed == options.seed]
    summary = options.output / f"{experiment.name}.csv"
    summaries.write_csv(summary, experiment.columns, experiment.summarise(rows))
    failed = sum(bool(row.error) for row in rows)
    print(f"{summary}: {len(rows)} rows, {failed} failed")
    return failed


def _is_wanted(name: str, patterns: Sequence[str]) -> bool:
    """Whether a setting's name begins like one of the patterns, part by part: grid16, grid16/64, track_a/2."""
    parts = name.split("/")
    return not patterns or any(parts[: len(p.split("/"))] == p.split("/") for p in patterns)


def parser() -> argparse.ArgumentParser:
    """The command line's options."""
    made = argparse.ArgumentParser(prog="python -m bench.reproduce", description=__doc__.splitlines()[0])
    made.add_argument("sweep", choices=EXPERIMENTS)
    made.add_argument("--draws", "--sets", type=int, help="draws per row (default 100 for table1, 50, 20)")
    made.add_argument("--rows", nargs="+", default=[], help="only these settings: grid16, grid16/64, track_a/2")
    made.add_argument("--methods", nargs="+", default=[], help="only these methods")
    made.add_argument("--seed", type=int, default=0, help="of all random numbers (default 0)")
    made.add_argument("--retry", action="store_true", help="compute rows that failed once more")
    output = ROOT / "bench" / "results"
    made.add_argument("--output", type=pathlib.Path, default=output, help="folder (default bench/results)")
    return made


if __name__ == "__main__":
    sys.exit(main())
