"""LPAL by an interior-point method on the linear program (2)-(4).

    max v   subject to   sum x phi_i / c_i - v / c_i - slack_i = Vhat_i / c_i,   the Bellman flow,   x, slack >= 0,

with c_i the largest |phi_i|. The multipliers of the K feature rows, each divided by c_i, are the weights of the upper
bound. Pairs that are not allowed have no variable. Made for models whose graph is a narrow band
(grids: a few milliseconds a step at 48 x 48): where columns would need about as many policies as there are features,
this takes 5-40 steps. There, in float64, compiled programs solve batches, one lane per core at a time (`band_queue`);
few lanes, some more of small models, and all other models go lane by lane on the host (`sparse_interior_point`).
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections.abc import Callable
from typing import TYPE_CHECKING

import jax
import numpy as np
import scipy
from tqdm import tqdm

from jaxhom import checks
from jaxhom.apprenticeship.certificate import simplex_point
from jaxhom.apprenticeship.exact import compact_features
from jaxhom.apprenticeship.prepared import PreparedModel
from jaxhom.apprenticeship.request import Request
from jaxhom.apprenticeship.solution import Found, LPALMethod
from jaxhom.models.mdp import MDP
from jaxhom.planning.flow_matrix import flow_matrix
from jaxhom.solvers import band_interior_point
from jaxhom.solvers.band_queue import solve_lanes
from jaxhom.solvers.band_system import BandSystem, band_system
from jaxhom.solvers.blas_threads import one_blas_thread
from jaxhom.solvers.block_tridiagonal import Blocks
from jaxhom.solvers.normal_equations import Rows
from jaxhom.solvers.sparse_interior_point import solve, start
from jaxhom.status import Status

if TYPE_CHECKING:
    from jaxtyping import Float, Int

DEFAULT_STEPS = 100
_MOST_WORK = 3e9  # multiplications of a step: grid100 (bench.instances) takes 4.1 s either way
_MOST_COMPILED_WORK = 4.0  # of the host's: where features are eliminated before the flow, its factor may be smaller
_MANY_LANES = 8  # fewer do not pay for compiling, three seconds; of 32 lanes of grid48 each takes half as long
_BATCH = 32  # lanes from which programs are compiled for small models, too: of grid16 each then takes half as long
_SMALL_WORK = 1e8  # multiplications of a step up to which threads of BLAS wait for one another
_SOON = 1e8  # multiplications of a step of all lanes, up to which the host is done within the seconds of compiling:
# of grid16, grid24 and grid32 (bench.instances) lanes take 22, 56 and 110 ms each
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


class LinearProgram:
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
        self._flow = flow_matrix(mdp)[:, self._pairs]
        matrix = scipy.sparse.block_array([[self._flow, None], [features, slack]])
        free_column = np.concatenate([np.zeros(num_states), -1.0 / self._unit])[:, None]
        self._rows, self._shape = Rows(matrix, free_column, num_states), (num_states, mdp.num_actions)
        self._cost, self._initial = np.zeros(matrix.shape[1]), np.asarray(mdp.initial, float)
        self.work = self._rows.work
        self._mdp = mdp

    def solve(
        self, expectations: Float[np.ndarray, " K"], tolerance: float, *, max_iterations: int = DEFAULT_STEPS
    ) -> Point:
        """One lane, to a gap of the tolerance if all goes well."""
        right = np.concatenate([self._initial, expectations / self._unit])
        tolerance *= _MARGIN_SHARE
        point = solve(
            self._rows, self._cost, np.array([-1.0]), right, tolerance=tolerance, max_iterations=max_iterations
        )
        return self._point(point.z, point.y, point.steps, point.status)

    def _point(self, z, y, steps: int, status: Status) -> Point:
        """What the variables and multipliers of the program mean."""
        num_states, x = self._shape[0], np.zeros(self._shape)
        x.ravel()[self._pairs] = z[: len(self._pairs)]
        weights = simplex_point(y[num_states:] / self._unit)
        return Point(x, weights, -y[:num_states], steps, status)

    @functools.cached_property
    def is_compiled(self) -> bool:
        """Whether lanes are solved in compiled programs, a few at a time."""
        if self._mdp.is_dense or checks.to_device(np.zeros(1)).dtype != np.float64:
            return False
        _, blocks = self._system
        num_features = len(self._unit)
        border = len(blocks.order) * num_features * (2 * blocks.size + num_features)
        return blocks.count > 1 and blocks.work + border <= _MOST_COMPILED_WORK * self.work

    @functools.cached_property
    def _system(self) -> tuple[BandSystem, Blocks]:
        mdp = self._mdp
        features = compact_features(np.asarray(mdp.features, float) / self._unit, np.asarray(mdp.allowed))
        pairs = self._pairs
        if features.shape[1] == 1:
            return band_system(self._flow, features[:, 0], pairs // mdp.num_actions, -1.0 / self._unit)
        features = features.reshape(-1, len(self._unit))[pairs]
        return band_system(self._flow, features, np.arange(len(pairs)), -1.0 / self._unit)

    def solve_many(
        self,
        expectations: Float[np.ndarray, "B K"],
        tolerance: Float[np.ndarray, " B"],
        limit: Int[np.ndarray, " B"],
        progress: Callable[[int], object] = lambda count: None,
    ) -> list[Point]:
        """All lanes, as `solve`, in compiled programs; `numpy.linalg.LinAlgError` where rounding lets none begin."""
        system, blocks = self._system
        self._rows.factor(np.ones(len(self._cost)))
        initial, starts = self._placed(self._initial), []
        right = expectations / self._unit
        for lane in right:
            point = start(self._rows, self._cost, np.array([-1.0]), np.concatenate([self._initial, lane]))
            y, w = self._placed(point.y[: self._shape[0]]), point.y[self._shape[0] :]
            starts.append(band_interior_point.Point(z=point.z, s=point.s, y=y, w=w, f=point.f[0]))
        lanes = band_interior_point.Lanes(right=right, tolerance=_MARGIN_SHARE * tolerance, limit=limit)
        answers = solve_lanes(system, initial, lanes, jax.tree.map(lambda *leaves: np.stack(leaves), *starts), progress)
        best = answers.best
        points = []
        for lane in range(len(right)):
            y = np.concatenate([best.y[lane][blocks.place], best.w[lane]])
            status = Status.SOLVED if answers.error[lane] <= _MARGIN_SHARE * tolerance[lane] else Status.STALLED
            points.append(self._point(best.z[lane], y, int(answers.steps[lane]), status))
        return points

    def _placed(self, of_states: np.ndarray) -> np.ndarray:
        """Numbers of the states in the order of the blocks."""
        _, blocks = self._system
        placed = np.zeros(blocks.count * blocks.size)
        placed[blocks.place] = of_states
        return placed


def is_banded(model: PreparedModel) -> bool:
    """Whether a step costs so little that a few dozen of them are quicker than columns."""
    return not model.mdp.is_dense and model.once(LinearProgram).work <= _MOST_WORK


def is_soon_solved(program: LinearProgram, lanes: int) -> bool:
    """Whether so many lanes are solved on the host before any program would be compiled."""
    return lanes < _BATCH and lanes * program.work <= _SOON


def solve_by_interior_point(request: Request) -> Found:
    """An interior method starts in the middle of what is feasible: what there is to begin with is not used."""
    program, total = request.model.once(LinearProgram), len(request.lanes)
    limit = np.full(total, request.limit or DEFAULT_STEPS)
    with tqdm(desc="LPAL", unit="lane", total=total, disable=not request.progress) as bar:
        is_compiled = total >= _MANY_LANES and not is_soon_solved(program, total)
        points = _compiled(program, request, limit, bar.update) if is_compiled else None
        if points is None:
            points = []
            for lane in zip(request.expectations, request.tolerance, limit, strict=True):
                with one_blas_thread() if program.work <= _SMALL_WORK else contextlib.nullcontext():
                    points.append(program.solve(*lane[:2], max_iterations=lane[2]))
                bar.update(1)
    x, weights, value = (np.stack([getattr(point, name) for point in points]) for name in ("x", "weights", "value"))
    steps = np.array([point.steps for point in points])
    return Found(
        x=x,
        weights=weights,
        value=value,
        iterations=steps,
        stopped=np.where(steps >= limit, Status.ITERATION_LIMIT, Status.STALLED),
        decided_by=np.full(total, LPALMethod.INTERIOR_POINT),
        gap=np.array([0.0 if point.status == Status.SOLVED else np.inf for point in points]),
    )


def _compiled(program: LinearProgram, request: Request, limit: np.ndarray, progress: Callable) -> list[Point] | None:
    """The lanes by compiled programs; None where the model has none, or rounding lets none begin."""
    if not program.is_compiled:
        return None
    try:
        return program.solve_many(request.expectations, request.tolerance, limit, progress)
    except np.linalg.LinAlgError:  # on the host every lane says for itself how far it came
        return None
