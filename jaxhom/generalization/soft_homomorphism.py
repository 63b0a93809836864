"""The global soft homomorphism: one map from all states to the demonstrated ones.

LP (8) of Boularias and Chaib-draa 2010, which the paper gave up for its size; `global_lp` states it.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from jaxhom import checks
from jaxhom.generalization import evidence
from jaxhom.generalization.explainers import LEAST_SHARE, ByGlobalMap
from jaxhom.generalization.global_lp import GlobalHomomorphismProblem
from jaxhom.generalization.result import Generalization
from jaxhom.generalization.uniform import uniform_elsewhere
from jaxhom.models.demonstrations import Demonstrations
from jaxhom.models.inputs import as_model
from jaxhom.models.mdp import MDP
from jaxhom.similarity.local_models import restricted_model
from jaxhom.solvers import pdhg
from jaxhom.solvers.lane_queue import is_settled
from jaxhom.status import Status

_ITERATIONS_PER_REPORT = 320  # a program cannot be interrupted


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
      ValueError: if a demonstration does not fit the model, or the tolerance is not positive.

    Outside jit, vmap and grad only: the part of the model that was demonstrated is found on the host.

    Example:
      >>> import jaxhom
      >>> demonstrations = jaxhom.Demonstrations.from_trajectories([([0, 1, 2], [2, 2, 1])])
      >>> general = jaxhom.soft_homomorphism(jaxhom.gridworld(3), demonstrations, tolerance=1e-2)
      >>> jaxhom.Status(int(general.status)).name, bool(general.error_upper - general.error_lower <= 1e-2)
      ('SOLVED', True)

    Source: Boularias and Chaib-draa 2010, eq. (8). The paper gave it up for its size.
    """
    if not tolerance > 0:
        raise ValueError(f"tolerance must be positive, got {tolerance}")
    mdp = as_model(mdp)
    start = uniform_elsewhere(mdp, demonstrations)
    experts = np.flatnonzero(evidence.deciding(mdp, start.visited))
    if not experts.size:
        mapping, lower, upper, status = np.zeros((mdp.num_states, 0)), np.inf, np.inf, Status.SOLVED
    else:
        problem = _problem(mdp, experts, anchored)
        state = _solve_with_progress(problem, tolerance, max_iterations, progress)
        mapping, lower, upper = np.asarray(state.best_primal[..., 0]), state.lower[0], state.upper[0]
        is_met = is_settled(float(lower), float(upper), tolerance)
        status = Status.SOLVED if is_met else Status.ITERATION_LIMIT
    policy, is_found = evidence.policy_of_votes(mdp, mapping @ np.asarray(start.policy)[experts])
    visited = start.visited
    return start.replace(
        policy=jnp.where(visited[:, None], start.policy, checks.to_device(policy, mdp.dtype)),
        radius=jnp.where(visited, 0, np.where(is_found, 1, -1)).astype(jnp.int32),
        support=jnp.where(visited, 1, np.where(is_found, (mapping > LEAST_SHARE).sum(axis=1), 0)).astype(jnp.int32),
        error_lower=checks.to_device(lower, mdp.dtype),
        error_upper=checks.to_device(upper, mdp.dtype),
        status=checks.to_device(np.asarray(status), jnp.int32),
        explainer=ByGlobalMap(mdp, experts, mapping, float(lower), float(upper), anchored),
    )


def _problem(mdp: MDP, experts: np.ndarray, anchored: bool) -> GlobalHomomorphismProblem:
    pinned = np.zeros((mdp.num_states, len(experts)), bool)
    if anchored:
        pinned[experts, np.arange(len(experts))] = True
    return GlobalHomomorphismProblem(
        mdp=mdp, restricted=checks.to_device(restricted_model(mdp, experts)), pinned=checks.to_device(pinned)
    )


def _solve_with_progress(problem, tolerance: float, max_iterations: int, progress: bool) -> pdhg.PDHGState:
    """Runs the engine a few hundred iterations at a time, so that the host can report and be interrupted."""
    state = jax.jit(pdhg.init)(problem)
    with tqdm(total=max_iterations, desc="homomorphism", unit="iteration", disable=not progress) as bar:
        while int(state.steps[0]) < max_iterations and float(state.upper[0] - state.lower[0]) > tolerance:
            limit = min(int(state.steps[0]) + _ITERATIONS_PER_REPORT, max_iterations)
            state = _run_engine(problem, state, tolerance, limit)
            bar.update(int(state.steps[0]) - bar.n)
            bar.set_postfix(lower=f"{float(state.lower[0]):.4f}", upper=f"{float(state.upper[0]):.4f}")
    return state


@jax.jit
def _run_engine(problem, state, tolerance, max_iterations) -> pdhg.PDHGState:
    return pdhg.solve(problem, state, tolerance=tolerance, max_iterations=max_iterations)
