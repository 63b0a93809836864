"""Ways to extend the expert's policy from the demonstrated states to all states.

Every function takes a model and demonstrations and returns a `Generalization`: on demonstrated states the empirical
action frequencies, elsewhere what the method makes of them.

Algorithm 1 of Boularias and Chaib-draa 2010 (`soft_local_homomorphism`) grows the set s^t of states within t steps
of an unvisited state s. At the first t at which s^t holds a demonstrated state that is locally similar to s, all
such states vote with their empirical policies. If s^t stops growing before, the policy at s is uniform.
"""

from collections.abc import Iterator

import chex
import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from jaxhom import checks
from jaxhom.demonstrations import Demonstrations, empirical_policy
from jaxhom.homomorphism import ClassSimilarity
from jaxhom.local_models import LocalModelClasses, local_model_classes, reachable_within, restricted_model
from jaxhom.mdp import MDP
from jaxhom.pdhg import engine
from jaxhom.pdhg.global_homomorphism_lp import GlobalHomomorphismProblem

_CHUNK_BYTES = 64 * 2**20
_ITERATIONS_PER_REPORT = 320


@chex.dataclass(frozen=True)
class Generalization:
    """A policy for every state, and where each state's came from.

    Attributes:
      policy: [S, A], rows sum to 1.
      visited: bool [S], the demonstrated states.
      radius: int32 [S], how far the method had to look (steps); 0 on demonstrated states, -1 where nothing was
        found and the policy is uniform.
      support: int32 [S], how many demonstrated states voted; 1 on demonstrated states, 0 where nothing was found.
      error_lower, error_upper: scalars, bounds on the optimal error of the global program; None for other methods.
    """

    policy: jax.Array
    visited: jax.Array
    radius: jax.Array
    support: jax.Array
    error_lower: jax.Array | None = None
    error_upper: jax.Array | None = None


def soft_local_homomorphism(
    mdp: MDP,
    demonstrations: Demonstrations,
    *,
    distance: int = 1,
    threshold: float = 0.0,
    anchored: bool = True,
    mutual: bool = False,
    tolerance: float = 1e-4,
    states=None,
    similarity: ClassSimilarity | None = None,
    progress: bool = False,
) -> Generalization:
    """Algorithm 1: the votes of the nearest demonstrated states that are locally similar.

    Args:
      mdp: the model.
      demonstrations: the expert's trajectories.
      distance: d >= 1, the radius of the local models that are compared.
      threshold: epsilon >= 0, the largest error at which two states count as similar.
      anchored: require that the centre is mapped to the centre. False is the relation as printed, which on models
        whose local models have absorbing states accepts nearly every pair.
      mutual: require the error of both directions to be within the threshold.
      tolerance: an error up to threshold + tolerance may count as similar; see `locally_similar`.
      states: bool [S], the states to find a policy for; the others stay uniform. All if None. Leaving out states in
        which the action does not matter, and which lead to many, saves their large local models.
      similarity: decisions to build on, of the same model and options, for many sets of demonstrations: pairs of
        classes that it has met are not solved again. Made by `class_similarity`.
      progress: show a progress bar.

    Returns:
      `Generalization`; `radius` is the t at which the algorithm stopped.

    Raises:
      ValueError: if a demonstration does not fit the model, or an option is out of range.

    Source: Boularias and Chaib-draa 2010, Algorithm 1; anchoring and `mutual` are additions.
    """
    if not threshold >= 0:
        raise ValueError(f"threshold must not be negative, got {threshold}")
    if not tolerance > 0:
        raise ValueError(f"tolerance must be positive, got {tolerance}")
    options = (distance, threshold, anchored, tolerance)
    if similarity is None:
        similarity = class_similarity(mdp, *options)
    elif options != (similarity.distance, similarity.threshold, similarity.anchored, similarity.tolerance):
        raise ValueError("similarity was made with another distance, threshold, anchored or tolerance")
    label = similarity.classes.label

    def accept(state, expert):
        return similarity.decide(label[state], label[expert], mutual=mutual, progress=progress)

    return _vote_of_rings(mdp, demonstrations, accept, states)


def class_similarity(
    mdp: MDP,
    distance: int = 1,
    threshold: float = 0.0,
    anchored: bool = True,
    tolerance: float = 1e-4,
    classes: LocalModelClasses | None = None,
) -> ClassSimilarity:
    """What `soft_local_homomorphism` decides by, to be shared between calls.

    Args:
      mdp: the model.
      distance, threshold, anchored, tolerance: as there.
      classes: of all states at that distance, if they are known.

    Returns:
      A table of decisions about pairs of classes that fills as they are met.
    """
    if classes is None:
        classes = local_model_classes(mdp, distance=distance)
    return ClassSimilarity(mdp, classes, distance, anchored, tolerance, threshold)


