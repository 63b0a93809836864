"""The global soft homomorphism: one map from all states to the demonstrated ones.

LP (8) of Boularias and Chaib-draa 2010, which the paper gave up for its size; `pdhg.global_homomorphism_lp` states it.
"""

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from jaxhom.demonstrations import Demonstrations
from jaxhom.explainers import LEAST_SHARE, ByGlobalMap
from jaxhom.generalization import Generalization, maximum_entropy
from jaxhom.local_models import restricted_model
from jaxhom.mdp import MDP
from jaxhom.pdhg import engine
from jaxhom.pdhg.global_homomorphism_lp import GlobalHomomorphismProblem

_ITERATIONS_PER_REPORT = 320


def soft_homomorphism(
    mdp: MDP,
    demonstrations: Demonstrations,
    *,
    anchored: bool = False,
    tolerance: float = 1e-3,
    max_iterations: int = 20_000,
    progress: bool = False,
) -> Generalization:
    """Averages the expert's policies by one map from all states to the demonstrated ones.

    Args:
      mdp: the model.
      demonstrations: the expert's trajectories, visiting E states.
      anchored: map every demonstrated state to itself; False is the program as printed.
      tolerance: gap between the bounds on the optimal error to settle for.
      max_iterations: of PDHG; each costs a few products with [S, A, E] numbers.
      progress: show a progress bar.

    Returns:
      `Generalization` with `error_lower` and `error_upper`. pi(s, .) = sum_s' f(s, s') pi(s', .) off the
      demonstrated states; their `radius` is 1, and `support` counts the states with f(s, s') > 1e-3.

    Raises:
      ValueError: if a demonstration does not fit the model, or the tolerance is not positive.

    Source: Boularias and Chaib-draa 2010, eq. (8). The paper gave it up for its size.
    """
    if not tolerance > 0:
        raise ValueError(f"tolerance must be positive, got {tolerance}")
    start = maximum_entropy(mdp, demonstrations)
    experts = np.flatnonzero(np.asarray(start.visited))
    pinned = np.zeros((mdp.num_states, len(experts)), bool)
    if anchored:
        pinned[experts, np.arange(len(experts))] = True
    problem = GlobalHomomorphismProblem(
        mdp=mdp, restricted=jnp.asarray(restricted_model(mdp, experts)), pinned=jnp.asarray(pinned)
    )
    state = _solve_with_progress(problem, tolerance, max_iterations, progress)
    mapping = state.best_primal[..., 0]
    voted = mapping @ start.policy[experts]
    visited = start.visited
    lower, upper = state.lower[0], state.upper[0]
    return start.replace(
        policy=jnp.where(visited[:, None], start.policy, voted / voted.sum(axis=1, keepdims=True)),
        radius=jnp.where(visited, 0, 1).astype(jnp.int32),
        support=jnp.where(visited, 1, (mapping > LEAST_SHARE).sum(axis=1)).astype(jnp.int32),
        error_lower=lower,
        error_upper=upper,
        explainer=ByGlobalMap(mdp, np.asarray(mapping), float(lower), float(upper), anchored),
    )


def _solve_with_progress(problem, tolerance: float, max_iterations: int, progress: bool) -> engine.PDHGState:
    """Runs the engine a few hundred iterations at a time, so that the host can report and be interrupted."""
    state = jax.jit(engine.init)(problem)
    with tqdm(total=max_iterations, desc="homomorphism", unit="iteration", disable=not progress) as bar:
        while int(state.steps[0]) < max_iterations and float(state.upper[0] - state.lower[0]) > tolerance:
            limit = min(int(state.steps[0]) + _ITERATIONS_PER_REPORT, max_iterations)
            state = _run_engine(problem, state, tolerance, limit)
            bar.update(int(state.steps[0]) - bar.n)
            bar.set_postfix(lower=f"{float(state.lower[0]):.4f}", upper=f"{float(state.upper[0]):.4f}")
    return state


@jax.jit
def _run_engine(problem, state, tolerance, max_iterations) -> engine.PDHGState:
    return engine.solve(problem, state, tolerance=tolerance, max_iterations=max_iterations)
