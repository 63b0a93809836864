"""LPAL by a sparse interior-point method on the linear program (2)-(4), lane by lane on the host.

    max v   subject to   sum x phi_i - v - slack_i = Vhat_i,   the Bellman flow,   x, slack >= 0.

The multipliers of the K feature rows are the weights of the upper bound. Made for models whose graph is a narrow band
(grids: a few milliseconds a step at 48 x 48) and for features that do not overlap, such as region indicators, of which
there may be as many as states: where columns would need about as many policies as features, this takes 5-25 steps.
"""

import jax.numpy as jnp
import numpy as np
import scipy.sparse
from tqdm import tqdm

from jaxhom.lpal.certificate import LPALSolution, bound_by_planning, certify
from jaxhom.mdp import MDP
from jaxhom.pdhg import Status
from jaxhom.sparse_interior_point import Rows, flow_matrix, solve

_MARGIN_SHARE = 0.1  # of the tolerance, for z . s and the residuals
_QUICK_STEP = 3e7  # multiplications of a factorisation
_QUICK_STATES = 1024
_MANY_FEATURES = 16


def solve_by_interior_point(
    mdp: MDP,
    expectations,
    initial_policy,
    tolerance: float,
    *,
    max_iterations: int = 100,
    progress: bool = False,
    rows: Rows | None = None,
) -> LPALSolution:
    """`lpal` on a batch: expectations [B, K]. An interior method starts in the middle: `initial_policy` is not used.

    `rows` are those of `quick_rows`, where they are there.
    """
    del initial_policy
    pairs, num_features = mdp.num_states * mdp.num_actions, mdp.num_features
    rows = rows or _rows(mdp)
    cost, initial = np.zeros(pairs + num_features), np.asarray(mdp.initial, float)
    points = []
    for expected in tqdm(np.asarray(expectations, float), desc="LPAL", unit="lane", disable=not progress):
        right = np.concatenate([initial, expected])
        options = {"tolerance": _MARGIN_SHARE * tolerance, "max_iterations": max_iterations}
        points.append(solve(rows, cost, np.array([-1.0]), right, **options))
    x = np.stack([point.z[:pairs] for point in points]).reshape(-1, mdp.num_states, mdp.num_actions)
    multipliers = np.stack([np.maximum(point.y[mdp.num_states :], 0.0) for point in points])
    weights = multipliers / multipliers.sum(axis=1, keepdims=True)
    value = -np.stack([point.y[: mdp.num_states] for point in points])
    accuracy = jnp.full(len(points), tolerance, mdp.dtype)
    bound, _ = bound_by_planning(mdp, expectations, *(jnp.asarray(a, mdp.dtype) for a in (weights, value)), accuracy)
    steps = np.array([point.iterations for point in points])
    x = jnp.asarray(x, mdp.dtype)
    return certify(mdp, expectations, x, bound, tolerance, steps, stopped=Status.STALLED)


def quick_rows(mdp: MDP) -> Rows | None:
    """The rows of the program if a lane takes some tens of milliseconds: a narrow band, and many features apart."""
    if mdp.is_dense or mdp.dtype != jnp.float64 or mdp.num_states > _QUICK_STATES or mdp.num_features < _MANY_FEATURES:
        return None
    if np.count_nonzero(np.asarray(mdp.features), axis=-1).max() > 1:
        return None
    rows = _rows(mdp)
    return rows if rows.num_core * rows.bandwidth**2 <= _QUICK_STEP else None


def _rows(mdp: MDP) -> Rows:
    """The rows of the program: the flow, then one per feature."""
    pairs, num_features = mdp.num_states * mdp.num_actions, mdp.num_features
    features = scipy.sparse.csr_array(np.asarray(mdp.features, float).reshape(pairs, num_features).T)
    matrix = scipy.sparse.block_array([[flow_matrix(mdp), None], [features, -scipy.sparse.eye_array(num_features)]])
    free_column = np.concatenate([np.zeros(mdp.num_states), -np.ones(num_features)])[:, None]
    return Rows(matrix, free_column, mdp.num_states)
