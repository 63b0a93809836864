"""The regression baseline: a policy for every state from a state occupancy that is a quadratic plus few errors.

Boularias and Chaib-draa 2010, section VI ("nonlinear regression"): with p the coordinates of a state,

    min sum_s |err(s)|   subject to   sum_a x(s, a) = b . (1, p_i, p_i p_j) + err(s),   the Bellman flow,   x >= 0,

and x(s, a) = pi(s, a) sum_a' x(s, a') with the expert's frequencies pi on demonstrated states. The policy elsewhere is
x(s, a) / sum_a' x(s, a'), eq. (5).

What a demonstrated state does is one variable, its mu(s) = sum_a x(s, a), so that its constraints need no rows.
Absorbing states count as not demonstrated, and actions that are not allowed have no variable. An interior-point method
solves the program (`sparse_interior_point`: 0.4 s for a 48 x 48 grid, where HiGHS takes 15); where rounding stops it
too early, SciPy's HiGHS does. The optimal x need not be unique: the interior-point method ends in the middle of the
optimal ones.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
import scipy

from jaxhom import checks
from jaxhom.generalization.explainers import ByOccupancy
from jaxhom.generalization.result import Generalization
from jaxhom.models.demonstrations import Demonstrations, empirical_policy
from jaxhom.models.inputs import as_model, check_coordinates
from jaxhom.models.mdp import MDP, deciding_states, uniform_policy
from jaxhom.planning.flow_matrix import flow_matrix
from jaxhom.planning.occupancy import has_occupancy, policy_from_occupancy
from jaxhom.solvers.normal_equations import Rows
from jaxhom.solvers.sparse_interior_point import solve
from jaxhom.status import Status

if TYPE_CHECKING:
    from jaxtyping import ArrayLike, Float

_TOLERANCE = 1e-7  # of the objective and of the residuals, as a share of all discounted time
_GOOD_ENOUGH = 1e-5  # beyond which HiGHS has to do it


@checks.eager_where_concrete
def occupancy_regression(
    mdp: MDP, demonstrations: Demonstrations, coordinates: Float[ArrayLike, "S D"]
) -> Generalization:
    """Extends the expert's policy by a quadratic regression of the state occupancy.

    Args:
      mdp: the model.
      demonstrations: the expert's trajectories.
      coordinates: [S, D], positions of the states.

    Returns:
      `Generalization`. `radius` is 1 off the demonstrated states, and `support` the number of demonstrated states that
      do not absorb, all of which have a say; -1 and 0 where the state hardly ever occurs and the policy is uniform.

    Raises:
      ValueError: if a demonstration does not fit the model, `coordinates` do not, or anything is traced.
      RuntimeError: if no solver finds an optimum.

    The linear program is solved on the host: inside jit, vmap and grad of concrete values alone.

    Example:
      >>> import jaxhom
      >>> grid = jaxhom.gridworld(4)
      >>> demonstrations = jaxhom.Demonstrations.from_trajectories([([0, 1, 5], [2, 1, 2])])
      >>> general = jaxhom.occupancy_regression(grid, demonstrations, grid.coordinates)
      >>> general.policy.shape, int(general.support[10])
      ((16, 4), 3)

    Source: Boularias and Chaib-draa 2010, section VI; the linear program is written out above.
    """
    mdp = as_model(mdp)
    if checks.is_traced(mdp, demonstrations, coordinates):
        raise ValueError(
            "the linear program of occupancy_regression is solved on the host: call it outside jit, vmap and grad, or "
            "use nearest_neighbors or soft_local_homomorphism there"
        )
    basis = quadratic_basis(check_coordinates(mdp, coordinates))
    visited, empirical = (np.asarray(array) for array in empirical_policy(mdp, demonstrations))
    decides = deciding_states(mdp, visited)
    x = _solve(mdp, basis, _expansion(mdp, decides, empirical)).reshape(empirical.shape)
    occurs, policy = has_occupancy(mdp, x), policy_from_occupancy(mdp, x, np.asarray(uniform_policy(mdp)))
    found = np.where(occurs, 1, -1)
    return Generalization(
        policy=checks.to_device(np.where(visited[:, None], empirical, policy), mdp.dtype),
        visited=checks.to_device(visited),
        radius=checks.to_device(np.where(visited, 0, found), jnp.int32),
        support=checks.to_device(np.where(visited, 1, decides.sum() * occurs), jnp.int32),
        undecided=checks.to_device(np.zeros_like(visited), jnp.int32),
        status=checks.to_device(np.asarray(Status.SOLVED), jnp.int32),
        explainer=ByOccupancy(x, int(decides.sum())),
        state_names=mdp.state_names,
        action_names=mdp.action_names,
    )


def quadratic_basis(coordinates: np.ndarray) -> np.ndarray:
    """An orthonormal basis [S, q] of the quadratics in coordinates [S, D], as far as the states tell them apart."""
    low, high = coordinates.min(axis=0), coordinates.max(axis=0)
    scaled = (coordinates - low) / np.where(high > low, high - low, 1.0)
    first, second = np.triu_indices(scaled.shape[1])
    monomials = np.concatenate([np.ones((len(scaled), 1)), scaled, scaled[:, first] * scaled[:, second]], axis=1)
    left, size, _ = np.linalg.svd(monomials, full_matrices=False)
    return left[:, size > 1e-10 * size[0]]


def _expansion(mdp: MDP, decides: np.ndarray, empirical: np.ndarray) -> scipy.sparse.csr_array:
    """[S A, m]: x as a function of mu(s) on demonstrated states and of x(s, a), where allowed, on the others."""
    num_states, num_actions = empirical.shape
    state = np.repeat(np.arange(num_states), num_actions)
    demonstrated = scipy.sparse.csr_array((empirical.ravel(), (np.arange(empirical.size), state)))
    others = scipy.sparse.eye_array(empirical.size, format="csr")
    is_free = ~decides[state] & np.asarray(mdp.allowed).ravel()
    return scipy.sparse.hstack([demonstrated[:, decides], others[:, is_free]], format="csr")


def _solve(mdp: MDP, basis: np.ndarray, expansion) -> np.ndarray:
    """The occupancy x, [S A]. Variables: those of `expansion`, and both signs of the errors; free: b."""
    num_states, num_variables = mdp.num_states, expansion.shape[1]
    total = scipy.sparse.kron(scipy.sparse.eye_array(num_states), np.ones((1, mdp.num_actions)))
    error = scipy.sparse.eye_array(num_states)
    matrix = scipy.sparse.block_array([[flow_matrix(mdp) @ expansion, None, None], [total @ expansion, -error, error]])
    free_columns = np.concatenate([np.zeros_like(basis), -basis])
    cost = np.concatenate([np.zeros(num_variables), np.ones(2 * num_states)])
    right = np.concatenate([np.asarray(mdp.initial, float), np.zeros(num_states)])
    all_time = 1.0 / (1.0 - float(mdp.discount))
    rows = Rows(matrix, free_columns, num_states)
    point = solve(rows, cost, np.zeros(basis.shape[1]), right, tolerance=_TOLERANCE * all_time)
    z = point.z if point.error <= _GOOD_ENOUGH * all_time else _solve_by_highs(matrix, free_columns, cost, right)
    return expansion @ z[:num_variables]


def _solve_by_highs(matrix, free_columns, cost, right) -> np.ndarray:
    """The same program by SciPy's HiGHS."""
    num_free = free_columns.shape[1]
    result = scipy.optimize.linprog(
        np.concatenate([cost, np.zeros(num_free)]),
        A_eq=scipy.sparse.hstack([matrix, scipy.sparse.csc_array(free_columns)], format="csc"),
        b_eq=right,
        bounds=[(0, None)] * len(cost) + [(None, None)] * num_free,
        method="highs",
    )
    if not result.success:
        raise RuntimeError(f"the regression's linear program was not solved: {result.message}")
    return np.maximum(result.x[: len(cost)], 0.0)
