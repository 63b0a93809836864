"""The methods that the command line offers: one table of their names, what runs them, and the options of each.

`learn`, `explain` and the main job read it. A method takes a problem, demonstrations, whether to show progress, the
states that a policy is wanted for, and its own options; it returns a generalization and numbers of its making.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxhom.cli.options import Parser, positive
from jaxhom.cli.table_files import kept_table
from jaxhom.generalization.algorithm1 import soft_local_homomorphism
from jaxhom.generalization.choice import choose_generalization
from jaxhom.generalization.neighbors import nearest_neighbors
from jaxhom.generalization.regression import occupancy_regression
from jaxhom.generalization.result import Generalization
from jaxhom.generalization.soft_homomorphism import soft_homomorphism
from jaxhom.generalization.uniform import uniform_elsewhere
from jaxhom.generalization.voting import WEIGHTS
from jaxhom.models.demonstrations import Demonstrations
from jaxhom.models.inputs import check_labels
from jaxhom.similarity.lax_pairs import MAX_ACTIONS
from jaxhom.similarity.relations import RELATIONS

if TYPE_CHECKING:
    from jaxtyping import Bool

    from jaxhom.cli.sources import Problem

Found = tuple[Generalization, dict[str, Any]]


def _local(problem, demonstrations, progress, states, *, printed=False, mutual=False, table=None, **settings) -> Found:
    if problem.terminal is not None:  # no action matters there, and their local models can be large
        states = ~problem.terminal if states is None else states & ~problem.terminal
    if "labels" in settings:
        settings["labels"] = problem.labels(settings["labels"])
    compared = {name: settings[name] for name in ("labels", "label_weight", "relation") if name in settings}
    known = problem.similarity(settings.get("distance", 1), anchored=not printed, file=table, **compared)
    options = {**settings, "anchored": not printed, "mutual": mutual, "table": known, "progress": progress}
    with contextlib.nullcontext() if table is None else kept_table(table, known):
        found = soft_local_homomorphism(problem.mdp, demonstrations, states=states, **options)
    return found, {"classes_of_local_models": known.num_classes, "pairs_of_classes_solved": known.num_solved}


def _choose(problem, demonstrations, progress, _, **settings) -> Found:
    if "labels" in settings:
        settings["labels"] = problem.labels(settings["labels"])
    states = None if problem.terminal is None else ~problem.terminal  # all, whichever are asked about
    choice = choose_generalization(problem.mdp, demonstrations, states=states, progress=progress, **settings)
    names, scores = list(choice.scores), list(choice.scores.values())
    return choice.best, {"chosen": choice.name, "candidates": names, "scores": scores}


def _global(problem, demonstrations, progress, _, *, printed=False, **settings) -> Found:
    if "labels" in settings:
        settings["labels"] = problem.labels(settings["labels"])
    found = soft_homomorphism(problem.mdp, demonstrations, anchored=not printed, progress=progress, **settings)
    return found, {name: float(np.asarray(getattr(found, name))) for name in ("error_lower", "error_upper")}


def _nearest(problem, demonstrations, *_, **settings) -> Found:
    return nearest_neighbors(problem.mdp, demonstrations, coordinates=problem.coordinates, **settings), {}


def _uniform(problem, demonstrations, *_) -> Found:
    return uniform_elsewhere(problem.mdp, demonstrations), {}


def _regression(problem, demonstrations, *_) -> Found:
    try:
        return occupancy_regression(problem.mdp, demonstrations, problem.coordinates), {}
    except RuntimeError as error:  # no solver found an optimum
        raise ValueError(str(error)) from None


def _voters(text: str) -> str | int:
    return text if text in ("nearest", "all") else positive(text)


@dataclasses.dataclass(frozen=True)
class Method:
    """A method's name in tables, what runs it, and its options; without a function it generalizes nothing."""

    title: str
    function: Callable[..., Found] | None
    options: tuple[str, ...] = ()


_COMPARED = ("labels", "label_weight")
_VOTES = ("voters", "weights", "temperature")

METHODS = {
    "soft-local-homomorphism": Method(
        "soft local homomorphism",
        _local,
        ("distance", "threshold", "mutual", "printed", "tolerance", *_COMPARED, "relation", *_VOTES, "table"),
    ),
    "choose": Method("generalization chosen by the data", _choose, ("distance", *_COMPARED)),
    "soft-homomorphism": Method(
        "soft homomorphism, LP (8)", _global, ("printed", "tolerance", "max_iterations", *_COMPARED)
    ),
    "nearest-neighbors": Method("k-NN", _nearest, ("metric",)),
    "maximum-entropy": Method("uniform elsewhere", _uniform),
    "regression": Method("regression", _regression),
    "monte-carlo": Method("Monte Carlo expectations", None),
}
"""In the order of the help."""

GENERALIZATIONS = tuple(name for name, method in METHODS.items() if method.function)

