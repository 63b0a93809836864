"""Who votes: the demonstrated states that Algorithm 1 and k-NN find around every other state.

Algorithm 1 of Boularias and Chaib-draa 2010 grows the set s^t of states within t steps of an unvisited state s; at
the first t at which s^t holds demonstrated states that are accepted, these vote. k-NN by steps accepts them all, k-NN
by Euclidean distance takes the nearest. On the host; `votes_in_program` does the same where something is traced.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from jaxhom.models.graph import reachable_within
from jaxhom.models.mdp import MDP

_CHUNK_BYTES = 64 * 2**20  # of distances at a time
TIE = 1e-9  # relative difference of two distances that rounding may have made


class Votes(NamedTuple):
    """What was voted for: policy [S, A], and radius and support, int [S], as in `Generalization`."""

    policy: np.ndarray
    radius: np.ndarray
    support: np.ndarray


def vote_of_rings(mdp: MDP, visited, policy, asking, accept: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Votes:
    """Grows s^t for every s that asks until a demonstrated state in it is accepted; the accepted ones vote.

    Args:
      mdp: the model.
      visited: bool [S], the demonstrated states.
      policy: [S, A], the expert's frequencies on them, and what states keep for which nothing is found.
      asking: bool [S], the states to ask for, none of them demonstrated.
      accept: decides pairs (states [P], demonstrated states [P]) and is asked once about every pair that a ring
        brings together.
    """
    found = _no_votes(visited, policy)
    experts, waiting = np.flatnonzero(visited), np.flatnonzero(asking)
    for t, ring in enumerate(_rings(mdp, experts), start=1):
        row, column = np.nonzero(ring[waiting])
        accepted = accept(waiting[row], experts[column])
        row, column = row[accepted], column[accepted]
        votes = np.zeros((len(waiting), mdp.num_actions), policy.dtype)
        np.add.at(votes, row, policy[experts[column]])
        voters = np.bincount(row, minlength=len(waiting))
        is_found = voters > 0
        states = waiting[is_found]
        found.policy[states] = votes[is_found] / votes[is_found].sum(axis=1, keepdims=True)
        found.radius[states], found.support[states] = t, voters[is_found]
        waiting = waiting[~is_found]
        if not waiting.size:
            break
    return found


def vote_of_nearest(visited, policy, coordinates: np.ndarray, accept=None) -> Votes:
    """The demonstrated states at the least Euclidean distance in `coordinates` [S, D], ties included.

    `accept` decides pairs as in `vote_of_rings`; all are accepted if None.
    """
    found = _no_votes(visited, policy)
    experts, waiting = np.flatnonzero(visited), np.flatnonzero(~visited)
    if not experts.size:
        return found
    chunk = max(1, _CHUNK_BYTES // (8 * coordinates[experts].size))
    for states in np.split(waiting, range(chunk, len(waiting), chunk)):
        square = square_distances(coordinates[states], coordinates[experts])
        if accept is not None:
            pairs = (array.ravel() for array in np.broadcast_arrays(states[:, None], experts))
            square = np.where(accept(*pairs).reshape(square.shape), square, np.inf)
        is_found = np.isfinite(square.min(axis=1))
        states, square = states[is_found], square[is_found]
        votes_for = is_nearest(square)
        found.support[states] = votes_for.sum(axis=1)
        found.policy[states] = votes_for @ policy[experts] / found.support[states, None]
        found.radius[states] = np.maximum(np.ceil(np.sqrt(square.min(axis=1)) * (1 - TIE)), 1)
    return found


def square_distances(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    """[N, D], [E, D] -> [N, E]."""
    return ((points[:, None] - others) ** 2).sum(axis=-1)


def is_nearest(square: np.ndarray, tie: float = TIE) -> np.ndarray:
    """bool [N, E]: which are at the least distance of their row, up to rounding."""
    return square <= square.min(axis=1, keepdims=True) * (1 + tie)


def _no_votes(visited, policy) -> Votes:
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
