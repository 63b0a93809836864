"""Nearest neighbours: the votes of the nearest demonstrated states, whatever their local models (section VI)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jaxhom.generalization import evidence
from jaxhom.generalization.explainers import ByCoordinates, ByHops
from jaxhom.generalization.result import Generalization, extend, may_vote, votes_around
from jaxhom.generalization.uniform import uniform_elsewhere
from jaxhom.generalization.votes import vote_of_nearest
from jaxhom.models.demonstrations import Demonstrations
from jaxhom.models.inputs import as_model, check_coordinates
from jaxhom.models.mdp import MDP

if TYPE_CHECKING:
    from jaxtyping import ArrayLike, Float


def nearest_neighbors(
    mdp: MDP,
    demonstrations: Demonstrations,
    *,
    metric: str = "hops",
    coordinates: Float[ArrayLike, "S D"] | None = None,
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

    Outside jit, vmap and grad only: the model's graph is searched on the host.

    Example:
      >>> import jaxhom
      >>> grid = jaxhom.gridworld(4)
      >>> demonstrations = jaxhom.Demonstrations.from_trajectories([([0, 1], [2, 2])])
      >>> jaxhom.nearest_neighbors(grid, demonstrations).radius.reshape(4, 4)[0].tolist()
      [0, 0, 1, 2]
      >>> near = jaxhom.nearest_neighbors(grid, demonstrations, metric="euclidean", coordinates=grid.coordinates)
      >>> near.support[2]
      Array(1, dtype=int32)

    Source: Boularias and Chaib-draa 2010, section VI (k-NN).
    """
    mdp = as_model(mdp)
    if metric == "hops":
        start = uniform_elsewhere(mdp, demonstrations)
        votes = votes_around(mdp, start, may_vote(mdp, start), ~np.asarray(start.visited))
        return extend(mdp, start, votes, ByHops(mdp))
    if metric != "euclidean":
        raise ValueError(f'metric must be "hops" or "euclidean", got {metric!r}')
    if coordinates is None:
        raise ValueError('metric="euclidean" needs coordinates [S, D]')
    coordinates = check_coordinates(mdp, coordinates)
    start = uniform_elsewhere(mdp, demonstrations)
    accept = may_vote(mdp, start) if mdp.restricts_actions else None
    votes = vote_of_nearest(evidence.deciding(mdp, start.visited), np.asarray(start.policy), coordinates, accept)
    return extend(mdp, start, votes, ByCoordinates(mdp, coordinates))
