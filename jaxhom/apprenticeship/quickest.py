"""LPAL by columns and the interior point, each where it is the quicker of the two.

Where all expectations can be exceeded at once, the best policy mixes about as many deterministic ones as there are
features, and each column adds one. If the model's graph is a narrow band, the interior point then takes a tenth as many
steps, each a few times as long as a column. So columns begin, and lanes that do not get on are shared between the two;
on small models the interior point begins. For all other expectations, and on all other models, columns are quicker.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom.apprenticeship import interior_point
from jaxhom.apprenticeship.certificate import LPALSolution
from jaxhom.apprenticeship.columns import DEFAULT_COLUMNS, solve_by_columns
from jaxhom.models.mdp import MDP
from jaxhom.status import Status

_MANY_FEATURES = 16
_SMALL, _MEDIUM, _LARGE = 2e6, 3e7, 3e9  # multiplications of a step
_SMALL_STATES = 1024  # more make no small step


def solve_by_the_quickest(
    mdp: MDP,
    expectations: np.ndarray,
    initial_policy: np.ndarray | None,
    tolerance: np.ndarray,
    certify: Callable[..., LPALSolution],
    *,
    initial_weights: np.ndarray | None = None,
    max_iterations: int | None = None,
    progress: bool = False,
) -> LPALSolution:
    """`lpal` on a batch: expectations [B, K]. What is given to begin with is for columns; both count for a limit."""
    limit = DEFAULT_COLUMNS if max_iterations is None else max_iterations
    by_columns = functools.partial(solve_by_columns, mdp, max_iterations=limit, progress=progress)
    program = functools.cache(functools.partial(interior_point.Program, mdp))
    if mdp.is_dense or mdp.dtype != jnp.float64 or mdp.num_features < _MANY_FEATURES:
        return by_columns(expectations, initial_policy, tolerance, certify, initial_weights=initial_weights)
    is_guided = initial_policy is not None or initial_weights is not None
    if is_guided or not _is_small(mdp, program):
        helper = functools.cache(functools.partial(_helper, program))
        guesses = {"initial_weights": initial_weights, "helper": helper}
        return by_columns(expectations, initial_policy, tolerance, certify, **guesses)
    steps = min(limit, interior_point.DEFAULT_STEPS)
    options = {"max_iterations": steps, "progress": progress, "program": program()}
    solution = interior_point.solve_by_interior_point(mdp, expectations, None, tolerance, certify, **options)
    left = np.flatnonzero((solution.status != Status.SOLVED) & (solution.iterations < limit))
    if not left.size:
        return solution
    rest = by_columns(
        expectations[left],
        solution.policy[left],
        tolerance[left],
        functools.partial(certify, lanes=left),
        initial_weights=solution.weights[left],
        spent=solution.iterations[left],
    )
    return jax.tree.map(lambda all_lanes, lanes: _with_lanes(all_lanes, left, lanes), solution, rest)


def _with_lanes(array: np.ndarray, lanes: np.ndarray, new: np.ndarray) -> np.ndarray:
    array = array.copy()
    array[lanes] = new
    return array


def _is_small(mdp: MDP, program: Callable) -> bool:
    """Whether a step of the interior point takes a few milliseconds; features that overlap are left to columns."""
    if mdp.num_states > _SMALL_STATES or np.count_nonzero(np.asarray(mdp.features), axis=-1).max() > 1:
        return False
    return program().work <= _SMALL


def _helper(program: Callable):
    """The interior point for lanes at rest, or for every second where columns take as long; None if it is no match."""
    work = program().work
    if work > _LARGE:
        return None
    return program().solve, 1 if work <= _MEDIUM else 2
