"""Draws the critical states: `python -m bench.critical_states`, a map per domain.

For one draw of each setting, the contributions of states to the bound on what Algorithm 1 can lose against the expert
under the true reward (`jaxhom.loss_bound` with it as the only feature), in percent of the bound; on tracks the sum over
the speeds of a cell. Dots are demonstrated cells.
"""

import argparse
import pathlib
import sys
from collections.abc import Sequence

import jax
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

import jaxhom
from bench.figures import domain_name, panels_of
from bench.methods import soft
from bench.problems import Problem, draw_problem
from bench.provenance import RESULTS
from bench.settings import Setting, grid, tiled, track
from jaxhom.plotting import BLACK, VERMILLION

_SETTINGS = (
    grid(16, 64, 2, 20),
    tiled("tiles8", 2, 20),
    tiled("tiles16", 5, 20),
    track("track_a", 5, 30),
    track("track_b", 10, 30),
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns 0."""
    parser = argparse.ArgumentParser(prog="python -m bench.critical_states", description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=pathlib.Path, default=RESULTS, help="folder (default bench/results)")
    parser.add_argument("--draw", type=int, default=0, help="which draw (default 0)")
    options = parser.parse_args(arguments)
    jax.config.update("jax_enable_x64", True)
    matplotlib.use("agg")
    matplotlib.rcParams["svg.hashsalt"] = "bench"
    figure, panels = panels_of(2, 3, (11.0, 8.4))
    for ax in panels.flat[len(_SETTINGS) :]:
        ax.set_visible(False)
    for setting, ax in zip(_SETTINGS, panels.flat, strict=False):
        _draw(setting, draw_problem(setting, (options.draw,), 0), ax)
    for suffix in ("png", "svg"):
        metadata = {"Date": None} if suffix == "svg" else None
        figure.savefig(options.output / f"critical_states.{suffix}", dpi=150, metadata=metadata)
    plt.close(figure)
    print(options.output / "critical_states.png")
    return 0


def _draw(setting: Setting, problem: Problem, ax: Axes) -> None:
    """One panel: percent of the bound by cell."""
    shown = problem.demonstrations[0]
    mdp = problem.domain.bare.replace(features=problem.reward[0][..., None])
    loss = jaxhom.loss_bound(mdp, shown, soft(problem).policy[0])
    cells = np.asarray(problem.domain.coordinates).astype(int)
    shape = tuple(cells.max(axis=0) + 1)
    total, known = np.full(shape, np.nan), np.zeros(shape, bool)
    total[tuple(cells.T)] = 0.0
    np.add.at(total, tuple(cells.T), 100.0 * np.asarray(loss.contributions) / float(loss.bound))
    known[tuple(cells[np.asarray(loss.agreed)].T)] = True
    image = ax.imshow(np.ma.masked_invalid(total), cmap="Purples", vmin=0.0)
    ax.set_facecolor(BLACK)
    rows, columns = np.nonzero(known)
    ax.scatter(columns, rows, s=5, color=VERMILLION, linewidths=0)
    per_step = float(loss.bound) * (1.0 - float(mdp.discount))
    share = per_step / float(problem.expert.value[0] @ mdp.initial * (1.0 - mdp.discount))
    count = f"{setting.demonstrations} demonstrations"
    title = f"{domain_name(setting.domain)}, {count}\nat most {share:.0%} of the expert is lost"
    ax.set_title(title, loc="left", fontsize="small")
    ax.set(xticks=[], yticks=[])
    ax.figure.colorbar(image, ax=ax, label="% of the bound", fraction=0.05, location="bottom")


if __name__ == "__main__":
    sys.exit(main())
