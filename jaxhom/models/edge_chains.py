"""Products with a model's transitions, as weights on the edges of its graph.

The edges s -> s' are the same for all policies, and mostly shared by the actions of a state: a gridworld has 16 entries
(s, a, s') per state but 4 edges. Loops therefore first make weights on the edges, and then read one number per edge:
for the Markov chain of a policy, P_pi(s, s') = sum_a pi(s, a) T(s, a, s'), forward and backward; for all actions at a
time, backward, with as many weights per edge as there are actions.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom.models.list_sizes import ListSizes, rounded_edges
from jaxhom.models.padded_rows import MAX_UNROLLED_ACTIONS, PaddedRows, gather_sum, pad_rows, row_size, sum_rows
from jaxhom.status import Record

if TYPE_CHECKING:
    from jaxtyping import Array, Bool, Float, Int


class Edges(Record):
    """The graph of a model in the successor layout.

    Attributes:
      source, target: int32 [E], the states that each edge links, in ascending order; then 0, 0 of edges to which no
        action contributes, since E is rounded up (`list_sizes`).
      entry: int32 [E, A], the flat (s, a, slot) entry of `probability` that action a contributes to the edge; S A N
        where it contributes nothing.
      outgoing: the edges of every state s; E as sentinel. incoming: those of every s'.
    """

    source: Int[Array, " E"]
    target: Int[Array, " E"]
    entry: Int[Array, "E A"]
    outgoing: PaddedRows
    incoming: PaddedRows


class PolicyChain(Record):
    """P_pi of one policy, or of B with weights that have a trailing axis [B]."""

    successor: PaddedRows
    successor_weight: PaddedRows
    predecessor: PaddedRows
    predecessor_weight: PaddedRows

    def expected_next_value(self, value: Float[Array, "S *B"]) -> Float[Array, "S *B"]:
        """P_pi v."""
        return sum_rows(self.successor, self.successor_weight, value)

    def push_forward(self, occupancy: Float[Array, "S *B"]) -> Float[Array, "S *B"]:
        """P_pi^T mu."""
        return sum_rows(self.predecessor, self.predecessor_weight, occupancy)


class OneLane(Record):
    """The chain of one policy for arrays whose trailing axis is a batch of one."""

    chain: PolicyChain

    def expected_next_value(self, value: Float[Array, "S 1"]) -> Float[Array, "S 1"]:
        """P_pi v."""
        return self.chain.expected_next_value(value[:, 0])[:, None]

    def push_forward(self, occupancy: Float[Array, "S 1"]) -> Float[Array, "S 1"]:
        """P_pi^T mu."""
        return self.chain.push_forward(occupancy[:, 0])[:, None]


class ActionChains(Record):
    """T(s, a, s') for all actions.

    Attributes:
      successor: int32 [U, S], the first U successors of every state.
      weight: [A, U, S], their probabilities under each action.
      wide_row, wide, wide_weight: int32 [J], int32 [J, V] and [A, J, V], what is beyond U; see `PaddedRows`.
    """

    successor: Int[Array, "U S"]
    weight: Float[Array, "A U S"]
    wide_row: Int[Array, " J"]
    wide: Int[Array, "J V"]
    wide_weight: Float[Array, "A J V"]

    def expected_next_values(self, value: Float[Array, "S *B"]) -> list[Float[Array, "S *B"]]:
        """A arrays E[v(s') | s, a]."""
        spread = (..., None) if value.ndim == 2 else ...
        gathered = [value[states] for states in self.successor]
        expected = [
            sum(weight[spread] * at for weight, at in zip(weights, gathered, strict=True)) for weights in self.weight
        ]
        if not self.wide_row.size:
            return expected
        beyond = [gather_sum(self.wide, weight, value) for weight in self.wide_weight]
        return [one.at[self.wide_row].add(more) for one, more in zip(expected, beyond, strict=True)]


def find_edges(
    next_state: Int[np.ndarray, "S A N"], used: Bool[np.ndarray, "S A N"], sizes: ListSizes | None = None
) -> Edges:
    """The edges of successors without repetitions in a row; on the host.

    Args:
      next_state: [S, A, N].
      used: bool [S, A, N], the slots that count.
      sizes: of the arrays, large enough; rounded up from what the model needs if None.
    """
    num_states, num_actions, slots = next_state.shape
    (entries,) = np.nonzero(used.ravel())
    pair = entries // slots
    key = (pair // num_actions) * num_states + next_state.ravel()[entries]
    keys, edge = np.unique(key, return_inverse=True)
    source, target = np.divmod(keys, num_states)
    if sizes is None:
        outgoing, incoming = (row_size(np.bincount(ends, minlength=num_states)) for ends in (source, target))
        count = rounded_edges(len(keys), num_states, outgoing)
    else:
        outgoing, incoming, count = sizes.outgoing, sizes.incoming, sizes.edges
    entry = np.full((count, num_actions), next_state.size, np.int32)
    entry[edge, pair % num_actions] = entries
    number, padding = np.arange(len(keys)), (0, count - len(keys))
    return Edges(
        source=np.pad(source.astype(np.int32), padding),
        target=np.pad(target.astype(np.int32), padding),
        entry=entry,
        outgoing=pad_rows(number, source, num_states, count, outgoing),
        incoming=pad_rows(number, target, num_states, count, incoming),
    )


def policy_chain(edges: Edges, probability: Float[Array, "S A N"], policy: Float[Array, "S A *B"]) -> PolicyChain:
    """The chain of a policy, or of a batch that comes last."""
    entries = jnp.append(probability.ravel(), jnp.zeros((), probability.dtype))  # the sentinel's 0
    batch = policy.shape[2:]
    if policy.shape[1] > MAX_UNROLLED_ACTIONS:
        weight = jnp.einsum("ea...,ea->e...", policy[edges.source], entries[edges.entry])
    else:
        weight = sum(
            policy[edges.source, a] * entries[edges.entry[:, a]].reshape(-1, *(1,) * len(batch))
            for a in range(policy.shape[1])
        )
    weight = jnp.concatenate([weight, jnp.zeros((1, *batch), weight.dtype)])
    source, target = (jnp.append(states, 0) for states in (edges.source, edges.target))
    return PolicyChain(
        successor=edges.outgoing.lookup(target),
        successor_weight=edges.outgoing.lookup(weight),
        predecessor=edges.incoming.lookup(source),
        predecessor_weight=edges.incoming.lookup(weight),
    )


def action_chains(edges: Edges, probability: Float[Array, "S A N"]) -> ActionChains:
    """The chains of all actions."""
    entries = jnp.append(probability.ravel(), jnp.zeros((), probability.dtype))
    num_actions = edges.entry.shape[1]
    nothing = jnp.full((1, num_actions), probability.size, edges.entry.dtype)
    weight = entries[jnp.concatenate([edges.entry, nothing])]
    rows = edges.outgoing.lookup(weight)
    target = edges.outgoing.lookup(jnp.append(edges.target, 0))
    chains = ActionChains(
        successor=target.narrow.T,
        weight=jnp.moveaxis(rows.narrow, 0, -1).swapaxes(0, 1),
        wide_row=target.wide_row,
        wide=target.wide,
        wide_weight=jnp.moveaxis(rows.wide, -1, 0),
    )
    # Without it XLA would make the weights again in every pass of the caller's loop.
    return jax.lax.optimization_barrier(chains)


def saves_gathers(edges: Edges, narrow_width: int) -> bool:
    """Whether `ActionChains` beats a pass over `narrow_width` entries per pair: it does where actions share successors.

    A gathered number costs about five times as much as a weight.
    """
    num_actions, width = edges.entry.shape[1], edges.outgoing.narrow.shape[1]
    return width * (1.0 + 0.2 * num_actions) < num_actions * narrow_width
