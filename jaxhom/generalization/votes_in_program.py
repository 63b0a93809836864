"""Who votes, inside jit and vmap: the searches of `votes` where demonstrations, or anything else, are traced.

The demonstrated states are a list of static length E, as many as there are steps, padded with S. Sets of them are kept
as bits: 32 to a word, W = ceil(E / 32) words for each state. The set s^t of Algorithm 1 grows by one sweep, which takes
the union of the sets of a state's successors; the accepted ones among those that joined vote. A sweep costs as many
operations on words as there are edges, times W, and nothing of size [S, E] is made before the votes are counted.

Which sets are similar is looked up by class: `Relation` says it for the classes of a completed table.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom import checks
from jaxhom.generalization import evidence
from jaxhom.generalization.result import Generalization
from jaxhom.generalization.votes import Votes, nearest, square_distances
from jaxhom.generalization.voting import VotingRule
from jaxhom.models.demonstrations import Demonstrations
from jaxhom.models.graph import host_graph
from jaxhom.models.mdp import MDP, deciding_states
from jaxhom.models.padded_rows import narrow_width
from jaxhom.similarity.decisions import Relation
from jaxhom.similarity.table import SimilarityTable
from jaxhom.status import Status

_UNROLL = 2  # successors whose sets are united in one pass; XLA repeats a union without a loop in all that reads it


class FoundVotes(NamedTuple):
    """What a search found: the votes, and `undecided` [S] and `status` as in `Generalization`."""

    votes: Votes
    undecided: jax.Array
    status: jax.Array


class _Search(NamedTuple):
    """The search after t steps. Sets of demonstrated states are words [S, W]; the rest is [S].

    Attributes:
      within: who lies within t steps.
      asked: who lay within as many steps as the state has waited.
      voters: who votes.
      is_waiting: whether a state asks and has not enough voters yet.
      radius: after how many steps the last of them joined; -1 where none did.
    """

    steps: jax.Array
    is_growing: jax.Array
    within: jax.Array
    asked: jax.Array
    voters: jax.Array
    is_waiting: jax.Array
    radius: jax.Array


def padded_experts(mdp: MDP, demonstrations: Demonstrations, visited) -> jax.Array:
    """int32 [E]: the demonstrated states that decide, ascending, then S; E is all states or all steps, if fewer."""
    length = min(mdp.num_states, demonstrations.states.size)
    decides = deciding_states(mdp, visited)
    return jnp.nonzero(decides, size=length, fill_value=mdp.num_states)[0].astype(jnp.int32)


def vote_of_rings(mdp: MDP, start: Generalization, experts, asking) -> Votes:
    """As `votes.vote_of_rings` with `votes.plain_ballots`: the nearest demonstrated states that may vote.

    Args:
      mdp: the model.
      start: the demonstrated states and the expert's policy.
      experts: from `padded_experts`.
      asking: bool [S], the states to ask for, none of them demonstrated.
    """
    search = _grow(mdp, experts, _may_vote(mdp, start, experts), asking, least=1)
    return _elected(mdp, search, sum_of_policies(_unpacked(search.voters, len(experts)), start.policy, experts))


def vote_by_rule(
    mdp: MDP, start: Generalization, experts, asking, table: SimilarityTable, rule: VotingRule
) -> FoundVotes:
    """As `voting.HostBallots.elect`, where the table is complete for the rule."""
    relation = table.relation(**rule.of_table, with_errors=rule.is_weighted)
    ballots = _Ballots(mdp, start.policy, experts, relation, rule)
    may_vote = _may_vote(mdp, start, experts) if relation.renaming is None else ballots.has_vote()
    accepted = may_vote & _by_class(relation, relation.similar, experts)
    if rule.least_voters is None:
        search = _everybody(mdp, experts, accepted, asking)
    else:
        search = _grow(mdp, experts, accepted, asking, rule.least_voters)
    votes = _elected(mdp, search, ballots.total(_unpacked(search.voters, len(experts))))
    undecided, status = jnp.zeros(mdp.num_states, jnp.int32), jnp.asarray(Status.SOLVED, jnp.int32)
    for reason in (Status.ITERATION_LIMIT, Status.STALLED):
        count = _count(search.asked & may_vote & _by_class(relation, relation.status == reason, experts))
        undecided += count
        status = jnp.where(count.any(), jnp.int32(reason), status)
    return FoundVotes(votes, undecided, status)


class _Ballots(NamedTuple):
    """What demonstrated states say to all states; the votes of one are [S, A]."""

    mdp: MDP
    policy: jax.Array
    experts: jax.Array
    relation: Relation
    rule: VotingRule

    def has_vote(self) -> jax.Array:
        """Words [S, W]: the demonstrated states of whose renamed votes some are for actions that the state has."""
        return _packed(jax.lax.map(lambda expert: self._renamed(expert).any(axis=1), self.experts).T)

    def total(self, is_voter) -> jax.Array:
        """[S, A]: the sum of the votes of voters [S, E]."""
        label, weights = jnp.asarray(self.relation.label), is_voter.astype(self.policy.dtype)
        if self.relation.error is not None:
            by_class = jnp.asarray(self.relation.error, self.policy.dtype)
            error = by_class[:, label.at[self.experts].get(mode="clip")][label]
            least = jnp.where(is_voter, error, jnp.inf).min(axis=1, keepdims=True)
            weights *= self.rule.weight(error, jnp.where(jnp.isfinite(least), least, 0.0), jnp)
        if self.relation.renaming is None:
            return sum_of_policies(weights, self.policy, self.experts)

        def add(total, one):
            expert, weight = one
            return total + weight[:, None] * self._renamed(expert), None

        total, _ = jax.lax.scan(add, jnp.zeros_like(self.policy), (self.experts, weights.T))
        return total

    def _renamed(self, expert) -> jax.Array:
        """[S, A]: the votes of one demonstrated state, its actions renamed; 0 for a place that is padding."""
        label = jnp.asarray(self.relation.label)
        order = jnp.asarray(self.relation.renaming)[label, label.at[expert].get(mode="clip")]
        votes = self.policy.at[expert].get(mode="fill", fill_value=0)[order]
        return evidence.allowed_part(self.mdp, slice(None), votes)


def _elected(mdp: MDP, search: _Search, total) -> Votes:
    """What a search found, and the sum [S, A] of the votes of its voters."""
    support = _count(search.voters)
    return Votes(
        policy=evidence.policy_of_votes(mdp, total)[0],
        radius=jnp.where(support > 0, search.radius, -1),
        support=support,
    )


def vote_of_nearest(mdp: MDP, start: Generalization, experts, coordinates) -> Votes:
    """As `votes.vote_of_nearest`: the demonstrated states at the least distance in `coordinates` [S, D]."""
    everyone, chosen = jnp.arange(mdp.num_states)[:, None], _clipped(mdp, experts)
    counts = evidence.has_vote(mdp, start.policy, everyone, chosen) & (experts < mdp.num_states)
    square = jnp.where(counts, square_distances(coordinates, coordinates[chosen]), jnp.inf)
    is_voter, radius = nearest(square, coordinates)
    return Votes(
        policy=evidence.policy_of_votes(mdp, sum_of_policies(is_voter, start.policy, experts))[0],
        radius=jnp.where(is_voter.any(axis=1), radius, -1).astype(jnp.int32),
        support=is_voter.sum(axis=1, dtype=jnp.int32),
    )


def sum_of_policies(weights, policy, experts) -> jax.Array:
    """[S, A]: the sum of the demonstrated states' policies with weights [S, E]; booleans are 0 and 1."""
    policies = policy.at[experts].get(mode="fill", fill_value=0)
    return jnp.matmul(weights.astype(policy.dtype), policies, precision=jax.lax.Precision.HIGHEST)


