"""Votes of the nearest demonstrated states in large models: one search for all states whose ballots are the same.

`votes.vote_of_rings` keeps for every state which demonstrated states it has met, S x E bits: right whatever is asked,
and too much for a million states. Where states fall into few groups in which all ballots are the same (classes of local
models), a search goes backward from the demonstrated states that have votes in a group, layer by layer. Only the layer
at hand knows which of them are nearest: those of its successors in the layer before,

    N(s)  =  union of N(s') over the successors s' of s with d(s') = d(s) - 1.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
import scipy
from tqdm import tqdm

from jaxhom.generalization.votes import Ballots, Votes, elected, no_votes
from jaxhom.models.graph import reachable_within
from jaxhom.models.mdp import MDP

if TYPE_CHECKING:
    from jaxtyping import Int

    Layer = tuple[int, Int[np.ndarray, " L"], Int[np.ndarray, " N"], Int[np.ndarray, " N"]]

_LARGE = 1e6  # states times demonstrated states: on grids of 128 x 128 rings take 8 s, searches below a second
_PAIRS = 1_000_000  # of groups and demonstrated states to ask for at a time
_SHARED = 8  # states per group, on average: where hardly two are alike, rings ask for fewer ballots
_MOST_WORK = 1e9  # states times searches


def are_searched(num_states: int, num_experts: int, group: Int[np.ndarray, " S"]) -> bool:
    """Whether searches by groups take less time than rings around every state, as far as can be told beforehand."""
    is_large = float(num_states) * num_experts >= _LARGE
    return is_large and _SHARED * len(np.unique(group)) <= num_states


def vote_of_nearest_by_group(
    mdp: MDP, visited, policy, asking, ballots: Ballots, group: Int[np.ndarray, " S"], progress: bool = False
) -> Votes | None:
    """What `votes.vote_of_rings` with `least=1` finds; None where it would take too many searches.

    Args:
      mdp, visited, policy, asking: as there.
      ballots: as there; asked for one state of each group about all demonstrated states.
      group: int [S], the same for states for which all ballots are the same.
      progress: show a bar over the states that ask.
    """
    found, experts = no_votes(visited, policy), np.flatnonzero(visited)
    total, voters, radius = np.zeros(np.shape(policy)), np.zeros(len(policy), int), np.full(len(policy), -1)
    forward = _Links(reachable_within(mdp, 1))
    backward = _Links(scipy.sparse.csr_array(forward.matrix.T))
    electorates = _electorates(asking, ballots, group, experts)
    if len(electorates) * float(len(policy)) > _MOST_WORK:
        return None
    count = sum(len(members) for members, *_ in electorates)
    with tqdm(total=count, desc="votes", unit=" states", leave=False, disable=not progress) as bar:
        for members, voting, votes in electorates:
            for t, states, row, voter in _nearest(forward, backward, voting, members):
                total[states] = np.add.reduceat(votes[voter], _first_places(row, len(states)), axis=0)
                voters[states], radius[states] = np.bincount(row), t
                bar.update(len(states))
    return elected(found, total, voters, radius)


def _electorates(asking, ballots: Ballots, group, experts) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """The states that ask by who votes in them and how: states, the voters [V], their votes [V, A].

    Groups are asked for many at a time; those with the same ballots are searched for together, those without any never.
    """
    states = np.flatnonzero(asking)
    _, first, number = np.unique(group[states], return_index=True, return_inverse=True)
    electorates, of_group = {}, np.full(len(first), -1)
    for begin in range(0, len(first), at_once := max(1, _PAIRS // len(experts))):
        some = states[first[begin : begin + at_once]]
        votes = ballots(np.repeat(some, len(experts)), np.tile(experts, len(some)))
        votes = votes.reshape(len(some), len(experts), -1)
        having = votes.any(axis=2)
        for row in np.flatnonzero(having.any(axis=1)):
            voting = np.flatnonzero(having[row])
            key = voting.tobytes(), votes[row, voting].tobytes()
            place, *_ = electorates.setdefault(key, (len(electorates), experts[voting], votes[row, voting]))
            of_group[begin + row] = place
    electorate = of_group[number]
    return [(states[electorate == place], voting, votes) for place, voting, votes in electorates.values()]


class _Links:
    """The rows of a sparse matrix, to look up some of them at a time."""

    def __init__(self, matrix: scipy.sparse.csr_array) -> None:
        self.matrix, self._first, self._count = matrix, matrix.indptr[:-1].astype(np.int64), np.diff(matrix.indptr)

    def __call__(self, rows: Int[np.ndarray, " L"]) -> tuple[np.ndarray, np.ndarray]:
        """The entries of some rows, one row after the other: which of the rows each belongs to, and its column."""
        count = self._count[rows]
        owner = np.repeat(np.arange(len(rows)), count)
        shift = self._first[rows] - np.cumsum(count) + count
        return owner, self.matrix.indices[np.arange(len(owner)) + shift[owner]]


def _nearest(
    forward: _Links, backward: _Links, sources: Int[np.ndarray, " E"], asking: Int[np.ndarray, " M"]
) -> Iterator[Layer]:
    """Of the states that ask and from which a source is t = 1, 2, ... steps away, where there are any: t, these states,
    and pairs (number among these, number of a nearest source)."""
    wanted = np.zeros(forward.matrix.shape[0], bool)
    wanted[asking] = True
    layers, layer_of = _layers(backward, sources, wanted)
    place = np.zeros(len(wanted), np.int32)
    place[sources], nearest = np.arange(len(sources)), _own_bits(len(sources))
    for t, (states, owner, following) in _ways(forward, layers, layer_of, wanted):
        nearest = np.bitwise_or.reduceat(nearest[place[following]], _first_places(owner, len(states)), axis=0)
        place[states] = np.arange(len(states))
        shown = np.flatnonzero(wanted[states])
        if len(shown):
            yield t, states[shown], *_pairs(nearest[shown])


def _layers(backward: _Links, sources, wanted) -> tuple[list[np.ndarray], Int[np.ndarray, " S"]]:
    """The states at t = 0, 1, ... steps from the sources until all that is wanted is met, or all that can be; and the
    number of each state's layer, or -1."""
    layer_of, scratch = np.full(len(wanted), -1, np.int32), np.zeros(len(wanted), np.int32)
    layers, left = [sources], int(wanted.sum())
    layer_of[sources] = 0
    while left:
        met = backward(layers[-1])[1]
        met = _once(met[layer_of[met] < 0], scratch)
        if not len(met):
            break
        layer_of[met] = len(layers)
        left -= int(wanted[met].sum())
        layers.append(met)
    return layers, layer_of