def soft_homomorphism(
    mdp: MDP,
    demonstrations: Demonstrations,
    *,
    anchored: bool = False,
    tolerance: float = 1e-3,
    max_iterations: int = 20_000,
    progress: bool = False,
) -> Generalization:
    """The global soft homomorphism: one map from all states to the demonstrated ones, policies averaged by it.

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
    return start.replace(
        policy=jnp.where(visited[:, None], start.policy, voted / voted.sum(axis=1, keepdims=True)),
        radius=jnp.where(visited, 0, 1).astype(jnp.int32),
        support=jnp.where(visited, 1, (mapping > 1e-3).sum(axis=1)).astype(jnp.int32),
        error_lower=state.lower[0],
        error_upper=state.upper[0],
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


def nearest_neighbors(
    mdp: MDP,
    demonstrations: Demonstrations,
    *,
    metric: str = "hops",
    coordinates=None,
) -> Generalization:
    """The votes of the nearest demonstrated states, by steps in the model or by Euclidean distance.

    Args:
      mdp: the model.
      demonstrations: the expert's trajectories.
      metric: "hops", the least number of steps by any actions from the state to the demonstrated one (the paper's
        Manhattan distance), or "euclidean".
      coordinates: [S, D], positions of the states; needed for "euclidean" alone.

    Returns:
      `Generalization`. All demonstrated states at the least distance vote. For "euclidean", `radius` is that
      distance, rounded up to a whole number of at least 1.

    Raises:
      ValueError: if a demonstration does not fit the model, or `metric` or `coordinates` do not.

    Source: Boularias and Chaib-draa 2010, section VI (k-NN).
    """
    if metric == "hops":
        return _vote_of_rings(mdp, demonstrations, lambda state, expert: np.ones(len(state), bool))
    if metric != "euclidean":
        raise ValueError(f'metric must be "hops" or "euclidean", got {metric!r}')
    if coordinates is None:
        raise ValueError('metric="euclidean" needs coordinates [S, D]')
    coordinates = checks.as_host_array("coordinates", coordinates)
    good = coordinates.ndim == 2 and len(coordinates) == mdp.num_states
    checks.require_shape("coordinates", coordinates, f"({mdp.num_states}, D)", good)
    coordinates = checks.require_floats("coordinates", coordinates)
    return _vote_of_nearest(mdp, demonstrations, coordinates)


def maximum_entropy(mdp: MDP, demonstrations: Demonstrations) -> Generalization:
    """The uniform policy on every state that was not demonstrated.

    Args:
      mdp: the model.
      demonstrations: the expert's trajectories.

    Returns:
      `Generalization`, with radius -1 off the demonstrated states.

    Raises:
      ValueError: if a demonstration does not fit the model.

    Source: Boularias and Chaib-draa 2010, section VI.
    """
    visited, policy = empirical_policy(mdp, demonstrations)
    return Generalization(
        policy=policy,
        visited=visited,
        radius=jnp.where(visited, 0, -1).astype(jnp.int32),
        support=visited.astype(jnp.int32),
    )


def _vote_of_rings(mdp: MDP, demonstrations: Demonstrations, accept, states=None) -> Generalization:
    """Grows s^t for every unvisited s until a demonstrated state in it is accepted; the accepted ones vote.

    `accept(states, experts)` decides pairs [P] and is asked once about every pair that a ring brings together.
    `states`, bool [S], are those that ask; all if None.
    """
    start = maximum_entropy(mdp, demonstrations)
    visited, policy = np.asarray(start.visited), np.array(start.policy)
    radius, support = np.array(start.radius), np.array(start.support)
    asking = ~visited
    if states is not None:
        states = checks.as_host_array("states", states)
        checks.require_shape("states", states, f"({mdp.num_states},)", states.shape == visited.shape)
        asking &= states.astype(bool)
    experts, waiting = np.flatnonzero(visited), np.flatnonzero(asking)
    for t, ring in enumerate(_rings(mdp, experts), start=1):
        row, column = np.nonzero(ring[waiting])
        accepted = accept(waiting[row], experts[column])
        row, column = row[accepted], column[accepted]
        votes = np.zeros((len(waiting), mdp.num_actions), policy.dtype)
        np.add.at(votes, row, policy[experts[column]])
        voters = np.bincount(row, minlength=len(waiting))
        found = voters > 0
        policy[waiting[found]] = votes[found] / votes[found].sum(axis=1, keepdims=True)
        radius[waiting[found]], support[waiting[found]] = t, voters[found]
        waiting = waiting[~found]
        if not waiting.size:
            break
    return start.replace(policy=jnp.asarray(policy), radius=jnp.asarray(radius), support=jnp.asarray(support))


def _rings(mdp: MDP, experts: np.ndarray) -> Iterator[np.ndarray]:
    """For t = 1, 2, ... until no set grows: bool [S, E], which demonstrated states joined s^t at step t."""
    adjacency = reachable_within(mdp, 1)
    words = -(-len(experts) // 64)
    within = np.zeros((mdp.num_states, 64 * words), bool)
    within[experts, np.arange(len(experts))] = True
    packed = np.packbits(within, axis=1).view(np.uint64)  # words, not bytes: six times faster below
    while True:
        # Row s of the union of its successors' rows; every row of `adjacency` holds s itself.
        grown = np.bitwise_or.reduceat(packed[adjacency.indices], adjacency.indptr[:-1], axis=0)
        joined = grown & ~packed
        if not joined.any():
            return
        yield np.unpackbits(joined.view(np.uint8), axis=1, count=len(experts)).astype(bool)
        packed = grown


def _vote_of_nearest(mdp, demonstrations, coordinates) -> Generalization:
    """Euclidean nearest demonstrated states, ties (to rounding) included."""
    start = maximum_entropy(mdp, demonstrations)
    visited, policy = np.asarray(start.visited), np.array(start.policy)
    radius, support = np.array(start.radius), np.array(start.support)
    experts, waiting = np.flatnonzero(visited), np.flatnonzero(~visited)
    chunk = max(1, _CHUNK_BYTES // (8 * coordinates[experts].size))
    for states in np.split(waiting, range(chunk, len(waiting), chunk)):
        square = ((coordinates[states, None] - coordinates[experts]) ** 2).sum(axis=-1)
        nearest = square.min(axis=1)
        votes_for = square <= nearest[:, None] * (1 + 1e-9)
        support[states] = votes_for.sum(axis=1)
        policy[states] = votes_for @ policy[experts] / support[states, None]
        radius[states] = np.maximum(np.ceil(np.sqrt(nearest) * (1 - 1e-9)), 1)
    return start.replace(policy=jnp.asarray(policy), radius=jnp.asarray(radius), support=jnp.asarray(support))
