"""Ways to extend the expert's policy from the demonstrated states to all states.

Every function takes a model and demonstrations and returns a `Generalization`: on demonstrated states the empirical
action frequencies, elsewhere what the method makes of them. What was done in absorbing states is no evidence for other
states, and votes for actions that a state lacks do not count (`evidence`).

Algorithm 1 of Boularias and Chaib-draa 2010 (`soft_local_homomorphism`) grows the set s^t of states within t steps
of an unvisited state s. At the first t at which s^t holds a demonstrated state that is locally similar to s, all
such states vote with their empirical policies. If s^t stops growing before, the policy at s is uniform.

Whatever the method, `Generalization.explain` says where a state's policy came from.
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom import checks
from jaxhom.generalization import evidence
from jaxhom.generalization.explainers import (
    ByCoordinates,
    ByHomomorphism,
    ByHops,
    demonstrated,
    uniform_elsewhere,
)
from jaxhom.generalization.explanation import Explanation
from jaxhom.generalization.votes import Votes, vote_of_nearest, vote_of_rings
from jaxhom.models.demonstrations import Demonstrations, empirical_policy
from jaxhom.models.inputs import as_model, check_coordinates
from jaxhom.models.mdp import MDP
from jaxhom.similarity.homomorphism import ClassSimilarity
from jaxhom.similarity.local_models import LocalModelClasses, local_model_classes

_ARRAYS = ("policy", "visited", "radius", "support", "error_lower", "error_upper")


@jax.tree_util.register_pytree_with_keys_class
@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Generalization:
    """A policy for every state, and where each state's came from.

    Attributes:
      policy: [S, A], rows sum to 1; 0 on actions that are not allowed.
      visited: bool [S], the demonstrated states, absorbing ones included.
      radius: int32 [S], how far the method had to look (steps); 0 on demonstrated states, -1 where nothing was
        found and the policy is uniform.
      support: int32 [S], how many demonstrated states voted; 1 on demonstrated states, 0 where nothing was found.
      error_lower: scalar, error_lower <= e <= error_upper for the optimal error e of the global program; None for other
        methods.
      error_upper: scalar, likewise.
      explainer: what the method remembers to explain itself, called with the generalization and a state. No part of
        the pytree: whatever comes out of `jax.tree.map`, `jit` or `vmap` has forgotten it.
    """

    policy: jax.Array
    visited: jax.Array
    radius: jax.Array
    support: jax.Array
    error_lower: jax.Array | None = None
    error_upper: jax.Array | None = None
    explainer: Callable[["Generalization", int], Explanation] | None = None

    def tree_flatten_with_keys(self):
        """The arrays, by name; what explains is dropped."""
        return tuple((jax.tree_util.GetAttrKey(name), getattr(self, name)) for name in _ARRAYS), None

    @classmethod
    def tree_unflatten(cls, _, arrays) -> "Generalization":
        """The generalization of these arrays, which has forgotten how it was made."""
        return cls(**dict(zip(_ARRAYS, arrays, strict=True)))

    def replace(self, **changes) -> "Generalization":
        """Returns the generalization with the given fields exchanged."""
        return dataclasses.replace(self, **changes)

    def explain(self, state) -> Explanation:
        """Says where a state's policy came from; `print` it, or read its arrays.

        For Algorithm 1 that is which demonstrated states voted, at what radius, through which map from the state's
        local model to theirs, and between which certified bounds the error of such a map lies; or that nothing was
        found. Maps are computed on demand: the first call for models of a new size compiles for a few seconds.

        Args:
          state: its number.

        Returns:
          `Explanation`.

        Raises:
          ValueError: if there is no such state, or the generalization has gone through a JAX transformation and no
            longer knows how it was made.
        """
        if self.explainer is None:
            raise ValueError(
                "this generalization no longer knows how it was made: jit, vmap and jax.tree.map drop that; "
                "ask the one that the method returned"
            )
        number = checks.as_host_array("state", state)
        checks.require_shape("state", number, "(), one state", number.ndim == 0)
        number = int(checks.require_integers("state", number, upper=len(self.visited)))
        return (demonstrated if self.visited[number] else self.explainer)(self, number)


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
    mdp = as_model(mdp)
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

    start = maximum_entropy(mdp, demonstrations)
    may_vote = _voters(mdp, start)

    def accept(state, expert):
        accepted = may_vote(state, expert)
        pairs = label[state[accepted]], label[expert[accepted]]
        accepted[accepted] = similarity.decide(*pairs, mutual=mutual, progress=progress)
        return accepted

    if states is not None:
        states = checks.as_host_array("states", states)
        checks.require_shape("states", states, f"({mdp.num_states},)", states.shape == (mdp.num_states,))
        states = states.astype(bool)
    explainer = ByHomomorphism(mdp, similarity, mutual, states)
    return _extend(mdp, start, _vote_of_rings(mdp, start, accept, states), explainer)


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
      distance: as there.
      threshold: as there.
      anchored: as there.
      tolerance: as there.
      classes: of all states at that distance, if they are known.

    Returns:
      A table of decisions about pairs of classes that fills as they are met.
    """
    if classes is None:
        classes = local_model_classes(mdp, distance=distance)
    return ClassSimilarity(mdp, classes, distance, anchored, tolerance, threshold)


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
    mdp = as_model(mdp)
    if metric == "hops":
        start = maximum_entropy(mdp, demonstrations)
        return _extend(mdp, start, _vote_of_rings(mdp, start, _voters(mdp, start)), ByHops(mdp))
    if metric != "euclidean":
        raise ValueError(f'metric must be "hops" or "euclidean", got {metric!r}')
    if coordinates is None:
        raise ValueError('metric="euclidean" needs coordinates [S, D]')
    coordinates = check_coordinates(mdp, coordinates)
    start = maximum_entropy(mdp, demonstrations)
    accept = _voters(mdp, start) if mdp.restricts_actions else None
    votes = vote_of_nearest(evidence.deciding(mdp, start.visited), np.asarray(start.policy), coordinates, accept)
    return _extend(mdp, start, votes, ByCoordinates(mdp, coordinates))