def _ways(forward: _Links, layers, layer_of, wanted) -> list[tuple[int, tuple[np.ndarray, np.ndarray, np.ndarray]]]:
    """Shortest ways from what is wanted to the sources, from the sources outward: t, the states of layer t on them, and
    pairs (number among these, a successor in layer t - 1)."""
    ways, scratch = [], np.zeros(len(wanted), np.int32)
    reached = layers[0][:0]
    for t in range(len(layers) - 1, 0, -1):
        states = _once(np.concatenate([layers[t][wanted[layers[t]]], reached]), scratch)
        owner, following = forward(states)
        is_near = layer_of[following] == t - 1
        owner, following = owner[is_near], following[is_near]
        reached = _once(following, scratch)
        ways.append((t, (states, owner, following)))
    return ways[::-1]


def _once(states: Int[np.ndarray, " N"], scratch: Int[np.ndarray, " S"]) -> Int[np.ndarray, " M"]:
    """The states without repetitions."""
    scratch[states] = np.arange(len(states))
    return states[scratch[states] == np.arange(len(states))]


def _first_places(owner: Int[np.ndarray, " N"], count: int) -> Int[np.ndarray, " C"]:
    """Where in a sorted list of owners each of them begins."""
    return np.searchsorted(owner, np.arange(count))


def _own_bits(count: int) -> np.ndarray:
    """uint64 [E, words]: of every source the set that holds itself."""
    numbers = np.arange(count)
    bits = np.zeros((count, max(1, -(-count // 64))), np.uint64)
    bits[numbers, numbers // 64] = np.uint64(1) << (numbers % 64).astype(np.uint64)
    return bits


def _pairs(bits: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The entries of sets [L, words]: row and number of each."""
    row, word = np.nonzero(bits)
    is_in = (bits[row, word][:, None] >> np.arange(64, dtype=np.uint64)) & np.uint64(1)
    entry, bit = np.nonzero(is_in)
    return row[entry], word[entry] * 64 + bit
