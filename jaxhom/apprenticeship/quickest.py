"""LPAL by the method that is the quickest for what is asked, by a rule that looks at the model and the number of lanes.

Where all expectations can be exceeded at once, the best policy mixes about as many deterministic ones as there are
features, and each column adds one. If the model's graph is a narrow band, the interior point then takes a tenth as many
steps, each a few times as long as a column; and in batches PDHG closes half of the lanes for less than either. On a
small model the interior point beats what a policy to begin with saves, unless the expectations are a policy's, and some
dozen lanes of it are done before a program is compiled. For features that overlap, for few features, with a good guess,
and on all other models, columns are the quickest; lanes in which they do not get on go to the interior point.
"""

from __future__ import annotations

import functools

import jax.numpy as jnp
import numpy as np

from jaxhom.apprenticeship.columns import solve_by_columns
from jaxhom.apprenticeship.interior_point import LinearProgram, is_banded, is_soon_solved, solve_by_interior_point
from jaxhom.apprenticeship.pdhg import solve_by_pdhg
from jaxhom.apprenticeship.request import Request
from jaxhom.apprenticeship.solution import Found
from jaxhom.apprenticeship.stages import in_turn
from jaxhom.models.mdp import MDP

# Instances are those of bench.instances, with 32 lanes where nothing else is said.
_MANY_FEATURES = 16  # fewer mix few policies: one lane of racetrack_a, with 2, takes columns a fiftieth of the time
_MANY_LANES = 8  # from which PDHG begins: grid24 takes 30 ms a lane so, 54 without it; fewer do not pay for compiling
_SAME = 1e-9  # relative difference of sums that are the same
_SMALL_STATES = 1024  # up to which the interior point may begin: alone lanes of grid24, grid32 and bumps24 take 56, 110
# and 133 ms so, and 116, 158 and 169 if columns begin


def solve_by_the_quickest(request: Request) -> Found:
    """What there is to begin with is for columns; the iterations of all methods count for a limit."""
    model, mdp = request.model, request.model.mdp
    if mdp.dtype != jnp.float64 or mdp.num_features < _MANY_FEATURES or not is_banded(model):
        return solve_by_columns(request)
    is_few = len(request.lanes) < _MANY_LANES
    if request.weights is None and _is_small(request) and not _are_a_policys(request):
        return in_turn(request, solve_by_interior_point, solve_by_columns)
    is_guided = request.policy is not None or request.weights is not None
    if is_guided or model.once(_most_features_of_a_pair) > 1 or _are_a_policys(request):
        return _columns_first(request)
    return _columns_first(request) if is_few else solve_by_pdhg(request)


def _columns_first(request: Request) -> Found:
    patient = functools.partial(solve_by_columns, gives_up=True)
    return in_turn(request, patient, solve_by_interior_point, solve_by_columns)


def _are_a_policys(request: Request) -> bool:
    """Whether features add up to a constant, and expectations to its sum over time, as those of a policy do.

    Then v* = 0, which uniform weights prove: what is left is to mix policies (grid48_exact: 135 ms a lane by columns,
    218 by PDHG).
    """
    mdp, constant = request.model.mdp, request.model.once(_sum_of_features)
    total = constant / (1.0 - float(mdp.discount))
    return bool(np.allclose(request.expectations.sum(axis=1), total, rtol=_SAME, atol=0.0))


def _sum_of_features(mdp: MDP) -> float:
    """sum_i phi_i where it is the same for all pairs; else NaN."""
    total = np.asarray(mdp.features, np.float64).sum(axis=-1)[np.asarray(mdp.allowed)]
    return float(total[0]) if np.ptp(total) <= _SAME * np.abs(total).max() else np.nan


def _is_small(request: Request) -> bool:
    """Whether the interior point is done, lane by lane on the host, before any program would be compiled."""
    model, lanes = request.model, len(request.lanes)
    return model.mdp.num_states <= _SMALL_STATES and is_soon_solved(model.once(LinearProgram), lanes)


def _most_features_of_a_pair(mdp: MDP) -> int:
    return np.count_nonzero(np.asarray(mdp.features), axis=-1).max()
