"""Who votes: the demonstrated states that Algorithm 1 and k-NN find around every other state.

Algorithm 1 of Boularias and Chaib-draa 2010 grows the set s^t of states within t steps of an unvisited state s; at
the first t at which s^t holds demonstrated states that have a vote there, these vote. In k-NN by steps all have one,
k-NN by Euclidean distance takes the nearest. On the host; `votes_in_program` does the same where something is traced.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jaxhom.generalization import evidence
from jaxhom.models.graph import reachable_within
from jaxhom.models.mdp import MDP, deciding_states
from jaxhom.solvers.arrays import module_of

if TYPE_CHECKING:
    from jaxtyping import Array

_CHUNK_BYTES = 64 * 2**20  # of distances at a time
Ballots = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""The votes [P, A] of demonstrated states [P] in states [P]; zero where one has none."""
_TIE = 1e-9  # relative difference of two squares that the rounding of any coordinates may have made
_NEVER_ROUNDING = 1e-3  # of a distance: more than that is rounded up, however far it is
_FARTHEST = 2.0**31 - 128.0  # a radius that int32 and float32 hold


class Votes(NamedTuple):
    """What was voted for: policy [S, A], and radius and support, int [S], as in `Generalization`."""

    policy: np.ndarray
    radius: np.ndarray
    support: np.ndarray


def policies_that_count(mdp: MDP, visited, policy) -> Ballots:
    """The expert's `policy` [S, A] in the demonstrated states that decide, whoever asks."""
    rows = np.where(deciding_states(mdp, visited)[:, None], policy, 0.0)
    return lambda states, experts: rows[experts]


def plain_ballots(mdp: MDP, visited, policy) -> Ballots:
    """The same, as far as the states that ask have the actions: all demonstrated states that have a vote."""
    policies = policies_that_count(mdp, visited, policy)
    return lambda states, experts: evidence.allowed_part(mdp, states, policies(states, experts))


def vote_of_rings(mdp: MDP, visited, policy, asking, ballots: Ballots, least: int = 1) -> Votes:
    """Grows s^t for every s that asks until demonstrated states in it have votes; all of these in it vote.

    Args:
      mdp: the model.
      visited: bool [S], the demonstrated states.
      policy: [S, A], what states keep for which nothing is found.
      asking: bool [S], the states to ask for.
      ballots: the votes [P, A] of demonstrated states [P] in states [P]; asked once about every pair that a ring brings
        together.
      least: grow s^t until it holds so many voters, or does not grow any more.
    """
    found = no_votes(visited, policy)
    experts, waiting = np.flatnonzero(visited), np.flatnonzero(asking)
    total, voters, radius = np.zeros(np.shape(policy)), np.zeros(len(policy), int), np.full(len(policy), -1)
    for t, ring in enumerate(_rings(mdp, experts), start=1):
        row, column = np.nonzero(ring[waiting])
        states = waiting[row]
        votes = ballots(states, experts[column])
        counts = votes.any(axis=1)
        np.add.at(total, states[counts], votes[counts])
        np.add.at(voters, states[counts], 1)
        radius[states[counts]] = t
        waiting = waiting[voters[waiting] < least]
        if not waiting.size:
            break
    return elected(found, total, voters, radius)


