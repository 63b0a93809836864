"""LPAL by a sparse interior-point method on the linear program (2)-(4), lane by lane on the host.

    max v   subject to   sum x phi_i / c_i - v / c_i - slack_i = Vhat_i / c_i,   the Bellman flow,   x, slack >= 0,

with c_i the largest |phi_i|. The multipliers of the K feature rows, each divided by c_i, are the weights of the upper
bound. Pairs that are not allowed have no variable. Made for models whose graph is a narrow band
(grids: a few milliseconds a step at 48 x 48): where columns would need about as many policies as there are features,
this takes 5-40 steps.
"""

import dataclasses
from collections.abc import Callable

import numpy as np
import scipy.sparse
from tqdm import tqdm

from jaxhom.apprenticeship.certificate import Found, LPALSolution, simplex_point
from jaxhom.models.mdp import MDP
from jaxhom.planning.flow_matrix import flow_matrix
from jaxhom.solvers.normal_equations import Rows
from jaxhom.solvers.sparse_interior_point import solve
from jaxhom.status import Status

DEFAULT_STEPS = 100
_MARGIN_SHARE = 0.02  # of the tolerance, for z . s and the residuals


@dataclasses.dataclass(frozen=True)
class Point:
    """What the method ends with, nothing of it certified.

    Attributes:
      x: [S, A]. weights: [K]. value: [S].
      steps: taken. status: SOLVED by its own account, or why it ended.
    """

    x: np.ndarray
    weights: np.ndarray
    value: np.ndarray
    steps: int
    status: Status


class Program:
    """The linear program of a model, for any expectations.

    Attributes:
      work: multiplications of a step, about.
    """

    def __init__(self, mdp: MDP):
        num_states, num_features = mdp.num_states, mdp.num_features
        features = np.asarray(mdp.features, float).reshape(-1, num_features).T
        size = np.abs(features).max(axis=1)
        # Powers of two: features of 0 and 1 stay as they are, and of no others are digits lost.
        self._unit = np.exp2(np.floor(np.log2(np.where(size > 0, size, 1.0))))
        self._pairs = np.flatnonzero(np.asarray(mdp.allowed))
        features = scipy.sparse.csr_array(features[:, self._pairs] / self._unit[:, None])
        slack = -scipy.sparse.eye_array(num_features)
        matrix = scipy.sparse.block_array([[flow_matrix(mdp)[:, self._pairs], None], [features, slack]])
        free_column = np.concatenate([np.zeros(num_states), -1.0 / self._unit])[:, None]
        self._rows, self._shape = Rows(matrix, free_column, num_states), (num_states, mdp.num_actions)
        self._cost, self._initial = np.zeros(matrix.shape[1]), np.asarray(mdp.initial, float)
        self.work = self._rows.work

    def solve(self, expectations: np.ndarray, tolerance: float, **options) -> Point:
        """One lane: expectations [K], and options of `sparse_interior_point.solve`."""
        right = np.concatenate([self._initial, expectations / self._unit])
        tolerance *= _MARGIN_SHARE
        point = solve(self._rows, self._cost, np.array([-1.0]), right, tolerance=tolerance, **options)
        num_states, x = self._shape[0], np.zeros(self._shape)
        x.ravel()[self._pairs] = point.z[: len(self._pairs)]
        weights = simplex_point(point.y[num_states:] / self._unit)
        return Point(x, weights, -point.y[:num_states], point.steps, point.status)


def solve_by_interior_point(
    mdp: MDP,
    expectations: np.ndarray,
    initial_policy,
    tolerance: np.ndarray,
    certify: Callable[[Found], LPALSolution],
    *,
    max_iterations: int | None = None,
    progress: bool = False,
    program: Program | None = None,
) -> LPALSolution:
    """`lpal` on a batch: expectations [B, K]. An interior method starts in the middle: `initial_policy` is not used.

    `program` is that of the model, where it is there.
    """
    del initial_policy
    program, limit = program or Program(mdp), DEFAULT_STEPS if max_iterations is None else max_iterations
    lanes = tqdm(np.asarray(expectations, float), desc="LPAL", unit="lane", disable=not progress)
    points = [program.solve(lane, goal, max_iterations=limit) for lane, goal in zip(lanes, tolerance, strict=True)]
    x, weights, value = (np.stack([getattr(point, name) for point in points]) for name in ("x", "weights", "value"))
    stopped = [Status.ITERATION_LIMIT if point.status == Status.ITERATION_LIMIT else Status.STALLED for point in points]
    return certify(
        Found(
            x=x,
            weights=weights,
            value=value,
            iterations=np.array([point.steps for point in points]),
            stopped=np.array(stopped),
        )
    )
