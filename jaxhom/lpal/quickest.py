"""LPAL by the method that is likely to be the quickest.

Where a model's graph is a narrow band and features do not overlap, a step of the interior-point method costs about as
much as a column, and it takes a tenth as many. Elsewhere columns are quicker, and where the interior point is stopped
by rounding, they go on from its policy and weights.
"""

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom.lpal.certificate import LPALSolution
from jaxhom.lpal.columns import solve_by_columns
from jaxhom.lpal.interior_point import quick_rows, solve_by_interior_point
from jaxhom.mdp import MDP
from jaxhom.pdhg import Status


def solve_by_the_quickest(
    mdp: MDP,
    expectations: jax.Array,
    initial_policy: jax.Array | None,
    tolerance: float,
    *,
    initial_weights: jax.Array | None = None,
    max_iterations: int | None = None,
    progress: bool = False,
) -> LPALSolution:
    """`lpal` on a batch: expectations [B, K]. What is given to begin with, and a limit, are for columns."""
    options = {"progress": progress} | ({} if max_iterations is None else {"max_iterations": max_iterations})
    is_guided = any(given is not None for given in (initial_policy, initial_weights, max_iterations))
    rows = None if is_guided else quick_rows(mdp)
    if rows is None:
        return solve_by_columns(
            mdp, expectations, initial_policy, tolerance, initial_weights=initial_weights, **options
        )
    solution = solve_by_interior_point(mdp, expectations, None, tolerance, progress=progress, rows=rows)
    left = np.flatnonzero(np.asarray(solution.status) != Status.SOLVED)
    if not left.size:
        return solution
    rest = solve_by_columns(
        mdp, expectations[left], solution.policy[left], tolerance, initial_weights=solution.weights[left], **options
    )
    return jax.tree.map(lambda all_lanes, lanes: jnp.asarray(all_lanes).at[left].set(lanes), solution, rest)
