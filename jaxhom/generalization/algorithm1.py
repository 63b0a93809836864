"""Algorithm 1 of Boularias and Chaib-draa 2010: the votes of the nearest demonstrated states that are locally similar.

The set s^t of states within t steps of an unvisited state s grows. At the first t at which s^t holds a demonstrated
state whose local model is similar to that of s, all such states vote with their empirical policies. If s^t stops
growing before, the policy at s is uniform.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np

from jaxhom import checks
from jaxhom.generalization import votes_in_program
from jaxhom.generalization.explainers import ByHomomorphism
from jaxhom.generalization.result import Generalization, extend
from jaxhom.generalization.uniform import uniform_elsewhere
from jaxhom.generalization.votes import policies_that_count
from jaxhom.generalization.voting import HostBallots, VotingRule
from jaxhom.models.demonstrations import Demonstrations
from jaxhom.models.inputs import as_model, asked_states
from jaxhom.models.mdp import MDP, deciding_states
from jaxhom.similarity.given_table import table_for
from jaxhom.similarity.relations import UserRelation
from jaxhom.similarity.table import SimilarityTable

if TYPE_CHECKING:
    from jaxtyping import ArrayLike, Bool, Num


@checks.eager_where_concrete
def soft_local_homomorphism(
    mdp: MDP,
    demonstrations: Demonstrations,
    *,
    distance: int = 1,
    threshold: float = 0.0,
    anchored: bool = True,
    mutual: bool = False,
    labels: Num[ArrayLike, "S A L"] | Num[ArrayLike, "S L"] | None = None,
    label_weight: float = 1.0,
    relation: str | UserRelation = "homomorphism",
    voters: str | int = "nearest",
    weights: str = "equal",
    temperature: float = 0.05,
    tolerance: float = 1e-4,
    states: Bool[ArrayLike, " S"] | None = None,
    table: SimilarityTable | None = None,
    progress: bool = False,
    similarity: SimilarityTable | None = None,
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
      labels: [S, A, L], or [S, L] for labels of the state: what local models are told apart by besides transitions,
        such as a reward [S, A], `mdp.features`, or how far an action is from the shortest way. See `SimilarityTable`.
      label_weight: what labels are multiplied by.
      relation: what the error of a pair is: "homomorphism", that of LP (9); "isomorphic", "weisfeiler_lehman",
        "random_walk", "lax", or a function of two local models. See `SimilarityTable`.
      voters: "nearest": those of Algorithm 1, all similar ones at the first distance at which there is one; a number k:
        at the first distance within which there are k, or of all that are reached; "all": all similar ones, also those
        that are not reached, whose models only look alike (`disjoint_union`).
      weights: "equal"; or "similarity": a vote counts exp(-e / temperature) for the upper bound e on its error, which
        is certified to the tolerance.
      temperature: of these weights.
      tolerance: an error up to threshold + tolerance may count as similar; see `locally_similar`.
      states: bool [S], the states to find a policy for; the others stay uniform. All if None. Leaving out states in
        which the action does not matter, and which lead to many, saves their large local models.
      table: a `SimilarityTable` of the same model, `distance`, `anchored`, `relation` and `labels`, for many sets of
        demonstrations or thresholds: pairs of classes that it has met are not solved again. Made anew if None. Under a
        trace it is needed, and completed for the threshold: `SimilarityTable(mdp, ...).complete(threshold)`.
      progress: show a progress bar.
      similarity: the former name of `table`, which warns.

    Returns:
      `Generalization`; `radius` is the t at which the last voter was found, 1 for voters="all". Pairs of states whose
      error could not be told from the threshold count as different: `undecided` says how many of a state's, and
      `status` why.

    Raises:
      ValueError: if a demonstration does not fit the model, an option is out of range or traced, or `table` is
        another's; under a trace also if there is none, or it is not completed for the threshold.

    Works under jit and vmap with a completed table, which is the host's: no program is solved there. Demonstrations,
    `states` and the model may be traced; a traced model is taken for the table's if it has its shapes. Values are not
    checked there, and the result does not know how it was made. Votes have no derivatives, in whatever is traced.

    Example:
      >>> import jaxhom
      >>> grid = jaxhom.gridworld(8)
      >>> demonstrations = jaxhom.Demonstrations.from_trajectories([([9, 10, 11], [2, 2, 1])])
      >>> general = jaxhom.soft_local_homomorphism(grid, demonstrations)
      >>> general.radius.reshape(8, 8)[1].tolist()  # beside the walk, and the right border, which nothing is like
      [-1, 0, 0, 0, 1, 2, 3, -1]
      >>> import jax
      >>> table = jaxhom.SimilarityTable(grid).complete()
      >>> learn = jax.jit(lambda shown: jaxhom.soft_local_homomorphism(grid, shown, table=table).radius)
      >>> learn(demonstrations).reshape(8, 8)[1].tolist()
      [-1, 0, 0, 0, 1, 2, 3, -1]

    Source: Boularias and Chaib-draa 2010, Algorithm 1; anchoring, `mutual`, labels, relations other than LP (9), voters
    and weights are additions.
    """
    if similarity is not None:
        checks.warn("similarity is now called table", DeprecationWarning)
        if table is not None:
            raise ValueError("similarity is the former name of table: give one of them")
        table = similarity
    fixed = {"distance": distance, "anchored": anchored, "mutual": mutual}
    checks.refuse_traced(**fixed, labels=labels, label_weight=label_weight)
    anchored = checks.require_switch("anchored", anchored)
    rule = VotingRule(threshold, checks.require_switch("mutual", mutual), tolerance, voters, weights, temperature)
    mdp = as_model(mdp)
    is_traced = checks.is_traced(mdp, demonstrations, states)
    if is_traced and table is None:
        raise ValueError(
            "table is needed where something is traced: solve all pairs of classes outside jit, vmap and grad with "
            "SimilarityTable(mdp, ...).complete(threshold), and close over it"
        )
    kind = {"distance": distance, "anchored": anchored, "labels": labels, "label_weight": label_weight}
    table = table_for(table, mdp, relation=relation, **kind)
    start = uniform_elsewhere(mdp, demonstrations)
    if is_traced:
        asking = ~start.visited & asked_states(mdp, states)
        experts = votes_in_program.padded_experts(mdp, demonstrations, start.visited)
        found = votes_in_program.vote_by_rule(mdp, start, experts, asking, table, rule)
        return extend(mdp, start, found.votes, None, undecided=found.undecided, status=found.status)
    asking = ~np.asarray(start.visited) & asked_states(mdp, states)
    votes, ended = _vote_on_host(mdp, start, asking, table, rule, progress)
    return extend(mdp, start, votes, ByHomomorphism(mdp, table, asking, rule), **ended)


def _vote_on_host(mdp: MDP, start: Generalization, asking: np.ndarray, table: SimilarityTable, rule, progress):
    """The votes around the states that ask, bool [S], and `undecided` and `status`; solves the pairs that it meets."""
    visited, policy = np.asarray(start.visited), np.asarray(start.policy)
    # All classes that will be met, at once: programs are as wide as the widest class that is known.
    met = asking | deciding_states(mdp, visited)
    group = np.zeros(mdp.num_states, np.int32)
    group[met] = table.classes(np.flatnonzero(met))
    ballots = HostBallots(mdp, table, rule, policies_that_count(mdp, visited, policy), progress)
    votes = ballots.elect(visited, policy, asking, group)
    ended = {
        "undecided": checks.to_device(ballots.undecided, jnp.int32),
        "status": checks.to_device(np.asarray(ballots.status), jnp.int32),
    }
    return votes, ended
