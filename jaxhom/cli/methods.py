"""The methods that the command line offers, and the options that belong to each."""

import dataclasses
import sys
from collections.abc import Callable

from jaxhom.generalization.algorithm1 import soft_local_homomorphism
from jaxhom.generalization.neighbors import nearest_neighbors
from jaxhom.generalization.regression import occupancy_regression
from jaxhom.generalization.result import Generalization
from jaxhom.generalization.soft_homomorphism import soft_homomorphism
from jaxhom.generalization.uniform import uniform_elsewhere
from jaxhom.similarity.table import SimilarityTable


def _local(problem, demonstrations, progress, states, *, printed=False, mutual=False, **settings):
    if problem.terminal is not None:  # no action matters there, and their local models can be large
        states = ~problem.terminal if states is None else states & ~problem.terminal
    table = SimilarityTable(problem.mdp, distance=settings.get("distance", 1), anchored=not printed)
    options = {**settings, "anchored": not printed, "mutual": mutual, "table": table, "progress": progress}
    found = soft_local_homomorphism(problem.mdp, demonstrations, states=states, **options)
    return found, {"classes_of_local_models": table.num_classes, "pairs_of_classes_solved": table.num_solved}


def _global(problem, demonstrations, progress, _, *, printed=False, **settings):
    found = soft_homomorphism(problem.mdp, demonstrations, anchored=not printed, progress=progress, **settings)
    return found, {"error_lower": float(found.error_lower), "error_upper": float(found.error_upper)}


def _nearest(problem, demonstrations, *_, **settings):
    return nearest_neighbors(problem.mdp, demonstrations, coordinates=problem.coordinates, **settings), {}


def _uniform(problem, demonstrations, *_):
    return uniform_elsewhere(problem.mdp, demonstrations), {}


def _regression(problem, demonstrations, *_):
    try:
        return occupancy_regression(problem.mdp, demonstrations, problem.coordinates), {}
    except RuntimeError as error:  # no solver found an optimum
        raise ValueError(str(error)) from None


@dataclasses.dataclass(frozen=True)
class Method:
    """A method's name in tables, what runs it, and its options; without a function it generalizes nothing."""

    title: str
    function: Callable | None
    options: tuple[str, ...] = ()


METHODS = {
    "soft-local-homomorphism": Method(
        "soft local homomorphism", _local, ("distance", "threshold", "mutual", "printed", "tolerance")
    ),
    "soft-homomorphism": Method("soft homomorphism, LP (8)", _global, ("printed", "tolerance", "max_iterations")),
    "nearest-neighbors": Method("k-NN", _nearest, ("metric",)),
    "maximum-entropy": Method("maximum entropy", _uniform),
    "regression": Method("regression", _regression),
    "monte-carlo": Method("Monte Carlo expectations", None),
}
"""In the order of the help."""

GENERALIZATIONS = tuple(name for name, method in METHODS.items() if method.function)


def wants_progress(options) -> bool:
    """On a terminal, or where it was asked for."""
    return options.progress or sys.stderr.isatty()


def settings_of(options) -> dict:
    """The method's options that were given.

    Raises:
      ValueError: if one belongs to another method.
    """
    known = sorted({name for method in METHODS.values() for name in method.options})
    values = {name: getattr(options, name) for name in known}
    given = {name: value for name, value in values.items() if value is not None and value is not False}
    for name in given:
        if name not in METHODS[options.method].options:
            owners = " and ".join(key for key, method in METHODS.items() if name in method.options)
            raise ValueError(f"--{name.replace('_', '-')} belongs to {owners}; the method is {options.method}")
    return given


def check_method(problem, options) -> None:
    """Raises `ValueError` on options that do not fit the method or the model, before anything is computed."""
    settings = settings_of(options)
    if not settings.get("threshold", 0.0) >= 0.0:
        raise ValueError(f"--threshold must not be negative, got {settings['threshold']}")
    if not settings.get("tolerance", 1.0) > 0.0:
        raise ValueError(f"--tolerance must be positive, got {settings['tolerance']}")
    if options.method == "regression" or settings.get("metric") == "euclidean":
        what = "--metric euclidean" if "metric" in settings else "--method regression"
        if problem.coordinates is None:
            raise ValueError(f"{what} needs coordinates of the states, and {problem.name} has none")


def generalize(problem, demonstrations, options, states=None) -> tuple[Generalization, dict]:
    """Runs the chosen method.

    Args:
      problem: the model and what is known of it.
      demonstrations: the expert's trajectories.
      options: of the command line, checked by `check_method`.
      states: bool [S], those that a policy is wanted for, where the method can leave out others; all if None.

    Returns:
      The generalization, and what else is known of its making: numbers by name.
    """
    run = METHODS[options.method].function
    return run(problem, demonstrations, wants_progress(options), states, **settings_of(options))