def vote_of_all(visited, policy, asking, ballots: Ballots, group: np.ndarray | None = None) -> Votes:
    """All demonstrated states that have votes vote, wherever they are; the radius is 1.

    Args:
      visited, policy, asking, ballots: as in `vote_of_rings`.
      group: int [S], the same for states for which all ballots are the same; asked once for each.
    """
    found = no_votes(visited, policy)
    experts, states = np.flatnonzero(visited), np.flatnonzero(asking)
    _, first, where = np.unique((states if group is None else group[states]), return_index=True, return_inverse=True)
    different, num_actions = states[first], np.shape(policy)[1]
    total, voters = np.zeros((len(different), num_actions)), np.zeros(len(different), int)
    most = max(1, _CHUNK_BYTES // (8 * num_actions * max(len(experts), 1)))
    for part in np.split(np.arange(len(different)), range(most, len(different), most)):
        votes = ballots(np.repeat(different[part], len(experts)), np.tile(experts, len(part)))
        votes = votes.reshape(len(part), len(experts), num_actions)
        total[part], voters[part] = votes.sum(axis=1), votes.any(axis=2).sum(axis=1)
    everywhere = np.zeros(np.shape(policy)), np.zeros(len(policy), int)
    for place, numbers in zip(everywhere, (total, voters), strict=True):
        place[states] = numbers[where]
    return elected(found, *everywhere, np.ones(len(policy), int))


def elected(found: Votes, total, voters, radius) -> Votes:
    """The votes `found` with those of the states that got any; `total` [S, A], the rest [S]."""
    is_found = voters > 0
    found.policy[is_found] = total[is_found] / total[is_found].sum(axis=1, keepdims=True)
    found.radius[is_found], found.support[is_found] = radius[is_found], voters[is_found]
    return found


def vote_of_nearest(visited, policy, coordinates: np.ndarray, accept=None) -> Votes:
    """The demonstrated states at the least Euclidean distance in `coordinates` [S, D], ties included.

    `accept(asking, experts)` says which pairs count, bool; all do if None.
    """
    found = no_votes(visited, policy)
    experts, waiting = np.flatnonzero(visited), np.flatnonzero(~visited)
    if not experts.size:
        return found
    chunk = max(1, _CHUNK_BYTES // (8 * coordinates[experts].size))
    for states in np.split(waiting, range(chunk, len(waiting), chunk)):
        square = square_distances(coordinates[states].astype(float), coordinates[experts])
        if accept is not None:
            pairs = (array.ravel() for array in np.broadcast_arrays(states[:, None], experts))
            square = np.where(accept(*pairs).reshape(square.shape), square, np.inf)
        is_found = np.isfinite(square.min(axis=1))
        states, square = states[is_found], square[is_found]
        votes_for, found.radius[states] = nearest(square, coordinates)
        found.support[states] = votes_for.sum(axis=1)
        found.policy[states] = votes_for @ policy[experts] / found.support[states, None]
    return found


def square_distances(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    """[N, D], [E, D] -> [N, E]."""
    return ((points[:, None] - others) ** 2).sum(axis=-1)


def nearest(square: Array, coordinates: Array) -> tuple[Array, Array]:
    """Which are at the least distance of their row, and that distance, rounded up; in NumPy or JAX.

    Args:
      square: [N, E], squares of distances; infinite where a pair does not count.
      coordinates: [S, D], which may have been rounded: 5e6 + 0.1 is not known to the last digit of 0.1.

    Returns:
      (bool [N, E], radius [N], a whole number of at least 1 that int32 holds).
    """
    numpy, limits = module_of(square), np.finfo(coordinates.dtype)
    least = square.min(axis=1)
    distance, rounding = numpy.sqrt(least), np.sqrt(coordinates.shape[1]) * limits.eps * numpy.abs(coordinates).max()
    tie = _TIE + 4.0 * (limits.eps + rounding / numpy.sqrt(numpy.maximum(least, limits.tiny)))
    is_nearest = (square <= (least * (1.0 + tie))[:, None]) & numpy.isfinite(square)
    radius = numpy.ceil(distance - numpy.minimum(tie * distance, _NEVER_ROUNDING))
    return is_nearest, numpy.clip(radius, 1.0, _FARTHEST)


def no_votes(visited, policy) -> Votes:
    """Demonstrated states with what was seen there, and nothing for the others."""
    radius = np.where(visited, 0, -1).astype(np.int32)
    return Votes(np.array(policy), radius, np.array(visited).astype(np.int32))


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
