"""LPAL on the flow constraints: PDHG on the linear program (2)-(4) itself.

I - gamma T is ill-conditioned for discounts near 1, and a first-order method on it crawls. It is kept as a second
opinion that shares nothing with the columns but the certificate: every few hundred iterations the policy is read off
the occupancy (eq. 5) and its true margin computed, the weights are bounded by planning, and the loop ends when those
two meet.
"""

import jax
import jax.numpy as jnp
from tqdm import tqdm

from jaxhom.lpal.certificate import LPALSolution, better_bound, bound_by_planning, certify
from jaxhom.mdp import MDP
from jaxhom.occupancy import occupancy
from jaxhom.pdhg import Status, engine
from jaxhom.pdhg.flow_lp import FlowProblem

_STEPS_PER_CERTIFICATE = 50  # of engine.STEPS_PER_CHECK iterations each


def solve_by_flow(
    mdp: MDP,
    expectations: jax.Array,
    initial_policy: jax.Array | None,
    tolerance: float,
    *,
    max_iterations: int = 20_000,
    progress: bool = False,
) -> LPALSolution:
    """`lpal` on a batch: expectations [B, K], initial_policy [B, S, A] or None."""
    problem = FlowProblem(mdp=mdp, expectations=(1.0 - mdp.discount) * expectations.T)
    state = _start(problem, initial_policy)
    bound = best = None
    value = jnp.zeros((len(expectations), mdp.num_states), mdp.dtype)
    done = 0
    with tqdm(disable=not progress, desc="LPAL", unit="iteration", total=max_iterations) as bar:
        while True:
            weights = state.primal[: mdp.num_features].T
            weights = jnp.maximum(weights, 0.0) / jnp.maximum(weights, 0.0).sum(axis=1, keepdims=True)
            new_bound, plan = bound_by_planning(mdp, expectations, weights, value, tolerance)
            value = plan.value
            bound = new_bound if bound is None else better_bound(bound, new_bound)
            x = jnp.moveaxis(state.dual, -1, 0) / (1.0 - mdp.discount)
            solution = certify(mdp, expectations, x, bound, tolerance, done, stopped=Status.ITERATION_LIMIT)
            best = solution if best is None else _better(best, solution, bound, tolerance)
            bar.set_postfix(gap=f"{float((best.margin_bound - best.margin).max()):.2e}")
            if (best.status == Status.SOLVED).all() or done >= max_iterations:
                return best
            state = _advance(problem, state)
            done += _STEPS_PER_CERTIFICATE * engine.STEPS_PER_CHECK
            bar.update(_STEPS_PER_CERTIFICATE * engine.STEPS_PER_CHECK)


@jax.jit
def _start(problem: FlowProblem, initial_policy: jax.Array | None) -> engine.PDHGState:
    primal, dual = problem.start()
    if initial_policy is not None:
        x = occupancy(problem.mdp, initial_policy) * (1.0 - problem.mdp.discount)
        dual = jnp.moveaxis(x, 0, -1)
    return engine.init(problem, (primal, dual))


@jax.jit
def _advance(problem: FlowProblem, state: engine.PDHGState) -> engine.PDHGState:
    return jax.lax.fori_loop(0, _STEPS_PER_CERTIFICATE, lambda _, s: engine.step(problem, s), state)


@jax.jit
def _better(one: LPALSolution, other: LPALSolution, bound, tolerance) -> LPALSolution:
    """Lane by lane the larger margin, with the newest bound; lanes that were solved stay as they are."""
    take = (other.margin > one.margin) & (one.status != Status.SOLVED)

    def choose(old, new):
        return jnp.where(take.reshape(-1, *(1,) * (old.ndim - 1)), new, old)

    best = jax.tree.map(choose, one, other)
    is_closed = bound.margin_bound - best.margin <= tolerance
    return best.replace(
        margin_bound=bound.margin_bound,
        weights=bound.weights,
        iterations=jnp.where(one.status == Status.SOLVED, one.iterations, other.iterations),
        status=jnp.where(is_closed, Status.SOLVED, Status.ITERATION_LIMIT).astype(jnp.int32),
    )
