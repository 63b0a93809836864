"""The global soft homomorphism: one map from all states to the demonstrated ones.

LP (8) of Boularias and Chaib-draa 2010, which the paper gave up for its size; `global_lp` states it.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from jaxhom import checks, programs
from jaxhom.generalization import evidence, votes_in_program
from jaxhom.generalization.explainers import LEAST_SHARE, ByGlobalMap
from jaxhom.generalization.global_lp import GlobalHomomorphismProblem, HostProblem, restricted_to_list
from jaxhom.generalization.result import Generalization
from jaxhom.generalization.uniform import uniform_elsewhere
from jaxhom.models.demonstrations import Demonstrations
from jaxhom.models.inputs import as_model
from jaxhom.models.mdp import MDP
from jaxhom.similarity.local_models import restricted_model
from jaxhom.solvers import pdhg
from jaxhom.solvers.lane_queue import is_settled
from jaxhom.status import Status

# Of a thousand iterations in NumPy, per number of y [S, A, E]: 16 x 16 cells with 24 demonstrated states take 1.2 s.
# With 2e5 numbers an iteration takes three times as long as the program's.
_SECONDS = 2e-5
_ITERATIONS_PER_REPORT = 320  # a program cannot be interrupted


@checks.eager_where_concrete
def soft_homomorphism(
    mdp: MDP,
    demonstrations: Demonstrations,
    *,
    anchored: bool = True,
    tolerance: float = 1e-3,
    max_iterations: int = 20_000,
    progress: bool = False,
) -> Generalization:
    """Averages the expert's policies by one map from all states to the demonstrated ones.

    Args:
      mdp: the model.
      demonstrations: the expert's trajectories, visiting E states that do not absorb.
      anchored: map each of these states to itself; False is the program as printed.
      tolerance: gap between the bounds on the optimal error to settle for.
      max_iterations: of PDHG; each costs a few products with [S, A, E] numbers.
      progress: show a progress bar.

    Returns:
      `Generalization` with `error_lower` and `error_upper`, and a `status` that says why where these are further apart
      than the tolerance. pi(s, .) = sum_s' f(s, s') pi(s', .) off the
      demonstrated states, over the actions allowed there; their `radius` is 1, and `support` counts the states with
      f(s, s') > 1e-3. Where nothing is left of it, or only absorbing states were demonstrated (there is no map then,
      and the error is infinite), the policy is uniform, with radius -1 and support 0.

    Raises:
      ValueError: if a demonstration does not fit the model, the tolerance is not positive, or an option is traced.

    Works under jit and vmap, whatever is traced but the options. E is then the number of all states or of all recorded
    steps, if fewer, whatever was visited. Values are not checked there, `progress` shows nothing, the result does not
    know how it was made, and what is not finite ends the iterations at once, with bounds that are not either. No
    derivatives.

    Example:
      >>> import jaxhom
      >>> demonstrations = jaxhom.Demonstrations.from_trajectories([([0, 1, 2], [2, 2, 1])])
      >>> general = jaxhom.soft_homomorphism(jaxhom.gridworld(3), demonstrations, tolerance=1e-2)
      >>> jaxhom.Status(int(general.status)).name, bool(general.error_upper - general.error_lower <= 1e-2)
      ('SOLVED', True)
      >>> import jax
      >>> learn = jax.jit(lambda shown: jaxhom.soft_homomorphism(jaxhom.gridworld(3), shown, tolerance=1e-2))
      >>> again = learn(demonstrations)
      >>> bool(again.error_lower <= general.error_upper), bool(general.error_lower <= again.error_upper)
      (True, True)

    Source: Boularias and Chaib-draa 2010, eq. (8). The paper gave it up for its size.
    """
    checks.refuse_traced(anchored=anchored, tolerance=tolerance, max_iterations=max_iterations)
    if not tolerance > 0:
        raise ValueError(f"tolerance must be positive, got {tolerance}")
    mdp = as_model(mdp)
    start = uniform_elsewhere(mdp, demonstrations)
    if checks.is_traced(mdp, demonstrations):
        experts = votes_in_program.padded_experts(mdp, demonstrations, start.visited)
        return _generalization(mdp, start, _solve_in_program(mdp, start, experts, anchored, tolerance, max_iterations))
    experts = np.flatnonzero(evidence.deciding(mdp, start.visited))
    solved = _solve_on_host(mdp, start, experts, anchored, tolerance, max_iterations, progress)
    explainer = ByGlobalMap(mdp, experts, solved.mapping, float(solved.lower), float(solved.upper), anchored)
    return _generalization(mdp, start, solved).replace(explainer=explainer)


class _Solved(NamedTuple):
    """A map [S, E], the expert's policies averaged by it [S, A], and bounds on the optimal error."""

    votes: np.ndarray | jax.Array
    mapping: np.ndarray | jax.Array
    lower: jax.Array
    upper: jax.Array
    status: int | jax.Array


def _generalization(mdp: MDP, start: Generalization, solved: _Solved) -> Generalization:
    """The averages as a policy; uniform where nothing is left of them."""
    policy, is_found = evidence.policy_of_votes(mdp, solved.votes)
    xp, chosen = checks.arrays_of(start, policy), (solved.mapping > LEAST_SHARE).sum(axis=1)
    visited = xp.asarray(start.visited)
    return start.replace(
        policy=checks.to_device(xp.where(visited[:, None], xp.asarray(start.policy), policy), mdp.dtype),
        radius=checks.to_device(xp.where(visited, 0, xp.where(is_found, 1, -1)), jnp.int32),
        support=checks.to_device(xp.where(visited, 1, xp.where(is_found, chosen, 0)), jnp.int32),
        error_lower=checks.to_device(solved.lower, mdp.dtype),
        error_upper=checks.to_device(solved.upper, mdp.dtype),
        status=checks.to_device(solved.status, jnp.int32),
        explainer=None,
    )


def _solve_on_host(mdp: MDP, start, experts: np.ndarray, anchored, tolerance, max_iterations, progress) -> _Solved:
    """The map to the given states, with a look at the clock and the keyboard every few hundred iterations."""
    if not experts.size:
        nothing = np.zeros((mdp.num_states, mdp.num_actions))
        return _Solved(nothing, nothing[:, :0], np.inf, np.inf, Status.SOLVED)
    problem = _host_problem(mdp, experts, anchored)
    state = _solve_with_progress(problem, tolerance, max_iterations, progress)
    lower, upper = state.lower[0], state.upper[0]
    is_met = is_settled(float(lower), float(upper), tolerance)
    status = Status.SOLVED if is_met else Status.ITERATION_LIMIT
    mapping = np.asarray(state.best_primal[..., 0])
    return _Solved(mapping @ np.asarray(start.policy)[experts], mapping, lower, upper, status)


def _solve_in_program(mdp: MDP, start, experts: jax.Array, anchored, tolerance, max_iterations) -> _Solved:
    """The map to a list of states [E] that is padded with S; without an iteration where it is nothing but padding."""
    exists = experts < mdp.num_states
    problem = GlobalHomomorphismProblem(
        mdp=mdp,
        restricted=restricted_to_list(mdp, experts),
        pinned=anchored & (jnp.arange(mdp.num_states)[:, None] == experts),
        exists=exists,
    )
    # T^E is rounded: by as much, at most, its optimal error differs from the model's.
    rounding = mdp.probability.shape[-1] * float(jnp.finfo(mdp.dtype).eps)
    is_any = exists.any()
    limit = jnp.where(is_any, max_iterations, 0)
    gap = max(tolerance - 4.0 * rounding, 0.0)
    state = pdhg.solve(problem, pdhg.init(problem), tolerance=gap, max_iterations=limit)
    lower = jnp.where(is_any, jnp.maximum(state.lower[0] - rounding, 0.0), jnp.inf)
    upper = jnp.where(is_any, state.upper[0] + rounding, jnp.inf)
    is_met = is_settled(lower, upper, tolerance) | ~is_any
    mapping = jnp.where(exists, state.best_primal[..., 0], 0.0)
    votes = votes_in_program.sum_of_policies(mapping, start.policy, experts)
    return _Solved(votes, mapping, lower, upper, jnp.where(is_met, Status.SOLVED, Status.ITERATION_LIMIT))


def _host_problem(mdp: MDP, experts: np.ndarray, anchored: bool) -> HostProblem:
    pinned = np.zeros((mdp.num_states, len(experts)), bool)
    if anchored:
        pinned[experts, np.arange(len(experts))] = True
    return HostProblem(
        mdp=mdp,
        restricted=restricted_model(mdp, experts).astype(mdp.dtype),
        pinned=pinned,
        exists=np.ones(len(experts), bool),
        rows=mdp.dynamics.host_matrix(np.asarray(mdp.probability)),
    )


def _solve_with_progress(problem, tolerance: float, max_iterations: int, progress: bool) -> pdhg.PDHGState:
    """Runs the engine a few hundred iterations at a time, so that the host can report and be interrupted."""
    run, state = _solve_some, pdhg.init(problem)
    if programs.pays(_SECONDS * state.dual.size):
        run, problem, state = _run_engine, *jax.tree.map(checks.to_device, (problem.on_device(), state))
    with tqdm(total=max_iterations, desc="homomorphism", unit="iteration", disable=not progress) as bar:
        while int(state.steps[0]) < max_iterations and float(state.upper[0] - state.lower[0]) > tolerance:
            limit = min(int(state.steps[0]) + _ITERATIONS_PER_REPORT, max_iterations)
            state = run(problem, state, tolerance, limit)
            bar.update(int(state.steps[0]) - bar.n)
            bar.set_postfix(lower=f"{float(state.lower[0]):.4f}", upper=f"{float(state.upper[0]):.4f}")
    return state


def _solve_some(problem, state, tolerance, max_iterations) -> pdhg.PDHGState:
    return pdhg.solve(problem, state, tolerance=tolerance, max_iterations=max_iterations)


_run_engine = programs.host_jit(_solve_some)
