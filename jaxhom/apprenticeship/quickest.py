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

from jaxhom.apprenticeship.columns import solve_by_columns
from jaxhom.apprenticeship.interior_point import Program, is_banded, solve_by_interior_point
from jaxhom.apprenticeship.prepared import PreparedModel
from jaxhom.apprenticeship.request import Request
from jaxhom.apprenticeship.solution import Found
from jaxhom.apprenticeship.stages import in_turn
from jaxhom.models.mdp import MDP

_MANY_FEATURES = 16  # fewer mix few policies: with 2 (racetrack_a) columns take 0.11 s, the interior point 6.2 s
_SMALL = 2e6
_SMALL_STATES = 1024


def solve_by_the_quickest(request: Request) -> Found:
    """What there is to begin with is for columns; columns and steps both count for a limit."""
    model = request.model
    mdp = model.mdp
    if mdp.dtype != jnp.float64 or mdp.num_features < _MANY_FEATURES or not is_banded(model):
        return solve_by_columns(request)
    is_guided = request.policy is not None or request.weights is not None
    if is_guided or not _is_small(model):
        patient = functools.partial(solve_by_columns, gives_up=True)
        return in_turn(request, patient, solve_by_interior_point, solve_by_columns)
    return in_turn(request, solve_by_interior_point, solve_by_columns)


def _is_small(model: PreparedModel) -> bool:
    """Whether a step of the interior point takes a few milliseconds; features that overlap are left to columns."""
    if model.mdp.num_states > _SMALL_STATES or model.once(_most_features_of_a_pair) > 1:
        return False
    return model.once(Program).work <= _SMALL


def _most_features_of_a_pair(mdp: MDP) -> int:
    return np.count_nonzero(np.asarray(mdp.features), axis=-1).max()
