"""LPAL by columns and the interior point, each where it is the quicker of the two.

Where all expectations can be exceeded at once, the best policy mixes about as many deterministic ones as there are
features, and each column adds one. If the model's graph is a narrow band, the interior point then takes a tenth as many
steps, each a few times as long as a column. So columns begin, and lanes that do not get on are shared between the two;
on small models the interior point begins. For all other expectations, and on all other models, columns are quicker.
"""

from __future__ import annotations

import functools

import jax.numpy as jnp
import numpy as np

from jaxhom.apprenticeship import interior_point
from jaxhom.apprenticeship.column_helper import Help
from jaxhom.apprenticeship.columns import DEFAULT_COLUMNS, solve_by_columns
from jaxhom.apprenticeship.prepared import PreparedModel
from jaxhom.apprenticeship.request import Request
from jaxhom.apprenticeship.solution import Found
from jaxhom.models.mdp import MDP
from jaxhom.status import Status

# Seconds are those of bench/results/speed_lpal.csv, of one lane where nothing else is said.
_MANY_FEATURES = 16  # fewer mix few policies: with 2 (racetrack_a) columns take 0.11 s, the interior point 6.2 s
# Multiplications of a step. Up to the first the interior point begins: grid16 takes 7 steps and 0.024 s, grid24 begins
# with columns and takes 0.077 s, of which the interior point alone takes 0.044 s. Up to the second it has every slow
# lane (grid48), up to the third every other one (grid100, where the interior point alone takes as long as both
# together, 4.1 s). Beyond (grid316) it has none.
_SMALL, _MEDIUM, _LARGE = 2e6, 3e7, 3e9
_SMALL_STATES = 1024  # more make no small step


def solve_by_the_quickest(request: Request) -> Found:
    """What there is to begin with is for columns; columns and steps both count for a limit."""
    mdp = request.model.mdp
    if mdp.is_dense or mdp.dtype != jnp.float64 or mdp.num_features < _MANY_FEATURES:
        return solve_by_columns(request)
    is_guided = request.policy is not None or request.weights is not None
    if is_guided or not _is_small(request.model):
        return solve_by_columns(request, functools.partial(_help, request.model))
    limit = request.limit or DEFAULT_COLUMNS
    at_first = request.replace(limit=min(limit, interior_point.DEFAULT_STEPS))
    found = interior_point.solve_by_interior_point(at_first)
    solution = request.certified(found)
    left = np.flatnonzero((solution.status != Status.SOLVED) & (solution.iterations < limit))
    if not left.size:
        return found
    start = {"policy": solution.policy[left], "weights": solution.weights[left], "spent": solution.iterations[left]}
    return found.with_lanes(left, solve_by_columns(request.part(left, **start)))


def _is_small(model: PreparedModel) -> bool:
    """Whether a step of the interior point takes a few milliseconds; features that overlap are left to columns."""
    if model.mdp.num_states > _SMALL_STATES or model.once(_most_features_of_a_pair) > 1:
        return False
    return model.once(interior_point.Program).work <= _SMALL


def _most_features_of_a_pair(mdp: MDP) -> int:
    return np.count_nonzero(np.asarray(mdp.features), axis=-1).max()


def _help(model: PreparedModel) -> Help | None:
    """The interior point for slow lanes, or for every second where columns take as long; None if it is no match."""
    program = model.once(interior_point.Program)
    if program.work > _LARGE:
        return None
    return Help(program.solve, share=1 if program.work <= _MEDIUM else 2)
