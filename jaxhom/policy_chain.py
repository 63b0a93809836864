"""The Markov chain that a policy makes of a model: products with P_pi(s, s') = sum_a pi(s, a) T(s, a, s').

The edges s -> s' of a model's graph are the same for all policies, and mostly shared by the actions of a state: a
gridworld has 16 entries (s, a, s') per state but 4 edges. Weights on the edges are made once per policy, and each
product then reads these alone, forward and backward.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom.padded_rows import PaddedRows, pad_rows, sum_rows


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Edges:
    """The graph of a model in the successor layout.

    Attributes:
      source, target: int32 [E], the states that each edge links, in ascending order.
      entry: int32 [E, A], the flat (s, a, slot) entry of `probability` that action a contributes to the edge; S A N
        where it contributes nothing.
      outgoing: the edges of every state s; E as sentinel. incoming: those of every s'.
    """

    source: jax.Array
    target: jax.Array
    entry: jax.Array
    outgoing: PaddedRows
    incoming: PaddedRows


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PolicyChain:
    """P_pi of one policy, or of B with weights that have a trailing axis [B]."""

    successor: PaddedRows
    successor_weight: PaddedRows
    predecessor: PaddedRows
    predecessor_weight: PaddedRows

    def expected_next_value(self, value: jax.Array) -> jax.Array:
        """P_pi v, [S] -> [S] or [S, B] -> [S, B]."""
        return sum_rows(self.successor, self.successor_weight, value)

    def push_forward(self, occupancy: jax.Array) -> jax.Array:
        """P_pi^T mu, [S] -> [S] or [S, B] -> [S, B]."""
        return sum_rows(self.predecessor, self.predecessor_weight, occupancy)


def find_edges(next_state: np.ndarray, probability: np.ndarray) -> Edges:
    """The edges of successors [S, A, N] without repetitions in a row."""
    num_states, num_actions, slots = next_state.shape
    used = np.flatnonzero(probability > 0)
    pair = used // slots
    key = (pair // num_actions) * num_states + next_state.ravel()[used]
    keys, edge = np.unique(key, return_inverse=True)
    source, target = np.divmod(keys, num_states)
    entry = np.full((len(keys), num_actions), next_state.size, np.int32)
    entry[edge, pair % num_actions] = used
    number = np.arange(len(keys))
    return Edges(
        source=source.astype(np.int32),
        target=target.astype(np.int32),
        entry=entry,
        outgoing=pad_rows(number, source, num_states, len(keys)),
        incoming=pad_rows(number, target, num_states, len(keys)),
    )


def policy_chain(edges: Edges, probability: jax.Array, policy: jax.Array) -> PolicyChain:
    """The chain of a policy [S, A], or of a batch that comes last, [S, A, B], for probabilities [S, A, N]."""
    entries = jnp.append(probability.ravel(), jnp.zeros((), probability.dtype))  # the sentinel's 0
    batch = policy.shape[2:]
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
