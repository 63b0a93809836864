"""A model as its transitions of positive probability, on the host: what searches of its graph and local models read.

The layouts of `MDP` give every state and action the room of the widest: a single state with thousands of successors
makes them as large as a dense tensor. Here each state has as many entries as it has transitions.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import numpy as np
import scipy

from jaxhom import checks
from jaxhom.models.mdp import MDP

if TYPE_CHECKING:
    from jaxtyping import Float, Int

_MEMORY = "_host_graph"  # under which an instance of a model keeps its graph: no field, and so in no pytree


class HostGraph:
    """The E transitions of an MDP, by state, then by action.

    Attributes:
      start: int64 [S + 1], state s has the entries start[s] ... start[s + 1] - 1.
      action: int32 [E].
      successor: int32 [E].
      probability: float [E], positive.
      refused: bool [S, A], the actions that a state lacks; None where every state has all.
    """

    def __init__(self, mdp: MDP) -> None:
        self.num_states, self.num_actions, slots = mdp.next_state.shape
        self.dtype = mdp.dtype
        probability, next_state = np.asarray(mdp.probability), np.asarray(mdp.next_state)
        entry = np.flatnonzero(probability > 0)
        self.start = np.searchsorted(entry, np.arange(self.num_states + 1, dtype=np.int64) * self.num_actions * slots)
        self.action = (entry // slots % self.num_actions).astype(np.int32)
        self.successor = next_state.ravel()[entry]
        self.probability = probability.ravel()[entry]
        self.refused = ~np.asarray(mdp.allowed) if mdp.restricts_actions else None

    @functools.cached_property
    def num_entries(self) -> Int[np.ndarray, " S"]:
        """How many transitions each state has."""
        return np.diff(self.start)

    @functools.cached_property
    def adjacency(self) -> scipy.sparse.csr_array:
        """Boolean [S, S]: which states one step by any action, or none, leads to."""
        everyone = np.arange(self.num_states, dtype=np.int32)
        index = (np.append(np.repeat(everyone, self.num_entries), everyone), np.append(self.successor, everyone))
        # Actions that lead to the same state are added up: there may be more of them than a byte counts.
        counts = scipy.sparse.coo_array((np.ones(len(index[0]), np.int32), index), shape=(self.num_states,) * 2)
        return counts.tocsr().astype(bool)

    def reach(self, states: Int[np.ndarray, " P"], steps: int) -> scipy.sparse.csr_array:
        """Boolean [P, S], sorted: row p marks the states within `steps` steps of states[p], itself included."""
        states = np.asarray(states, np.int64)
        ones, first = np.ones(len(states), bool), np.arange(len(states) + 1)
        rows = scipy.sparse.csr_array((ones, states, first), shape=(len(states), self.num_states))
        for _ in range(steps):
            known = rows.nnz
            rows = rows @ self.adjacency  # of booleans: "or", which does not overflow
            if rows.nnz == known:
                break  # everything that can be reached
        rows.sort_indices()
        return rows

    def entries_of(self, states: Int[np.ndarray, " P"]) -> tuple[Int[np.ndarray, " T"], Int[np.ndarray, " T"]]:
        """The transitions of P states, one state after the other: which of the P each belongs to, and its number."""
        counts = self.num_entries[states]
        owner = np.repeat(np.arange(len(states), dtype=np.int64), counts)
        shift = self.start[states] - (np.cumsum(counts) - counts)
        return owner, np.arange(len(owner), dtype=np.int64) + shift[owner]


def host_graph(mdp: MDP) -> HostGraph:
    """The graph of a model, made at the first call and remembered by this instance for the next ones.

    It belongs to the instance: what `replace`, `jit`, `vmap` and `jax.tree.map` return, and what comes out of a pickle,
    makes its own. It may be read by several threads; where two ask first at the same time, both get the same one.

    Args:
      mdp: the model.

    Returns:
      Its `HostGraph`, not to be changed.

    Raises:
      ValueError: if the transitions are traced. Features, discount and initial distribution may be.

    Example:
      >>> from jaxhom import gridworld
      >>> mdp = gridworld(4).mdp
      >>> host_graph(mdp) is host_graph(mdp), int(host_graph(mdp).num_entries.sum())
      (True, 240)
    """
    remembered = vars(mdp).get(_MEMORY)
    if remembered is not None:
        return remembered
    if checks.is_traced(mdp.next_state, mdp.probability, mdp.allowed):
        raise ValueError(
            "the graph of a model is searched on the host: call this outside jit, vmap and grad, "
            "or close over the model there and trace what it is given beside"
        )
    return vars(mdp).setdefault(_MEMORY, HostGraph(mdp))


def reachable_within(mdp: MDP, steps: int) -> scipy.sparse.csr_array:
    """Boolean [S, S] matrix whose row s marks s^steps, the states within `steps` steps of s (s included).

    As many entries as there are such pairs of states: with a hub at most S + S^2 of them from two steps on.
    """
    return host_graph(mdp).reach(np.arange(mdp.num_states), steps)


def steps_from(mdp: MDP, state: int) -> Float[np.ndarray, " S"]:
    """Least number of steps by any actions from a state to every state; infinite where none leads."""
    return scipy.sparse.csgraph.dijkstra(host_graph(mdp).adjacency, indices=state, unweighted=True)