def _grow(mdp: MDP, experts, accepted, asking, least: int) -> _Search:
    """Grows the sets until no state waits for `least` voters or no set grows, after S steps at the latest."""
    successors = _successors(mdp)

    def step(search: _Search) -> _Search:
        grown = _united(search.within, successors)
        waits = search.is_waiting[:, None]
        joined = jnp.where(waits, grown & ~search.within & accepted, 0)
        voters = search.voters | joined
        is_waiting = search.is_waiting & (_count(voters) < least)
        return _Search(
            steps=search.steps + 1,
            is_growing=(grown != search.within).any() & is_waiting.any(),
            within=grown,
            asked=jnp.where(waits, grown, search.asked),
            voters=voters,
            is_waiting=is_waiting,
            radius=jnp.where((joined > 0).any(axis=1), search.steps + 1, search.radius),
        )

    within = _packed(jnp.arange(mdp.num_states)[:, None] == experts)
    start = _Search(
        steps=jnp.int32(0),
        is_growing=asking.any(),
        within=within,
        asked=within,
        voters=within & ~within,  # empty: sets of the states that ask are, at first
        is_waiting=asking,
        radius=jnp.where(asking, -1, -1).astype(jnp.int32),  # varies over what `asking` does
    )
    return jax.lax.while_loop(lambda search: search.is_growing & (search.steps < mdp.num_states), step, start)


