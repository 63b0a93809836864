"""Pictures of a problem, on its map if it has one, and by the number of the state otherwise. Needs matplotlib.

matplotlib is imported by the functions alone: every other command works without it.
"""

from __future__ import annotations

import argparse
import importlib
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxhom.cli.questions import mark
from jaxhom.cli.results import Results
from jaxhom.cli.sources import Problem
from jaxhom.domains.racetrack import Racetrack
from jaxhom.models.demonstrations import Demonstrations
from jaxhom.planning.occupancy import occupancy

if TYPE_CHECKING:
    from jaxtyping import ArrayLike, Bool, Float, Int
    from matplotlib.figure import Figure

KINDS = ("policy", "occupancy", "trajectories", "generalization")


def load_plotting() -> ModuleType:
    """`jaxhom.plotting`, for files rather than for a screen.

    Raises:
      ImportError: if matplotlib is missing, saying how to install it.
    """
    plotting = importlib.import_module("jaxhom.plotting")
    importlib.import_module("matplotlib").use("Agg")
    return plotting


def are_wanted(output: Results, options: argparse.Namespace) -> bool:
    """Whether pictures have a folder to go to and can be drawn; says so if it is matplotlib that is missing."""
    if not output.is_folder or options.no_pictures:
        return False
    try:
        load_plotting()
    except ImportError as error:
        print(f"\nNo pictures: {error}")
        return False
    return True


def draw_policy(
    problem: Problem,
    policy: Float[ArrayLike, "S A"],
    visited: Bool[ArrayLike, " S"] | None = None,
    speed: tuple[int, int] = (0, 0),
) -> Figure:
    """A figure of a policy [S, A]; on racetracks that of cars of one speed."""
    plotting = load_plotting()
    if problem.domain is None:
        names = {"state_names": problem.mdp.state_names, "action_names": problem.mdp.action_names}
        return plotting.plot_policy_by_state(policy, visited=visited, **names).figure
    ax = plotting.plot_policy(problem.domain, policy, speed=speed)
    if isinstance(problem.domain, Racetrack):
        ax.set_title(f"cars of speed ({speed[0]}, {speed[1]})", loc="left", fontsize="medium")
    return ax.figure


def draw_occupancy(problem: Problem, policy: Any) -> Figure:
    """A figure of where a policy goes."""
    plotting = load_plotting()
    visits = occupancy(problem.mdp, policy)
    if problem.domain is None:
        return plotting.plot_occupancy_by_state(visits, state_names=problem.mdp.state_names).figure
    return plotting.plot_occupancy(problem.domain, visits).figure


def draw_trajectories(problem: Problem, demonstrations: Demonstrations) -> Figure:
    """A figure of demonstrations."""
    plotting = load_plotting()
    if problem.domain is None:
        return plotting.plot_trajectories_by_state(demonstrations, state_names=problem.mdp.state_names).figure
    return plotting.plot_trajectories(problem.domain, demonstrations).figure


def draw_questions(problem: Problem, demonstrations: Demonstrations, states: Int[np.ndarray, " N"]) -> Figure:
    """A figure of where the expert is asked next, on the map, which the problem has to have."""
    plotting = load_plotting()
    figure = draw_trajectories(problem, demonstrations)
    for number, state in reversed([*enumerate(states)]):
        row, column = np.asarray(problem.coordinates)[state]
        box = {"boxstyle": "round", "facecolor": plotting.YELLOW, "edgecolor": "none"}
        style: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": "small", "zorder": 5, "bbox": box}
        figure.axes[0].text(column, row, mark(number), **style)
    return figure


def draw_generalization(problem: Problem, general: Any, speed: tuple[int, int] | None = None) -> Figure:
    """A figure of how far advice came and from how many states; on racetracks for one speed, or all if None."""
    plotting = load_plotting()
    if problem.domain is None:
        matters = slice(None) if problem.terminal is None else ~problem.terminal
        return plotting.plot_radius_counts(np.asarray(general.radius)[matters]).figure
    if isinstance(problem.domain, Racetrack):
        return plotting.plot_generalization(problem.domain, general, speed=speed)[0].figure
    return plotting.plot_generalization(problem.domain, general)[0].figure
