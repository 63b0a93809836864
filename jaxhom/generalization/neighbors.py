"""Nearest neighbours: the votes of the nearest demonstrated states, whatever their local models (section VI)."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np

from jaxhom import checks
from jaxhom.generalization import evidence, votes_in_program
from jaxhom.generalization.explainers import ByCoordinates, ByHops
from jaxhom.generalization.grouped_votes import are_searched, vote_of_nearest_by_group
from jaxhom.generalization.result import Generalization, extend
from jaxhom.generalization.uniform import uniform_elsewhere
from jaxhom.generalization.votes import Votes, plain_ballots, vote_of_nearest, vote_of_rings
from jaxhom.models.demonstrations import Demonstrations
from jaxhom.models.inputs import as_model, check_coordinates
from jaxhom.models.mdp import MDP, deciding_states

if TYPE_CHECKING:
    from jaxtyping import ArrayLike, Float


@checks.eager_where_concrete
def nearest_neighbors(
    mdp: MDP,
    demonstrations: Demonstrations,
    *,
    metric: str = "hops",
    coordinates: Float[ArrayLike, "S D"] | None = None,
    progress: bool = False,
) -> Generalization:
    """The votes of the nearest demonstrated states, by steps in the model or by Euclidean distance.

    Args:
      mdp: the model.
      demonstrations: the expert's trajectories.
      metric: "hops", the least number of steps by any actions from the state to the demonstrated one (the paper's
        Manhattan distance), or "euclidean".
      coordinates: [S, D], positions of the states; needed for "euclidean" alone.
      progress: show a bar over the states of a large model, by steps.

    Returns:
      `Generalization`. All demonstrated states at the least distance vote. For "euclidean", `radius` is that
      distance, rounded up to a whole number of at least 1.

    Raises:
      ValueError: if a demonstration does not fit the model, or `metric` or `coordinates` do not.

    Works under jit and vmap, whatever is traced but `metric`. Values are not checked there, and the result does not
    know how it was made; distances are in JAX's default type. Votes have no derivatives.

    Example:
      >>> import jaxhom
      >>> grid = jaxhom.gridworld(4)
      >>> demonstrations = jaxhom.Demonstrations.from_trajectories([([0, 1], [2, 2])])
      >>> jaxhom.nearest_neighbors(grid, demonstrations).radius.reshape(4, 4)[0].tolist()
      [0, 0, 1, 2]
      >>> import jax
      >>> learn = jax.jit(lambda shown: jaxhom.nearest_neighbors(grid, shown).radius)
      >>> learn(demonstrations).reshape(4, 4)[0].tolist()
      [0, 0, 1, 2]
      >>> near = jaxhom.nearest_neighbors(grid, demonstrations, metric="euclidean", coordinates=grid.coordinates)
      >>> near.support[2]
      Array(1, dtype=int32)

    Source: Boularias and Chaib-draa 2010, section VI (k-NN).
    """
    mdp = as_model(mdp)
    if metric not in ("hops", "euclidean"):
        raise ValueError(f'metric must be "hops" or "euclidean", got {metric!r}')
    if metric == "euclidean" and coordinates is None:
        raise ValueError('metric="euclidean" needs coordinates [S, D]')
    coordinates = check_coordinates(mdp, coordinates) if metric == "euclidean" else None
    start = uniform_elsewhere(mdp, demonstrations)
    if checks.is_traced(mdp, demonstrations, coordinates):
        return extend(mdp, start, _votes_in_program(mdp, demonstrations, start, coordinates), None)
    visited, policy = np.asarray(start.visited), np.asarray(start.policy)
    if coordinates is None:
        votes = _votes_by_hops(mdp, visited, policy, progress)
        return extend(mdp, start, votes, ByHops(mdp))
    accept = functools.partial(evidence.has_vote, mdp, policy) if mdp.restricts_actions else None
    votes = vote_of_nearest(deciding_states(mdp, visited), policy, coordinates, accept)
    return extend(mdp, start, votes, ByCoordinates(mdp, coordinates))


def _votes_by_hops(mdp: MDP, visited, policy, progress: bool) -> Votes:
    ballots, group = plain_ballots(mdp, visited, policy), np.zeros(len(visited), int)
    if mdp.restricts_actions:  # states with the same actions ask alike
        _, group = np.unique(np.asarray(mdp.allowed), axis=0, return_inverse=True)
    if are_searched(len(visited), int(visited.sum()), group):
        votes = vote_of_nearest_by_group(mdp, visited, policy, ~visited, ballots, group, progress)
        if votes is not None:
            return votes
    return vote_of_rings(mdp, visited, policy, ~visited, ballots)


def _votes_in_program(mdp: MDP, demonstrations: Demonstrations, start: Generalization, coordinates) -> Votes:
    experts = votes_in_program.padded_experts(mdp, demonstrations, start.visited)
    if coordinates is None:
        return votes_in_program.vote_of_rings(mdp, start, experts, ~start.visited)
    return votes_in_program.vote_of_nearest(mdp, start, experts, jnp.asarray(coordinates, float))
