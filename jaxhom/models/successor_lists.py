"""The successor layout: `next_state[S, A, N]` and `probability[S, A, N]` list the N successors of every pair.

Rows are padded with probability 0. Those wider than most (a restart anywhere on a track, say) would make every sweep
pay for them, so they are kept apart. The forward map reads the same numbers through their transpose, lists of
(s, a, slot) entries per s', so that derivatives reach `probability` either way.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import scipy

from jaxhom import checks
from jaxhom.models import edge_chains
from jaxhom.models.dynamics import Dynamics
from jaxhom.models.edge_chains import ActionChains, Edges, OneLane, PolicyChain
from jaxhom.models.list_sizes import ListSizes, rounded_count, rounded_width
from jaxhom.models.padded_rows import MAX_UNROLLED_ACTIONS, PaddedRows, gather_sum, narrow_width, pad_rows

if TYPE_CHECKING:
    from jax.typing import DTypeLike
    from jaxtyping import Array, Bool, Float, Int


class SuccessorLists(Dynamics):
    """T as lists of successors. Build it with `SuccessorLists.from_host`.

    Attributes:
      wide_pairs: int32 [J], flat (s, a) indices of the pairs with successors beyond the narrow width; then S A, since J
        is rounded up (`list_sizes`).
      wide_successors: int32 [N], the successors of all these pairs, if they are the same (restarts); else None.
      predecessors: per state s', the flat (s, a, slot) entries that lead to it.
      edges: the graph's edges, for the chains of policies.
      narrow_width: slots that every sweep reads for every pair.
    """

    layout: ClassVar[str] = "successors"

    wide_pairs: Int[Array, " J"]
    wide_successors: Int[Array, " N"] | None
    predecessors: PaddedRows
    edges: Edges
    narrow_width: int = dataclasses.field(metadata={"static": True})

    @classmethod
    def from_host(
        cls, next_state: Int[np.ndarray, "S A N"], probability: Float[np.ndarray, "S A N"], dtype: DTypeLike
    ) -> SuccessorLists:
        """The lists, with what the maps look up in them; rows ascend and repeat no successor."""
        index = _index_lists(next_state, probability > 0, None)
        return cls(probability=checks.to_device(probability, dtype), **index)

    @property
    def sizes(self) -> ListSizes:
        """The sizes of the arrays."""
        return ListSizes(
            slots=self.probability.shape[-1],
            narrow_width=self.narrow_width,
            wide_pairs=len(self.wide_pairs),
            shares_successors=self.wide_successors is not None,
            predecessors=self.predecessors.size,
            edges=len(self.edges.source),
            outgoing=self.edges.outgoing.size,
            incoming=self.edges.incoming.size,
        )

    def in_sizes(self, sizes: ListSizes) -> SuccessorLists:
        """The same transitions in arrays of other sizes, large enough; on the host, but for the probabilities."""
        if sizes == self.sizes:
            return self
        padding = ((0, 0), (0, 0), (0, sizes.slots - self.probability.shape[-1]))
        next_state, used = np.pad(np.asarray(self.next_state), padding), np.pad(self.known_slots(), padding)
        traced = checks.is_traced(self.probability)
        probability = jnp.pad(self.probability, padding) if traced else np.pad(np.asarray(self.probability), padding)
        return type(self)(probability=checks.to_device(probability), **_index_lists(next_state, used, sizes))

    @property
    def transition(self) -> Float[Array, "S A S"]:
        """The dense tensor T, made anew at each call: mind its size."""
        states, actions, _ = self.probability.shape
        checks.require_dense("the dense tensor of this model", states, actions, states)
        s, a = jnp.ogrid[:states, :actions]
        zeros = jnp.zeros((states, actions, states), self.probability.dtype)
        return zeros.at[s[..., None], a[..., None], self.next_state].add(self.probability)

    def expected_next_value(self, value: Float[Array, "S *B"]) -> Float[Array, "S A *B"]:
        """The backward map: E[value(s') | s, a]."""
        if self.probability.shape[1] > MAX_UNROLLED_ACTIONS:
            return gather_sum(*self._narrow_rows(value))
        return jnp.stack(self.expected_next_values(value), axis=1)

    def expected_next_values(self, value: Float[Array, "S *B"]) -> list[Float[Array, "S *B"]]:
        """The backward map action by action: a list of A arrays."""
        if value.ndim == 2 and value.shape[1] == 1:  # gathers of single numbers, not of rows of one
            return [expected[:, None] for expected in self.expected_next_values(value[:, 0])]
        index, weight, value = self._narrow_rows(value)
        return [gather_sum(index[:, a], weight[:, a], value) for a in range(index.shape[1])]

    def push_forward(self, occupancy: Float[Array, "S A *B"]) -> Float[Array, "S *B"]:
        """The forward map: sum_{s, a} x(s, a) T(s, a, s')."""
        if occupancy.ndim == 3 and occupancy.shape[2] == 1:
            return self.push_forward(occupancy[..., 0])[:, None]
        rows, slots = self.predecessors, self.probability.shape[-1]
        flat = occupancy.reshape((-1, *occupancy.shape[2:]))
        entries = jnp.append(self.probability.ravel(), jnp.zeros((), self.probability.dtype))  # the sentinel's 0

        def pull(entry):
            pair = jnp.minimum(entry // slots, flat.shape[0] - 1)
            return gather_sum(pair, entries[entry], flat)

        pushed = pull(rows.narrow)
        if rows.wide_row.size:
            pushed = pushed.at[rows.wide_row].add(pull(rows.wide))
        return pushed

    def state_transition(self, policy: Float[Array, "S A"]) -> Float[Array, "S S"]:
        """P_pi as a dense matrix."""
        checks.require_dense("the dense matrix of a policy's chain", len(policy), len(policy))
        weight = policy[..., None] * self.probability
        rows = jnp.broadcast_to(jnp.arange(len(weight))[:, None, None], weight.shape)
        zeros = jnp.zeros((len(weight), len(weight)), weight.dtype)
        return zeros.at[rows, self.next_state].add(weight)

    def chain(self, policy: Float[Array, "S A *B"]) -> PolicyChain | OneLane:
        """P_pi for loops that apply it many times, as weights on the edges of the graph."""
        if policy.ndim == 3 and policy.shape[2] == 1:  # gathers of single numbers, not of rows of one
            return OneLane(chain=self.chain(policy[..., 0]))
        return edge_chains.policy_chain(self.edges, self.probability, policy)

    def action_chains(self) -> ActionChains | None:
        """All actions' chains, where actions share enough successors for weights on edges to pay."""
        if not edge_chains.saves_gathers(self.edges, self.narrow_width):
            return None
        return edge_chains.action_chains(self.edges, self.probability)

    def host_matrix(self, numbers: Float[np.ndarray, "S A N"]) -> scipy.sparse.csr_array:
        """Numbers [S, A, N], of which those above 0 count, as a sparse matrix [S A, S]."""
        num_states, _, slots = self.probability.shape
        rows = numbers.reshape(-1, slots)
        is_entry = rows > 0
        counts = np.append(0, is_entry.sum(axis=1))
        successors = np.asarray(self.next_state).reshape(-1, slots)[is_entry]
        entries = (rows[is_entry], successors, np.cumsum(counts))
        return scipy.sparse.csr_array(entries, shape=(len(rows), num_states))

    def leads(
        self, state: Int[np.ndarray, " P"], action: Int[np.ndarray, " P"], successor: Int[np.ndarray, " P"]
    ) -> Bool[np.ndarray, " P"]:
        """Whether T(s, a, s') > 0 for each of P triples; looked up among the successors of the pairs that occur."""
        probability, next_state = np.asarray(self.probability), np.asarray(self.next_state)
        num_states, num_actions, slots = probability.shape
        pairs, row = np.unique(state.astype(np.int64) * num_actions + action, return_inverse=True)
        listed = probability.reshape(-1, slots)[pairs] > 0
        successors = next_state.reshape(-1, slots)[pairs].astype(np.int64)
        known = (np.arange(len(pairs))[:, None] * num_states + successors)[listed]  # ascending, as successors are
        wanted = row * num_states + successor
        place = np.minimum(np.searchsorted(known, wanted), len(known) - 1)
        return known[place] == wanted

    def open_slots(self) -> Bool[np.ndarray, "S A N"]:
        """The slots that hold a successor: others are not searched for again."""
        return np.asarray(self.probability) > 0

    @property
    def longest_sum(self) -> int:
        """A narrow row of predecessors, and all pieces of wide ones."""
        return self.predecessors.narrow.shape[1] + sum(self.predecessors.wide.shape)

    def known_slots(self) -> Bool[np.ndarray, "S A N"] | None:
        """The slots that lead somewhere by the lists of predecessors, which do not change with the probabilities."""
        if checks.is_traced(self.next_state, self.predecessors):
            return None
        lists = (np.asarray(self.predecessors.narrow).ravel(), np.asarray(self.predecessors.wide).ravel())
        known = np.zeros(self.probability.size + 1, bool)  # the last one is the padding's
        known[np.concatenate(lists)] = True
        return known[:-1].reshape(self.probability.shape)

    def _narrow_rows(self, value) -> tuple[Int[Array, "S A W"], Float[Array, "S A W"], Float[Array, "S+J *B"]]:
        """Indices and weights, and the values that they read: E[value(s') | s, a] is their `gather_sum`."""
        width, (num_states, num_actions, slots) = self.narrow_width, self.next_state.shape
        index, weight = self.next_state[..., :width], self.probability[..., :width]
        if self.wide_pairs.size:
            # A wide row's expectation is computed beside the states' values and looked up like one more state.
            real = jnp.minimum(self.wide_pairs, num_states * num_actions - 1)  # nobody reads what padding leads to
            wide = self.probability.reshape(-1, slots)[real]
            if self.wide_successors is None:
                expectation = gather_sum(self.next_state.reshape(-1, slots)[real], wide, value)
            else:
                expectation = wide @ value[self.wide_successors]
            lookup = num_states + jnp.arange(self.wide_pairs.size, dtype=index.dtype)
            first = jnp.arange(width) == 0
            index = _replace_pairs(index, self.wide_pairs, jnp.where(first, lookup[:, None], 0))
            weight = _replace_pairs(weight, self.wide_pairs, first.astype(weight.dtype))
            value = jnp.concatenate([value, expectation])
        return index, weight, value


def _replace_pairs(rows: Array, pairs: Int[Array, " J"], replacement: Array) -> Array:
    """`rows` [S, A, W] with those of the given flat pairs exchanged; there is no pair S A, the padding's."""
    return rows.reshape(-1, rows.shape[-1]).at[pairs].set(replacement, mode="drop").reshape(rows.shape)


def _index_lists(
    next_state: Int[np.ndarray, "S A N"], used: Bool[np.ndarray, "S A N"], sizes: ListSizes | None
) -> dict[str, Any]:
    """All fields of `SuccessorLists` but the probabilities, in the given sizes or, if None, in those of the model."""
    num_states, _, slots = next_state.shape
    counts, (entry,) = used.sum(axis=-1).ravel(), np.nonzero(used.ravel())
    width = min(rounded_width(narrow_width(counts)), slots) if sizes is None else sizes.narrow_width
    pairs = np.flatnonzero(counts > width)
    lists = next_state.reshape(-1, slots)[pairs]
    is_shared = len(lists) > 0 and bool((lists == lists[0]).all())
    if sizes is None:
        num_wide = rounded_count(len(pairs), counts.size * width // slots)
    else:
        num_wide, is_shared = sizes.wide_pairs, sizes.shares_successors
    wide_pairs = np.full(num_wide, counts.size, np.int32)
    wide_pairs[: len(pairs)] = pairs
    shared = (lists[0] if len(lists) else np.zeros(slots)).astype(np.int32) if is_shared else None
    rows = None if sizes is None else sizes.predecessors
    predecessors = pad_rows(entry, next_state.ravel()[entry], num_states, next_state.size, rows)
    edges = edge_chains.find_edges(next_state, used, sizes)
    return {
        "next_state": checks.to_device(next_state, jnp.int32),
        "wide_pairs": checks.to_device(wide_pairs),
        "wide_successors": None if shared is None else checks.to_device(shared),
        "predecessors": jax.tree.map(checks.to_device, predecessors),
        "edges": jax.tree.map(checks.to_device, edges),
        "narrow_width": width,
    }