def _everybody(mdp: MDP, experts, accepted, asking) -> _Search:
    """The end of a search that takes all, wherever they are."""
    everyone = jnp.where(asking[:, None], _packed(jnp.broadcast_to(experts < mdp.num_states, (1, len(experts)))), 0)
    return _Search(
        steps=jnp.int32(0),
        is_growing=jnp.asarray(False),
        within=everyone,
        asked=everyone,
        voters=everyone & accepted,
        is_waiting=asking,
        radius=jnp.ones(mdp.num_states, jnp.int32),
    )


def _successors(mdp: MDP) -> list[tuple[jax.Array | np.ndarray, jax.Array | np.ndarray]]:
    """Blocks of states, [R], and what each of these leads to, [R, D], padded with the state itself.

    Where the graph is concrete there are two: all states with no more successors than most of them have, and the few
    others with all of theirs.
    """
    if checks.is_traced(mdp.next_state, mdp.probability, mdp.allowed):
        everyone = jnp.arange(mdp.num_states)
        led_to = jnp.where(mdp.probability > 0, mdp.next_state, everyone[:, None, None])
        return [(everyone, led_to.reshape(mdp.num_states, -1))]
    adjacency = host_graph(mdp).adjacency
    counts = np.diff(adjacency.indptr)
    width = narrow_width(counts)
    blocks = [(np.arange(mdp.num_states), width), (np.flatnonzero(counts > width), int(counts.max()))]
    return [(states, _padded_rows(adjacency, states, width)) for states, width in blocks if len(states)]


def _padded_rows(adjacency, states: np.ndarray, width: int) -> np.ndarray:
    """The first `width` successors of the given states, padded with the state itself."""
    place = adjacency.indptr[states][:, None] + np.arange(width)
    is_inside = place < adjacency.indptr[states + 1][:, None]
    return np.where(is_inside, adjacency.indices[np.where(is_inside, place, 0)], states[:, None])


def _united(sets, successors) -> jax.Array:
    """Words [S, W]: each state's set and those of its successors."""
    for states, led_to in successors:

        def add(union, column):
            return union | sets[column], None

        union, _ = jax.lax.scan(add, sets[states], jnp.asarray(led_to.T), unroll=_UNROLL)
        united = union if len(states) == len(sets) else united.at[states].set(union)
    return united


def _may_vote(mdp: MDP, start: Generalization, experts) -> jax.Array:
    """Words [S, W]: the demonstrated states that take actions which the state has; one row where all have all."""
    states = np.arange(mdp.num_states if mdp.restricts_actions else 1)[:, None]
    return _packed(evidence.has_vote(mdp, start.policy, states, _clipped(mdp, experts)))


def _by_class(relation: Relation, holds: np.ndarray, experts) -> jax.Array:
    """Words [S, W]: the demonstrated states of whose class `holds` [C, C] says so beside the class of the state."""
    label = jnp.asarray(relation.label)
    columns = jnp.asarray(holds)[:, label.at[experts].get(mode="clip")]
    return _packed(columns)[label]  # by class, before there are as many rows as states


def _clipped(mdp: MDP, experts) -> jax.Array:
    """The list with some state in place of the padding."""
    return jnp.minimum(experts, mdp.num_states - 1)


def _packed(sets) -> jax.Array:
    """bool [R, E] as words [R, W]; bit b of word w is column b W + w, so that words lie side by side."""
    rows, columns = np.shape(sets)
    words = -(-columns // 32)
    bits = jnp.pad(sets, ((0, 0), (0, 32 * words - columns))).reshape(rows, 32, words)
    return (bits.astype(jnp.uint32) << _SHIFTS).sum(axis=1, dtype=jnp.uint32)


def _unpacked(words, columns: int) -> jax.Array:
    """Words [R, W] as bool [R, E]."""
    bits = (words[:, None] >> _SHIFTS) & 1
    return bits.reshape(len(words), -1)[:, :columns].astype(bool)


def _count(words) -> jax.Array:
    """int32 [R]: how many there are in each set."""
    return jax.lax.population_count(words).sum(axis=1, dtype=jnp.int32)


_SHIFTS = np.arange(32, dtype=np.uint32)[:, None]