_OPTIONS: dict[str, dict[str, Any]] = {
    "distance": {"type": positive, "metavar": "D", "help": "radius d of the local models (default 1)"},
    "threshold": {"type": float, "metavar": "E", "help": "largest error epsilon of a similarity (default 0)"},
    "mutual": {"action": "store_true", "help": "require similarity in both directions"},
    "printed": {"action": "store_true", "help": "homomorphisms as the paper prints them, without the anchor"},
    "tolerance": {
        "type": float,
        "metavar": "T",
        "help": "of the homomorphism's linear programs (default 1e-4 local, 1e-3 global)",
    },
    "labels": {
        "metavar": "FILE",
        "help": "what similar states have in common besides transitions: features or reward, the model's own, or an "
        ".npy file of [S, A, L] or [S, L]",
    },
    "label_weight": {"type": float, "metavar": "W", "help": "what labels are multiplied by (default 1)"},
    "relation": {"choices": RELATIONS, "help": "what makes states similar (default homomorphism)"},
    "voters": {
        "type": _voters,
        "metavar": "N",
        "help": "who votes: nearest (default), all, or a number of the nearest at least",
    },
    "weights": {"choices": WEIGHTS, "help": "of votes (default equal)"},
    "temperature": {"type": float, "metavar": "T", "help": "of weights by similarity (default 0.05)"},
    "table": {
        "metavar": "FILE",
        "help": "where to keep what is solved about pairs of local models (.npz): read if it is there, written at the "
        "end and at Ctrl-C",
    },
    "max_iterations": {"type": positive, "metavar": "N", "help": "of the global program (default 20000)"},
    "metric": {
        "choices": ("hops", "euclidean"),
        "help": "of the nearest neighbours (default hops: steps in the model)",
    },
}
"""What `argparse` is told of every option in the table of methods, in the order of the help."""


def add_method_options(parser: Parser, names: tuple[str, ...] = tuple(METHODS)) -> None:
    """How the expert's policy is extended."""
    group = parser.add_argument_group("method")
    listed = ", ".join(names[1:])
    group.add_argument(
        "--method", choices=names, default=names[0], metavar="NAME", help=f"{names[0]} (default), {listed}"
    )
    for name, arguments in _OPTIONS.items():
        group.add_argument(_flag(name), **arguments)
    group.add_argument(
        "--progress", action="store_true", help="show progress and time left also where stderr is no terminal"
    )


def wants_progress(options: argparse.Namespace) -> bool:
    """On a terminal, or where it was asked for."""
    return options.progress or sys.stderr.isatty()


def settings_of(options: argparse.Namespace) -> dict[str, Any]:
    """The method's options that were given.

    Raises:
      ValueError: if one belongs to another method.
    """
    values = {name: getattr(options, name) for name in sorted(_OPTIONS)}
    given = {name: value for name, value in values.items() if value is not None and value is not False}
    for name in given:
        if name not in METHODS[options.method].options:
            owners = " and ".join(key for key, method in METHODS.items() if name in method.options)
            raise ValueError(f"{_flag(name)} belongs to {owners}; the method is {options.method}")
    return given


def check_method(problem: Problem, options: argparse.Namespace) -> None:
    """Raises `ValueError` on options that do not fit the method or the model, before anything is computed."""
    settings = settings_of(options)
    if not settings.get("threshold", 0.0) >= 0.0:
        raise ValueError(f"--threshold must not be negative, got {settings['threshold']}")
    if not settings.get("tolerance", 1.0) > 0.0:
        raise ValueError(f"--tolerance must be positive, got {settings['tolerance']}")
    if not 0.0 < settings.get("temperature", 1.0) < np.inf:
        raise ValueError(f"--temperature must be positive and finite, got {settings['temperature']}")
    for name, owner in (("label_weight", "labels"), ("temperature", "weights")):
        if name in settings and owner not in settings:
            raise ValueError(f"{_flag(name)} belongs to {_flag(owner)}")
    if settings.get("label_weight", 0.0) < 0.0:
        raise ValueError(f"--label-weight must not be negative, got {settings['label_weight']}")
    if settings.get("relation") == "lax" and problem.mdp.num_actions > MAX_ACTIONS:
        count = problem.mdp.num_actions
        raise ValueError(f"--relation lax is for up to {MAX_ACTIONS} actions, and {problem.name} has {count}")
    if "labels" in settings:
        check_labels(problem.mdp, problem.labels(settings["labels"]), settings.get("label_weight", 1.0), "--labels")
    if options.method == "regression" or settings.get("metric") == "euclidean":
        what = "--metric euclidean" if "metric" in settings else "--method regression"
        if problem.coordinates is None:
            raise ValueError(f"{what} needs coordinates of the states, and {problem.name} has none")


def generalize(
    problem: Problem,
    demonstrations: Demonstrations,
    options: argparse.Namespace,
    states: Bool[np.ndarray, " S"] | None = None,
) -> Found:
    """Runs the chosen method.

    Args:
      problem: the model and what is known of it.
      demonstrations: the expert's trajectories.
      options: of the command line, checked by `check_method`.
      states: bool [S], those that a policy is wanted for, where the method can leave out others; all if None.

    Returns:
      The generalization, and what else is known of its making: numbers by name.
    """
    return run_method(options.method, problem, demonstrations, wants_progress(options), states, **settings_of(options))


def run_method(
    name: str,
    problem: Problem,
    demonstrations: Demonstrations,
    progress: bool = False,
    states: Bool[np.ndarray, " S"] | None = None,
    **settings: Any,
) -> Found:
    """Runs a method of the table that generalizes; what it takes and returns the module says."""
    function = METHODS[name].function
    if function is None:
        raise ValueError(f"the method {name} generalizes nothing")
    return function(problem, demonstrations, progress, states, **settings)


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"
