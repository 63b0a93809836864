"""LPAL by a sparse interior-point method on the linear program (2)-(4), lane by lane on the host.

    max v   subject to   sum x phi_i - v - slack_i = Vhat_i,   the Bellman flow,   x, slack >= 0.

The multipliers of the K feature rows are the weights of the upper bound. Made for models whose graph is a narrow band
(grids: a few milliseconds a step at 48 x 48): where columns would need about as many policies as there are features,
this takes 5-40 steps.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
import scipy.sparse
from tqdm import tqdm

from jaxhom.lpal.certificate import LPALSolution, bound_by_planning, certify
from jaxhom.mdp import MDP
from jaxhom.normal_equations import Rows, flow_matrix
from jaxhom.pdhg import Status
from jaxhom.sparse_interior_point import solve

_MARGIN_SHARE = 0.02  # of the tolerance, for z . s and the residuals


@dataclasses.dataclass(frozen=True)
class Point:
    """What the method ends with, nothing of it certified: x [S, A], weights [K], value [S], and the steps it took."""

    x: np.ndarray
    weights: np.ndarray
    value: np.ndarray
    steps: int


class Program:
    """The linear program of a model, for any expectations.

    Attributes:
      work: multiplications of a step, about.
    """

    def __init__(self, mdp: MDP):
        pairs, num_features = mdp.num_states * mdp.num_actions, mdp.num_features
        features = scipy.sparse.csr_array(np.asarray(mdp.features, float).reshape(pairs, num_features).T)
        slack = -scipy.sparse.eye_array(num_features)
        matrix = scipy.sparse.block_array([[flow_matrix(mdp), None], [features, slack]])
        free_column = np.concatenate([np.zeros(mdp.num_states), -np.ones(num_features)])[:, None]
        self._rows, self._shape = Rows(matrix, free_column, mdp.num_states), (mdp.num_states, mdp.num_actions)
        self._cost, self._initial = np.zeros(pairs + num_features), np.asarray(mdp.initial, float)
        self.work = self._rows.work

    def solve(self, expectations: np.ndarray, tolerance: float, **options) -> Point:
        """One lane: expectations [K], and options of `sparse_interior_point.solve`."""
        right = np.concatenate([self._initial, expectations])
        tolerance *= _MARGIN_SHARE
        point = solve(self._rows, self._cost, np.array([-1.0]), right, tolerance=tolerance, **options)
        num_states, num_actions = self._shape
        multipliers = np.maximum(point.y[num_states:], 0.0)
        x = point.z[: num_states * num_actions].reshape(self._shape)
        return Point(x, multipliers / multipliers.sum(), -point.y[:num_states], point.iterations)


def solve_by_interior_point(
    mdp: MDP,
    expectations,
    initial_policy,
    tolerance: float,
    *,
    max_iterations: int = 100,
    progress: bool = False,
    program: Program | None = None,
) -> LPALSolution:
    """`lpal` on a batch: expectations [B, K]. An interior method starts in the middle: `initial_policy` is not used.

    `program` is that of the model, where it is there.
    """
    del initial_policy
    program, lanes = program or Program(mdp), np.asarray(expectations, float)
    bar = tqdm(lanes, desc="LPAL", unit="lane", disable=not progress)
    points = [program.solve(expected, tolerance, max_iterations=max_iterations) for expected in bar]
    weights, value, x = (
        jnp.asarray(np.stack([getattr(point, name) for point in points]), mdp.dtype)
        for name in ("weights", "value", "x")
    )
    bound, _ = bound_by_planning(mdp, expectations, weights, value, jnp.full(len(points), tolerance, mdp.dtype))
    steps = np.array([point.steps for point in points])
    return certify(mdp, expectations, x, bound, tolerance, steps, stopped=Status.STALLED)
