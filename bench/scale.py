"""How time and memory grow with the number of states: `python -m bench.scale`, then `--figure`.

Each model is worked on in a process of its own, where nothing is compiled yet: it is built, planned for, demonstrated
ten times, generalized by Algorithm 1 and k-NN, and its expectations and the bound on the loss are computed. A row per
model goes to `<output>/scale.jsonl` as soon as it is there; the same command goes on where it stopped.
"""

from __future__ import annotations

import argparse
import multiprocessing
import pathlib
import resource
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import matplotlib
import matplotlib.pyplot as plt
import numpy as np

from bench.provenance import add_output, require_clean
from jaxhom import sweeps

GRIDS = (16, 32, 64, 128, 256, 512, 1000)
ROADS = (9, 18, 36, 72, 144, 288, 568)  # about as many links as cells of the grids
STEPS = ("build", "planning", "Algorithm 1", "k-NN", "expectations", "loss bound")
_FEATURES, _DEMONSTRATIONS = 4, 10
_COLORS = ("#999999", "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00")


def work(case: dict) -> dict:
    """Seconds of every step on one model, the first time in a process, and the most memory that it held."""
    import jax

    import jaxhom
    from bench.road_graph import road_graph

    jax.config.update("jax_enable_x64", True)
    found: dict[str, Any] = {}

    def timed(step: str, function: Callable) -> Any:
        start = time.perf_counter()
        result = jax.block_until_ready(function())
        found[f"seconds_{step}"] = time.perf_counter() - start
        return result

    size = case["size"]
    if case["kind"] == "grid":
        mdp = timed("build", lambda: jaxhom.gridworld(size, num_regions=_FEATURES)).mdp
        weights = np.array([0.1, 0.3, 0.2, 1.0])
    else:
        mdp = timed("build", lambda: road_graph(size, num_destinations=_FEATURES - 1)).mdp
        weights = np.array([-1.0, 0.0, 0.0, 100.0])
    reward = np.asarray(mdp.features) @ weights
    plan = timed("planning", lambda: jaxhom.optimal_policy(mdp, reward, progress=True))
    walks = jaxhom.sample_demonstrations(jax.random.key(0), mdp, plan.policy, _DEMONSTRATIONS, 2 * size)
    general = timed("Algorithm 1", lambda: jaxhom.soft_local_homomorphism(mdp, walks, progress=True))
    timed("k-NN", lambda: jaxhom.nearest_neighbors(mdp, walks, progress=True))
    expectations = timed("expectations", lambda: jaxhom.feature_expectations(mdp, general.policy, progress=True))
    bound = timed("loss bound", lambda: jaxhom.loss_bound(mdp, walks, general, progress=True))
    return found | {
        "states": mdp.num_states,
        "demonstrated": int(np.asarray(general.visited).sum()),
        "statuses": f"{int(plan.status)} {int(general.status)} {int(bound.status)}",
        "is_finite": bool(np.isfinite(np.asarray(expectations)).all()),
        "peak_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
    }


def slope(states: Sequence[float], seconds: Sequence[float]) -> float:
    """The exponent of growth over the three largest models."""
    return float(np.polyfit(np.log(states[-3:]), np.log(seconds[-3:]), 1)[0])


def tables(rows: list[dict]) -> str:
    """Seconds per step in Markdown, one table per kind, with the exponents of their growth."""
    lines = []
    for kind in ("grid", "roads"):
        some = sorted((row for row in rows if row["kind"] == kind and not row["error"]), key=lambda row: row["states"])
        if not some:
            continue
        lines += ["", f"| {kind}: states | {' | '.join(STEPS)} | peak GiB |", "|" + "---|" * (len(STEPS) + 2)]
        for row in some:
            cells = [f"{row[f'seconds_{step}']:.2f}" for step in STEPS]
            lines.append(f"| {row['states']:,} | {' | '.join(cells)} | {row['peak_gib']:.1f} |")
        states = [row["states"] for row in some]
        slopes = [f"{slope(states, [row[f'seconds_{step}'] for row in some]):.2f}" for step in STEPS]
        lines.append(f"| exponent | {' | '.join(slopes)} | |")
    return "\n".join(lines[1:])


def figure(rows: list[dict], path: pathlib.Path) -> None:
    """Draws seconds against states, both logarithmic, a panel per kind."""
    matplotlib.use("Agg")
    drawn, panels = plt.subplots(1, 2, figsize=(9.0, 4.0), layout="constrained", sharey=True)
    for panel, kind in zip(panels, ("grid", "roads"), strict=True):
        some = sorted((row for row in rows if row["kind"] == kind and not row["error"]), key=lambda row: row["states"])
        states = [row["states"] for row in some]
        for step, color in zip(STEPS, _COLORS, strict=True):
            seconds = [row[f"seconds_{step}"] for row in some]
            label = f"{step} ({slope(states, seconds):.2f})" if len(some) > 2 else step
            panel.loglog(states, seconds, "o-", color=color, markersize=3, label=label)
        panel.set(title={"grid": "gridworlds", "roads": "road networks"}[kind], xlabel="states")
        panel.legend(frameon=False, fontsize="small", title="exponent of growth at the end", title_fontsize="small")
        panel.grid(color="#E3E3E3", linewidth=0.8)
        panel.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("seconds, first call in a process")
    panels[0].set_ylim(top=1e5)  # room for the legends
    drawn.savefig(path, dpi=110)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; 0, or 1 if a model failed."""
    options = (command := parser()).parse_args(arguments)
    file = options.output / "scale.jsonl"
    if options.figure:
        rows = sweeps.read(file)
        figure(rows, options.figure)
        print(tables(rows))
        return 0
    require_clean(command, options)
    kinds = (("grid", GRIDS), ("roads", ROADS))
    cases = [{"kind": kind, "size": size} for kind, sizes in kinds for size in sizes if size <= options.largest]
    # A process per model: what the one before compiled and allocated is gone.
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), max_tasks_per_child=1) as pool:
        rows = sweeps.run(work, cases, file, executor=pool, in_flight=1)
    print(tables(rows))
    return int(any(row["error"] for row in rows))


def parser() -> argparse.ArgumentParser:
    """The command line's options."""
    made = argparse.ArgumentParser(prog="python -m bench.scale", description=__doc__.splitlines()[0])
    made.add_argument("--largest", type=int, default=1000, help="largest side of a grid (default 1000)")
    made.add_argument("--figure", type=pathlib.Path, help="only draw the rows, to this file, and print the table")
    add_output(made)
    return made


if __name__ == "__main__":
    sys.exit(main())
