"""LPAL on the flow constraints: PDHG on the linear program (2)-(4) itself.

I - gamma T is ill-conditioned for discounts near 1, and a first-order method that only multiplies by it crawls. Here
every iteration projects exactly on the flow, by a factorisation that is made once and shared by all lanes
(`flow_factor`), and PDHG with restarts and a primal weight (`pdhg`) is left with x >= 0 and the features: a few
thousand iterations, more where occupancies spread over thousands of states without any constraint to pin them down. It
shares nothing with the columns but the certificate. Every few hundred iterations policies are read off the occupancies
(eq. 5) and their true margins computed, the weights are bounded by planning, and the loop ends when those two meet.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from jaxhom import checks
from jaxhom.apprenticeship.flow_factor import factor_flow
from jaxhom.apprenticeship.flow_lp import FlowProblem
from jaxhom.apprenticeship.planning_bound import UpperBound, better_bound, bound_by_planning
from jaxhom.apprenticeship.request import Request
from jaxhom.apprenticeship.solution import Found, LPALSolution
from jaxhom.models.mdp import MDP, uniform_policy
from jaxhom.planning.occupancy import occupancy, policy_from_occupancy
from jaxhom.solvers import pdhg
from jaxhom.status import Status

if TYPE_CHECKING:
    from jaxtyping import Array, Float

DEFAULT_ITERATIONS = 20_000
_STEPS_PER_LOOK = 16  # of pdhg.STEPS_PER_CHECK iterations each: a look solves seven linear systems per lane
_LOOKS_PER_CERTIFICATE = 8  # looks nearly always say the same
_FIRST_WEIGHT = 0.1  # the primal weight to begin with; the engine moves it from there
_WEIGHT_RANGE = (0.01, 3.0)  # times the ratio of the dual to the primal point's length
# An action that loses more than this share of the largest reward is left out of a policy.
_CLEAR_LOSSES = (float("inf"), 1e-2, 1e-4)


def solve_by_flow(request: Request) -> Found:
    """All lanes at once. Weights to begin with are not used."""
    mdp, limit = request.model.mdp, request.limit or DEFAULT_ITERATIONS
    expectations = checks.to_device(request.expectations, mdp.dtype)
    tolerance = checks.to_device(request.tolerance, mdp.dtype)
    problem = request.model.once(FlowProgram).problem(expectations)
    state = _start(problem, _first_policies(mdp, request.policy, len(expectations)))
    bound = best = None
    value = jnp.zeros((len(expectations), mdp.num_states), mdp.dtype)
    done = looks = 0
    with tqdm(disable=not request.progress, desc="LPAL", unit="iteration", total=limit) as bar:
        while True:
            bound, value, solution = _look(problem, expectations, state, bound, value, tolerance, done)
            best = solution if best is None else _better(best, solution, tolerance)
            bar.set_postfix(gap=f"{float((best.margin_bound - best.margin).max()):.2e}")
            looks += 1
            if (best.status == Status.SOLVED).all() or done >= limit or _is_certified(request, best, looks):
                return _found(best)
            steps = min(_STEPS_PER_LOOK, -(-(limit - done) // pdhg.STEPS_PER_CHECK))
            state = _advance(problem, state, steps)
            done += steps * pdhg.STEPS_PER_CHECK
            bar.update(steps * pdhg.STEPS_PER_CHECK)


def _first_policies(mdp: MDP, policies: np.ndarray | None, lanes: int) -> jax.Array:
    first = uniform_policy(mdp) if policies is None else checks.to_device(policies, mdp.dtype)
    return jnp.broadcast_to(first, (lanes, mdp.num_states, mdp.num_actions))


def _is_certified(request: Request, best: LPALSolution, looks: int) -> bool:
    """Now and then: the certificate has digits that looks in a short type, or at features far from 0, have not."""
    if looks % (1 if request.model.mdp.dtype != jnp.float64 else _LOOKS_PER_CERTIFICATE):
        return False
    return bool((request.certified(_found(best)).status == Status.SOLVED).all())


def _found(best: LPALSolution) -> Found:
    host = jax.tree.map(np.asarray, best)
    stopped = np.where(host.status == Status.SOLVED, Status.STALLED, Status.ITERATION_LIMIT)
    return Found(x=host.policy, weights=host.weights, iterations=host.iterations, stopped=stopped, negligible=0.0)


class FlowProgram:
    """The program of a model, for any expectations: features in units of their own, and the factorisation for them."""

    def __init__(self, mdp: MDP):
        features = np.asarray(mdp.features, np.float64)
        unit = _units(np.abs(features).max(axis=(0, 1)))
        scaled = features / unit
        projection = factor_flow(mdp, scaled)
        if (features == features[:, :1]).all():
            scaled = scaled[:, :1]
        self._per_expectation = (1.0 - mdp.discount) / jnp.asarray(unit, mdp.dtype)[:, None]
        self._fields = {
            "mdp": mdp,
            "features": checks.to_device(scaled, mdp.dtype),
            "projection": projection,
            "share": None if (unit == unit[0]).all() else checks.to_device(unit.min() / unit, mdp.dtype),
        }

    def problem(self, expectations: Float[Array, "B K"]) -> FlowProblem:
        """For a batch of expectations in the units of the model's features."""
        return FlowProblem(expectations=self._per_expectation * expectations.T, **self._fields)


