"""What a row of `jaxhom.sweeps` costs, and what more workers bring: `python -m bench.sweep_costs`.

Each executor, with 1, 2 and 4 workers on this machine, gets cases with nothing to do, which shows what handing out,
coming back and writing to the disk cost; and Algorithm 1 on the paper's 16 x 16 grid with 64 regions. Workers have
started, and have compiled what they need, before the clock starts. Rows go to `results/sweep_costs.csv`: milliseconds
per row by the clock, those that this process computed (with it Dask's scheduler), and those that `work` took.
"""

import argparse
import contextlib
import functools
import multiprocessing
import os
import pathlib
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from typing import Any

import jax
import numpy as np
import pandas as pd

import jaxhom
from bench.provenance import add_output, provenance, require_clean
from jaxhom import sweeps

EXECUTORS = ("this process", "threads", "processes", "Dask")
WORKERS = (1, 2, 4)
_DEMONSTRATIONS, _LENGTH = 10, 50


def nothing(case: dict) -> dict:
    """As quick as work can be."""
    return {"twice": 2 * case["draw"]}


@functools.cache
def _model() -> tuple:
    """The grid, and a table of what its local models have in common; one of each in every process."""
    mdp = jaxhom.gridworld(16, num_regions=64).mdp
    return mdp, jaxhom.SimilarityTable(mdp)


def algorithm1(case: dict) -> dict:
    """A reward, an expert, demonstrations, what Algorithm 1 makes of them, and what that is worth."""
    mdp, table = _model()
    weight_key, sample_key = jax.random.split(jax.random.key(case["draw"]))
    reward = mdp.features @ jaxhom.sample_weights(weight_key, 64)
    expert = jaxhom.optimal_policy(mdp, reward)
    shown = jaxhom.sample_demonstrations(sample_key, mdp, expert.policy, _DEMONSTRATIONS, _LENGTH)
    learned = jaxhom.soft_local_homomorphism(mdp, shown, table=table)
    value = jaxhom.policy_value(mdp, learned.policy, reward) @ mdp.initial
    return {"share": value / (expert.value @ mdp.initial)}


WORK: dict[str, tuple[Callable, int]] = {"nothing": (nothing, 1000), "Algorithm 1": (algorithm1, 40)}
"""What is done, and on how many cases."""


def measure(executor: Any, workers: int, work: Callable, count: int) -> dict:
    """Rows per second of the second sweep, after one that all workers take part in."""
    with tempfile.TemporaryDirectory() as folder:
        file = pathlib.Path(folder, "rows.jsonl")
        first = [{"draw": -1 - draw} for draw in range(4 * workers)]
        sweeps.run(work, first, file, executor=executor, progress=False)
        start, start_here = time.perf_counter(), time.process_time()
        rows = sweeps.run(work, [{"draw": draw} for draw in range(count)], file, executor=executor, progress=False)
        seconds, seconds_here = time.perf_counter() - start, time.process_time() - start_here
    assert not any(row["error"] for row in rows)
    at_work = float(np.mean([row["seconds"] for row in rows]))
    per_row = {"ms_per_row": seconds / count, "cpu_ms_here": seconds_here / count, "ms_at_work": at_work}
    return {"rows": count, "seconds": seconds} | {name: 1e3 * number for name, number in per_row.items()}


@contextlib.contextmanager
def started(name: str, workers: int) -> Iterator[Any]:
    """An executor; of Dask, a cluster of processes with a thread each."""
    if name == "this process":
        yield None
    elif name == "threads":
        with ThreadPoolExecutor(workers) as pool:
            yield pool
    elif name == "processes":
        with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
            yield pool
    else:
        from distributed import Client, LocalCluster

        options = {"n_workers": workers, "threads_per_worker": 1, "dashboard_address": None}
        with LocalCluster(processes=True, **options) as cluster, Client(cluster) as client:
            yield client


def _machine() -> dict:
    """Where and under what load a line was measured."""
    return {"cores": os.cpu_count(), "load": os.getloadavg()[0], **provenance("distributed", "jax", "numpy")}


def main(arguments: Sequence[str] | None = None) -> int:
    """Measures, prints a table and writes the rows."""
    made = argparse.ArgumentParser(prog="python -m bench.sweep_costs", description=__doc__.splitlines()[0])
    made.add_argument("--executors", nargs="+", choices=EXECUTORS, default=EXECUTORS, help="only these")
    made.add_argument("--workers", type=int, nargs="+", default=list(WORKERS), help="how many (default: 1 2 4)")
    made.add_argument("--share", type=float, default=1.0, help="of the cases, for a quick look")
    add_output(made)
    options = made.parse_args(arguments)
    require_clean(made, options)
    jax.config.update("jax_enable_x64", True)
    options.output.mkdir(parents=True, exist_ok=True)
    lines = []
    for name in options.executors:
        for workers in [1] if name == "this process" else options.workers:
            with started(name, workers) as executor:
                for kind, (work, count) in WORK.items():
                    found = measure(executor, workers, work, max(1, round(options.share * count)))
                    lines.append({"executor": name, "workers": workers, "work": kind, **found, **_machine()})
                    times = f"{found['ms_per_row']:9.2f} ms per row, {found['cpu_ms_here']:.2f} here"
                    print(f"{name:13}{workers:2}  {kind:12}{times}", flush=True)
            pd.DataFrame(lines).round(4).to_csv(options.output / "sweep_costs.csv", index=False)
    return 0


if __name__ == "__main__":
    sys.exit(main())