def maximum_entropy(mdp: MDP, demonstrations: Demonstrations) -> Generalization:
    """The uniform policy over the allowed actions on every state that was not demonstrated.

    Args:
      mdp: the model.
      demonstrations: the expert's trajectories.

    Returns:
      `Generalization`, with radius -1 off the demonstrated states.

    Raises:
      ValueError: if a demonstration does not fit the model.

    Source: Boularias and Chaib-draa 2010, section VI.
    """
    mdp = as_model(mdp)
    visited, policy = empirical_policy(mdp, demonstrations)
    return Generalization(
        policy=policy,
        visited=visited,
        radius=jnp.where(visited, 0, -1).astype(jnp.int32),
        support=visited.astype(jnp.int32),
        explainer=uniform_elsewhere,
    )


def _voters(mdp: MDP, start: Generalization):
    """Decides pairs (states [P], demonstrated states [P]): whether the second may vote in the first at all."""
    decides, policy = evidence.deciding(mdp, start.visited), np.asarray(start.policy)
    return lambda state, expert: decides[expert] & evidence.has_vote(mdp, policy, state, expert)


def _vote_of_rings(mdp: MDP, start: Generalization, accept, states=None) -> Votes:
    """The rings around the states that are neither demonstrated nor left out by `states`, bool [S]."""
    visited = np.asarray(start.visited)
    asking = ~visited if states is None else ~visited & states
    return vote_of_rings(mdp, visited, np.asarray(start.policy), asking, accept)


def _extend(mdp: MDP, start: Generalization, votes: Votes, explainer) -> Generalization:
    """The votes where nothing was demonstrated."""
    policy = evidence.policy_of_votes(mdp, votes.policy)[0] if mdp.restricts_actions else votes.policy
    visited = start.visited
    return start.replace(
        policy=jnp.where(visited[:, None], start.policy, policy),
        radius=jnp.where(visited, start.radius, votes.radius),
        support=jnp.where(visited, start.support, votes.support),
        explainer=explainer,
    )
