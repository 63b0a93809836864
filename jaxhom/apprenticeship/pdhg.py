"""LPAL by PDHG on the linear program over occupancies, many lanes at a time, and what finishes lanes it brings near.

`flow_splitting` has the iteration, `flow_factor` the factor that all lanes share. A few hundred iterations find the
weights of the upper bound to many digits. The policy that is read off x is near but not there: the best one mixes a few
deterministic policies, and x has to say how, in states that hardly occur. So a lane is looked at once its weights stand
still (then the best response to them often closes it, wherever x is), or once x is on the flow: `columns` begin there,
for a few rounds. Lanes that are closed leave, and the others share the programs.

Lanes that stay open go to the interior point if the model's graph is a narrow band, and to columns to the end
otherwise. `LPALSolution.decided_by` says which it was.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom.apprenticeship.certificate import simplex_point
from jaxhom.apprenticeship.columns import DEFAULT_COLUMNS, Columns, solve_by_columns
from jaxhom.apprenticeship.flow_factor import feature_units, split_flow
from jaxhom.apprenticeship.flow_splitting import STEPS_PER_WEIGHT, Goal, Splitting, State, advance, begin, reading
from jaxhom.apprenticeship.interior_point import is_banded, solve_by_interior_point
from jaxhom.apprenticeship.request import Request
from jaxhom.apprenticeship.solution import Found, LPALMethod
from jaxhom.apprenticeship.stages import in_turn
from jaxhom.models.mdp import MDP
from jaxhom.planning.occupancy import occupancy
from jaxhom.solvers.lane_queue import map_on_cores, num_cores
from jaxhom.status import Status

if TYPE_CHECKING:
    from jax.typing import DTypeLike
    from jaxtyping import Float, Int

T = TypeVar("T")

# 14 and 18 of 32 lanes of grid16 and grid48 (bench.instances) close within 250 iterations. Of the others hardly one
# closes in 150 more: their best policies mix as many deterministic ones as there are features.
_LOOKS = (100, 50, 50, 50)  # iterations before each look
_ARRIVED = 1e-4  # sum |w - former w| of ten iterations
_NEAR = 1e-3  # what x may be off the flow where its policy is worth a column; it sums to 1
_ROUNDS = 3  # of columns at a look: a lane that needs more is sooner there by iterating on
_MOST_LANES = 16  # of a program: more leave a core's caches at 48 x 48
_STREAMED = 2**21  # entries on the factor's diagonal from which to read it takes longest: then all lanes in one program
_SHORT_DISCOUNT = 0.99  # up to here iterations are in float32, with certificates in float64 as ever: the factor loses
# (1 - gamma)^-2 of its digits, and 250 iterations of 32 lanes of grid48 take half the time


def solve_by_pdhg(request: Request) -> Found:
    """PDHG, and for lanes that it leaves open the interior point, or columns to the end."""
    if not is_banded(request.model):
        return in_turn(request, functools.partial(iterate, to_the_end=True))
    return in_turn(request, iterate, solve_by_interior_point, solve_by_columns)


def iterate(request: Request, *, to_the_end: bool = False) -> Found:
    """PDHG, and columns where a lane has its weights or its policy.

    Args:
      request: the lanes.
      to_the_end: whether columns go on with the lanes that are left.
    """
    program, left, state = request.model.once(FlowProgram), np.arange(len(request.lanes)), None
    goal = jax.tree.map(np.asarray, program.goal(request.expectations, request.policy, request.weights))
    width = min(_MOST_LANES, 1 << (-(-left.size // program.workers) - 1).bit_length())
    limit = request.limit or sum(_LOOKS) + DEFAULT_COLUMNS
    with Columns(request.replace(limit=limit)) as columns:
        if request.policy is not None or request.weights is not None:  # which may be the best already
            columns.play(left, rounds=1)
            left, goal = _still_open(columns, left, goal)
        for count in _looks(limit):
            if not left.size:
                break
            state = program.advance(goal, state, count, width)
            columns.spend(left, count)
            has_policy = state.change <= _NEAR
            some = np.flatnonzero(has_policy | (state.moved <= _ARRIVED))
            columns.offer(left[some], program.read(goal, state, width).part(some), has_policy[some])
            columns.play(left[some], rounds=_ROUNDS, gives_up=True)
            left, (goal, state) = _still_open(columns, left, (goal, state))
        if left.size and (to_the_end or limit <= sum(_LOOKS)):  # nobody else will have them
            if state is not None:
                columns.offer(left, program.read(goal, state, width), state.change <= _NEAR)
            columns.play(left)
        return columns.found(LPALMethod.PDHG)


def _still_open(columns: Columns, lanes: Int[np.ndarray, " C"], arrays: T) -> tuple[Int[np.ndarray, " C"], T]:
    """Those of the lanes that are open, with their arrays, lanes last."""
    is_open = np.isin(lanes, columns.open())
    return lanes[is_open], jax.tree.map(lambda leaf: leaf[..., is_open], arrays)


def _looks(limit: int) -> list[int]:
    """Iterations before each look, in tens, so few in all that looks have their columns; perhaps none."""
    most = limit - 1 - _ROUNDS * (len(_LOOKS) - 1)
    ends = np.minimum(np.cumsum(_LOOKS), max(most // STEPS_PER_WEIGHT, 0) * STEPS_PER_WEIGHT)
    return [int(count) for count in np.diff(ends, prepend=0) if count]


class FlowProgram:
    """The program of a model, for any expectations: features in units of their own, and the factor for them.

    Attributes:
      dtype: of the iterations.
      unit: [K], that of each feature, in the model's.
      splitting: the program. order: int [S], in which it has the states.
      workers: programs to have under way at a time.
    """

    def __init__(self, mdp: MDP, dtype: DTypeLike | None = None):
        short = np.float32 if float(mdp.discount) <= _SHORT_DISCOUNT else mdp.dtype
        self.dtype = np.dtype(short if dtype is None else dtype)
        self.unit = feature_units(np.abs(np.asarray(mdp.features, np.float64)).max(axis=(0, 1)))
        self.splitting, self.order = split_flow(mdp, self.unit, self.dtype)
        self._mdp, self._place = mdp, np.argsort(self.order)
        self._kept = 1.0 - float(mdp.discount)
        self.workers = 1 if self.splitting.factor.diagonal.size > _STREAMED else num_cores()

    def goal(
        self,
        expectations: Float[np.ndarray, "B K"],
        policy: Float[np.ndarray, "B S A"] | None = None,
        weights: Float[np.ndarray, "B K"] | None = None,
    ) -> Goal:
        """What is asked of lanes, and where they begin: a policy's occupancy, and weights; uniform if None."""
        if policy is None:
            allowed = np.asarray(self._mdp.allowed)
            x = np.broadcast_to(allowed / allowed.sum(), (len(expectations), *allowed.shape))
        else:
            x = self._kept * np.asarray(occupancy(self._mdp, jnp.asarray(policy, self._mdp.dtype)))
        weights = np.full(expectations.shape, 1.0 / expectations.shape[1]) if weights is None else weights
        parts = {
            "expectations": (self._kept * expectations / self.unit).T,
            "x": np.moveaxis(np.nan_to_num(x[:, self.order]), 0, -1),
            "w": (simplex_point(weights) * self.unit / self.unit.min()).T,
        }
        return Goal(**{name: np.ascontiguousarray(part, self.dtype) for name, part in parts.items()})

    def advance(self, goal: Goal, state: State | None, count: int, width: int) -> State:
        """So many iterations of all lanes, in tens; begun where there is no state. NumPy arrays."""
        parts = self._in_parts(
            lambda *some: _advance(self.splitting, *some, count // STEPS_PER_WEIGHT), goal, state, width
        )
        return jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=-1), *parts)

    def read(self, goal: Goal, state: State, width: int) -> Found:
        """What the lanes say, in the units of the model."""
        parts = self._in_parts(lambda *some: _reading(self.splitting, *some), goal, state, width)
        x, w, value = (np.concatenate(part, axis=-1, dtype=np.float64) for part in zip(*parts, strict=True))
        total = len(state.iterations)
        return Found(
            x=np.moveaxis(x, -1, 0)[:, self._place] / self._kept,
            weights=simplex_point(w.T),
            value=value.T[:, self._place] * self.unit.min(),
            iterations=state.iterations,
            stopped=np.full(total, Status.ITERATION_LIMIT),
            decided_by=np.full(total, LPALMethod.PDHG),
            gap=np.full(total, np.inf),
        )

    def _in_parts(self, run: Callable, goal: Goal, state: State | None, width: int) -> list:
        """What `run` makes of `width` lanes at a time, on all cores; NumPy, without lanes that fill up the last."""
        total = goal.w.shape[-1]

        def part(first: int):
            lanes = np.minimum(np.arange(first, first + width), total - 1)
            some = jax.tree.map(lambda leaf: leaf[..., lanes], (goal, state))
            return jax.tree.map(lambda leaf: np.asarray(leaf)[..., : total - first], run(*some))

        firsts = range(0, total, width)
        return [part(first) for first in firsts] if self.workers == 1 else map_on_cores(part, firsts)


@jax.jit
def _advance(splitting: Splitting, goal: Goal, state: State | None, count) -> State:
    """`count` times so many iterations as there are between two looks at the primal weight."""
    state = begin(splitting, goal) if state is None else state
    return jax.lax.fori_loop(0, count, lambda _, state: advance(splitting, goal, state), state)


_reading = jax.jit(reading)