def _units(size: np.ndarray) -> np.ndarray:
    """c [K]: one unit for features of sizes [K] that hardly differ, and for those that do one a power of 16 smaller."""
    largest = size.max() or 1.0
    with np.errstate(divide="ignore"):
        smaller = np.floor(np.log2(largest / np.where(size > 0, size, largest)) / 4.0)
    return largest * 16.0**-smaller


@jax.jit
def _start(problem: FlowProblem, initial_policy: jax.Array) -> pdhg.PDHGState:
    primal, _ = problem.start()
    x = occupancy(problem.mdp, initial_policy) * (1.0 - problem.mdp.discount)
    state = pdhg.init(problem, (primal, problem.dual_of(jnp.moveaxis(x, 0, -1))))
    return state.replace(weight=jnp.full_like(state.weight, _FIRST_WEIGHT))


@jax.jit
def _advance(problem: FlowProblem, state: pdhg.PDHGState, steps=_STEPS_PER_LOOK) -> pdhg.PDHGState:
    def step(_, state):
        state = pdhg.step(problem, state)
        # Where one side has arrived, the engine's rule gives all weight to the other and never takes it back.
        ratio = jnp.linalg.norm(state.dual, axis=0) / jnp.linalg.norm(state.primal, axis=0)
        return state.replace(weight=jnp.clip(state.weight, *(ratio * factor for factor in _WEIGHT_RANGE)))

    return jax.lax.fori_loop(0, steps, step, state)


@jax.jit
def _look(problem, expectations, state, bound: UpperBound | None, value, tolerance, iterations):
    """The best bound so far, the value function of the newest weights, and the best policy that the state suggests."""
    mdp = problem.mdp
    new_bound, plan = bound_by_planning(mdp, expectations, problem.weights(state.primal).T, value, tolerance)
    bound = new_bound if bound is None else better_bound(bound, new_bound)
    loss = plan.action_value.max(axis=-1, keepdims=True) - plan.action_value
    scale = jnp.abs(mdp.features).max()
    readings = problem.occupancies(state.primal, state.dual, state.weight)
    readings = [jnp.moveaxis(x, -1, 0) / (1.0 - mdp.discount) for x in readings]
    candidates = [jnp.zeros_like(loss)]  # nothing is left: the plan's own policy
    candidates += [jnp.where(loss <= share * scale, x, 0.0) for x in readings for share in _CLEAR_LOSSES]
    count, lanes = len(candidates), len(expectations)
    given = (expectations, bound, tolerance)
    repeated, of_all, goals = jax.tree.map(lambda leaf: jnp.concatenate([leaf] * count), given)
    solution = _solution(mdp, repeated, jnp.concatenate(candidates), of_all, goals, iterations)
    solution = jax.tree.map(lambda leaf: leaf.reshape(count, lanes, *leaf.shape[1:]), solution)
    best = solution.margin.argmax(axis=0)
    return bound, plan.value, jax.tree.map(lambda leaf: leaf[best, jnp.arange(lanes)], solution)


def _solution(mdp, expectations, x, bound: UpperBound, tolerance, iterations) -> LPALSolution:
    """The solution whose policy is read off the occupancy x [B, S, A], as good as the model's type."""
    policy = policy_from_occupancy(mdp, x, bound.policy)
    true_occupancy = occupancy(mdp, policy)
    margin = (jnp.einsum("bsa,sak->bk", true_occupancy, mdp.features) - expectations).min(axis=-1)
    margin = jnp.where(jnp.isfinite(margin), margin, -jnp.inf)
    is_closed = bound.margin_bound - margin <= tolerance
    return LPALSolution(
        policy=policy,
        occupancy=true_occupancy,
        margin=margin,
        margin_bound=bound.margin_bound,
        weights=bound.weights,
        iterations=jnp.broadcast_to(jnp.asarray(iterations, jnp.int32), margin.shape),
        status=jnp.where(is_closed, Status.SOLVED, Status.ITERATION_LIMIT).astype(jnp.int32),
    )


@jax.jit
def _better(one: LPALSolution, other: LPALSolution, tolerance) -> LPALSolution:
    """Lane by lane the larger margin, with the newest bound; lanes that were solved stay as they are."""
    take = (other.margin > one.margin) & (one.status != Status.SOLVED)

    def choose(old, new):
        return jnp.where(take.reshape(-1, *(1,) * (old.ndim - 1)), new, old)

    best = jax.tree.map(choose, one, other)
    is_closed = other.margin_bound - best.margin <= tolerance
    return best.replace(
        margin_bound=other.margin_bound,
        weights=other.weights,
        iterations=jnp.where(one.status == Status.SOLVED, one.iterations, other.iterations),
        status=jnp.where(is_closed, Status.SOLVED, Status.ITERATION_LIMIT).astype(jnp.int32),
    )
