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

from jaxhom.generalization.votes import Ballots, Votes, elected, no_votes
from jaxhom.models.graph import reachable_within
from jaxhom.models.mdp import MDP

if TYPE_CHECKING:
    from jaxtyping import Bool, Int

    Layer = tuple[Int[np.ndarray, " L"], Int[np.ndarray, " N"], Int[np.ndarray, " N"]]

_LARGE = 1e6  # states times demonstrated states: on grids of 128 x 128 rings take 8 s, searches below a second
_MOST_WORK = 5e8  # states times groups


def are_searched(num_states: int, num_experts: int, group: Int[np.ndarray, " S"]) -> bool:
    """Whether searches by groups take less time than rings around every state."""
    is_large = float(num_states) * num_experts >= _LARGE
    return is_large and float(num_states) * len(np.unique(group)) <= _MOST_WORK


def vote_of_nearest_by_group(
    mdp: MDP, visited, policy, asking, ballots: Ballots, group: Int[np.ndarray, " S"]
) -> Votes:
    """What `votes.vote_of_rings` with `least=1` finds.

    Args:
      mdp, visited, policy, asking: as there.
      ballots: as there; asked for one state of each group about all demonstrated states.
      group: int [S], the same for states for which all ballots are the same.
    """
    found, experts = no_votes(visited, policy), np.flatnonzero(visited)
    total, voters, radius = np.zeros(np.shape(policy)), np.zeros(len(policy), int), np.full(len(policy), -1)
    forward = _Links(reachable_within(mdp, 1))
    backward = _Links(scipy.sparse.csr_array(forward.matrix.T))
    for number in np.unique(group[asking]):
        members = asking & (group == number)
        votes = ballots(np.full(len(experts), np.argmax(members)), experts)
        having = votes.any(axis=1)
        for t, (states, row, voter) in enumerate(_layers(forward, backward, experts[having], members), start=1):
            choice = scipy.sparse.csr_array((np.ones(len(row)), (row, voter)), shape=(len(states), having.sum()))
            total[states], voters[states] = choice @ votes[having], np.bincount(row, minlength=len(states))
            radius[states] = t
    return elected(found, total, voters, radius)


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


def _layers(
    forward: _Links, backward: _Links, sources: Int[np.ndarray, " E"], wanted: Bool[np.ndarray, " S"]
) -> Iterator[Layer]:
    """For t = 1, 2, ..., until all that is wanted or can be met is: the wanted states from which a source is t steps
    away, and pairs (number among these, number of a nearest source)."""
    num_states, left = len(wanted), int(wanted.sum())
    layer_of, place = np.full(num_states, -1, np.int32), np.zeros(num_states, np.int32)
    layer, nearest = sources, _own_bits(len(sources))
    t = 0
    while len(layer):
        layer_of[layer], place[layer] = t, np.arange(len(layer))
        if t:
            shown = np.flatnonzero(wanted[layer])
            yield layer[shown], *_pairs(nearest[shown])
            left -= len(shown)
        if not left:
            return
        before = np.unique(backward(layer)[1])
        before = before[layer_of[before] < 0]
        if not len(before):
            return
        owner, following = forward(before)
        is_near = layer_of[following] == t
        begin = np.searchsorted(owner[is_near], np.arange(len(before)))
        nearest = np.bitwise_or.reduceat(nearest[place[following[is_near]]], begin, axis=0)
        layer, t = before, t + 1


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
