"""LPAL by PDHG on the linear program over occupancies, a queue of lanes, and what finishes the lanes it brings near.

`flow_splitting` has the iteration, `flow_factor` the factor that all lanes share. A few hundred iterations find the
weights of the upper bound to many digits. The policy that is read off x is near but not there: the best one mixes a few
deterministic policies, and x has to say how, in states that hardly occur. So a lane leaves the queue once x is nearly on
the flow (`_NEAR`), and what is left is done by others (`stages`): a few rounds of columns that begin at the lane's
weights, values and policy, and for lanes that are still open the interior point where the model's graph is a narrow
band, or columns to the end.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom.apprenticeship.certificate import simplex_point
from jaxhom.apprenticeship.columns import Columns, solve_by_columns
from jaxhom.apprenticeship.flow_factor import split_flow
from jaxhom.apprenticeship.flow_splitting import STEPS_PER_WEIGHT, Goal, Splitting, State, advance, begin, reading
from jaxhom.apprenticeship.interior_point import is_banded, solve_by_interior_point
from jaxhom.apprenticeship.request import Request
from jaxhom.apprenticeship.solution import Found
from jaxhom.apprenticeship.stages import in_turn
from jaxhom.models.mdp import MDP
from jaxhom.planning.occupancy import occupancy
from jaxhom.solvers.lane_queue import num_cores
from jaxhom.status import Status

if TYPE_CHECKING:
    from jaxtyping import Float

DEFAULT_ITERATIONS = 1000
_LOOKS = (100, 50, 50, 50)
_ARRIVED = 1e-4  # of w
_NEAR = 1e-3  # x is off the flow by so much at most where its policy is worth a column
_MOST_LANES = 16  # of a program: more leave the caches of a core
_ROUNDS = 3  # of columns, for lanes that get on
_STREAMED = (
    2**21
)  # entries of a third of a factor from which reading it takes longer than its products: one program for all lanes


class FlowProgram:
    """The program of a model, for any expectations: features in units of their own, and the factor for them."""

    def __init__(self, mdp: MDP, dtype: np.dtype | None = None):
        features = np.asarray(mdp.features, np.float64)
        self.dtype = np.dtype(np.float32)
        self._unit = _units(np.abs(features).max(axis=(0, 1)))
        self.splitting, self._order = split_flow(mdp, self._unit, self.dtype)
        self._place, self._mdp = np.argsort(self._order), mdp
        self._kept = 1.0 - float(mdp.discount)
        self._is_streamed = self.splitting.factor.diagonal.size > _STREAMED
        self._width = 0  # lanes of a program, once there are lanes

    def goal(
        self,
        expectations: Float[np.ndarray, "B K"],
        policy: Float[np.ndarray, "B S A"] | None = None,
        weights: Float[np.ndarray, "B K"] | None = None,
    ) -> Goal:
        """What is asked of lanes, and where they begin: the occupancy of a policy, and weights."""
        lanes, shape = len(expectations), (self._mdp.num_states, self._mdp.num_actions)
        if policy is None:
            allowed = np.asarray(self._mdp.allowed)
            x = np.broadcast_to(allowed / allowed.sum(), (lanes, *shape))
        else:
            x = self._kept * np.asarray(occupancy(self._mdp, jnp.asarray(policy, self._mdp.dtype)))
        if weights is None:
            weights = np.full(expectations.shape, 1.0 / expectations.shape[1])
        scaled = simplex_point(weights) * self._unit / self._unit.min()
        names = ("expectations", "x", "w")
        given = (self._kept * expectations / self._unit).T, np.moveaxis(x[:, self._order], 0, -1), scaled.T
        return Goal(**{name: np.ascontiguousarray(array, self.dtype) for name, array in zip(names, given, strict=True)})

    def advance(self, goal: Goal, state: State | None, count: int) -> State:
        """So many iterations of all lanes, some at a time, on all cores; NumPy arrays."""
        parts = self._in_parts(lambda *some: _advance(self.splitting, *some, count // STEPS_PER_WEIGHT), goal, state)
        return jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=-1), *parts)

    def read(self, goal: Goal, state: State) -> Found:
        """What the lanes say, in the units of the model."""
        parts = self._in_parts(lambda *some: _reading(self.splitting, *some), goal, state)
        x, w, value = (np.concatenate(part, axis=-1, dtype=np.float64) for part in zip(*parts, strict=True))
        return Found(
            x=np.moveaxis(x, -1, 0)[:, self._place] / self._kept,
            weights=simplex_point(w.T),
            value=value.T[:, self._place] * (self._unit.min() / self._kept),
            iterations=state.iterations,
            stopped=np.full(len(state.iterations), Status.ITERATION_LIMIT),
        )

    def _in_parts(self, run: Callable, goal: Goal, state: State | None) -> list:
        """What `run` makes of some lanes at a time: in NumPy, without the lanes that fill up the last part."""
        total = goal.w.shape[-1]
        workers = 1 if self._is_streamed else num_cores()
        self._width = self._width or min(_MOST_LANES, -(-total // workers))

        def part(first):
            lanes = np.minimum(np.arange(first, first + self._width), total - 1)
            some = jax.tree.map(lambda leaf: leaf[..., lanes], (goal, state))
            return jax.tree.map(lambda leaf: np.asarray(leaf)[..., : total - first], run(*some))

        firsts = range(0, total, self._width)
        if workers == 1 or len(firsts) == 1:
            return [part(first) for first in firsts]
        with ThreadPoolExecutor(workers) as threads:
            return list(threads.map(part, firsts))


@jax.jit
def _advance(splitting: Splitting, goal: Goal, state: State | None, count) -> State:
    """`count` times so many iterations as there are between two looks at the weight."""
    state = begin(splitting, goal) if state is None else state
    return jax.lax.fori_loop(0, count, lambda _, state: advance(splitting, goal, state), state)


_reading = jax.jit(reading)


def _units(size: np.ndarray) -> np.ndarray:
    """c [K]: one unit for features of sizes [K] that hardly differ, and for those that do one a power of 16 smaller."""
    largest = size.max() or 1.0
    with np.errstate(divide="ignore"):
        smaller = np.floor(np.log2(largest / np.where(size > 0, size, largest)) / 4.0)
    return largest * 16.0**-smaller


def solve_by_pdhg(request: Request) -> Found:
    """PDHG, and for lanes that it leaves open the interior point, or columns to the end."""
    banded = is_banded(request.model)
    return in_turn(
        request,
        functools.partial(_iterate, to_the_end=not banded),
        *[solve_by_interior_point] * banded,
        solve_by_columns,
    )


def _iterate(request: Request, *, to_the_end: bool) -> Found:
    """PDHG, and columns where a lane has its weights, or its policy."""
    program, total = request.model.once(FlowProgram), len(request.lanes)
    goal = jax.tree.map(np.asarray, program.goal(request.expectations, request.policy, request.weights))
    left, state = np.arange(total), None
    with Columns(request.replace(limit=request.limit or DEFAULT_ITERATIONS, policy=None)) as columns:
        for count in _LOOKS:
            state = program.advance(goal, state, count)
            columns.spend(left, count)
            has_policy = state.change <= _NEAR
            some = np.flatnonzero(has_policy | (state.moved <= _ARRIVED))
            columns.offer(left[some], program.read(goal, state).part(some), has_policy[some])
            columns.play(left[some], rounds=_ROUNDS, gives_up=True)
            still = np.isin(left, columns.open())
            left = left[still]
            if not left.size:
                break
            goal, state = jax.tree.map(lambda leaf, still=still: leaf[..., still], (goal, state))
        if left.size and to_the_end:
            columns.offer(left, program.read(goal, state), state.change <= _NEAR)
            columns.play(left)
        return columns.found()
