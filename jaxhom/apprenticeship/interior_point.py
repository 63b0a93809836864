"""LPAL by a sparse interior-point method on the linear program (2)-(4), lane by lane on the host.

    max v   subject to   sum x phi_i / c_i - v / c_i - slack_i = Vhat_i / c_i,   the Bellman flow,   x, slack >= 0,

with c_i the largest |phi_i|. The multipliers of the K feature rows, each divided by c_i, are the weights of the upper
bound. Pairs that are not allowed have no variable. Made for models whose graph is a narrow band
(grids: a few milliseconds a step at 48 x 48): where columns would need about as many policies as there are features,
this takes 5-40 steps.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse
from tqdm import tqdm

from jaxhom.apprenticeship.certificate import simplex_point
from jaxhom.apprenticeship.prepared import PreparedModel
from jaxhom.apprenticeship.request import Request
from jaxhom.apprenticeship.solution import Found, LPALMethod
from jaxhom.models.mdp import MDP
from jaxhom.planning.flow_matrix import flow_matrix
from jaxhom.solvers.normal_equations import Rows
from jaxhom.solvers.sparse_interior_point import solve
from jaxhom.status import Status

if TYPE_CHECKING:
    from jaxtyping import Float

DEFAULT_STEPS = 100
_MOST_WORK = 3e9  # multiplications of a step: grid100 (bench.instances) takes 4.1 s either way
_MARGIN_SHARE = 0.02  # of the tolerance, for z . s and the residuals: certificates are made of what is left


@dataclasses.dataclass(frozen=True)
class Point:
    """What the method ends with, nothing of it certified.

    Attributes:
      x: [S, A]. weights: [K]. value: [S].
      steps: taken. status: SOLVED by its own account, or why it ended.
    """

    x: Float[np.ndarray, "S A"]
    weights: Float[np.ndarray, " K"]
    value: Float[np.ndarray, " S"]
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

    def solve(
        self, expectations: Float[np.ndarray, " K"], tolerance: float, *, max_iterations: int = DEFAULT_STEPS
    ) -> Point:
        """One lane, to a gap of the tolerance if all goes well."""
        right = np.concatenate([self._initial, expectations / self._unit])
        tolerance *= _MARGIN_SHARE
        point = solve(
            self._rows, self._cost, np.array([-1.0]), right, tolerance=tolerance, max_iterations=max_iterations
        )
        num_states, x = self._shape[0], np.zeros(self._shape)
        x.ravel()[self._pairs] = point.z[: len(self._pairs)]
        weights = simplex_point(point.y[num_states:] / self._unit)
        return Point(x, weights, -point.y[:num_states], point.steps, point.status)


def is_banded(model: PreparedModel) -> bool:
    """Whether a step costs so little that a few dozen of them are quicker than columns."""
    return not model.mdp.is_dense and model.once(Program).work <= _MOST_WORK


def solve_by_interior_point(request: Request) -> Found:
    """An interior method starts in the middle of what is feasible: what there is to begin with is not used."""
    program, limit = request.model.once(Program), request.limit or DEFAULT_STEPS
    lanes = zip(request.expectations, request.tolerance, strict=True)
    bar = tqdm(lanes, desc="LPAL", unit="lane", total=len(request.lanes), disable=not request.progress)
    points = [program.solve(expectations, goal, max_iterations=limit) for expectations, goal in bar]
    x, weights, value = (np.stack([getattr(point, name) for point in points]) for name in ("x", "weights", "value"))
    stopped = [Status.ITERATION_LIMIT if point.status == Status.ITERATION_LIMIT else Status.STALLED for point in points]
    steps = np.array([point.steps for point in points])
    return Found(
        x=x,
        weights=weights,
        value=value,
        iterations=steps,
        stopped=np.array(stopped),
        decided_by=np.full(len(steps), LPALMethod.INTERIOR_POINT),
        gap=np.array([0.0 if point.status == Status.SOLVED else np.inf for point in points]),
    )
