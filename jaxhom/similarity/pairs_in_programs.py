"""Pairs of states inside programs: their local models by indices that are found beforehand, and their bounds.

What a program is compiled for is the graph of a model: which states a slot of `next_state` leads to, and which slots
hold a successor at all. From it the members of every local model, and their numbers there, are found on the host.
Probabilities, allowed actions and the states themselves are traced: transitions are gathered by the indices.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom import checks
from jaxhom.models.graph import HostGraph, host_graph
from jaxhom.models.inputs import check_states
from jaxhom.models.mdp import MDP
from jaxhom.similarity.bounds_in_programs import differentiable_bounds, not_negative
from jaxhom.similarity.brackets import Goal, LocalSimilarity
from jaxhom.similarity.local_models import LocalIndices, local_indices


def brackets_in_program(
    mdp: MDP, sources, targets, goal: Goal, *, graph_of: MDP, distance: int, anchored: bool, name: str
) -> LocalSimilarity:
    """As `SimilarityTable.brackets`, of JAX arrays, where the model's arrays or the states are traced.

    Args:
      mdp, sources, targets: as in `local_similarity`.
      goal: what to settle for; "auto" is PDHG.
      graph_of: the model whose graph counts, `mdp` itself or a concrete one of the same shape.
      distance, anchored: as in `local_similarity`.
      name: of the public function.

    Raises:
      ValueError: if the graph is traced, states do not fit, or there are too many indices.
    """
    checks.require_count("distance", distance)
    sources, targets = _checked_states(mdp, sources, "sources"), _checked_states(mdp, targets, "targets")
    checks.require_shape("targets", targets, str(sources.shape), len(sources) == len(targets))
    graph, next_state, is_open = _concrete_graph(graph_of)
    sides = []
    for states in (sources, targets):
        everyone = np.arange(mdp.num_states) if checks.is_traced(states) else np.unique(states)
        indices = local_indices(graph, next_state, is_open, everyone, distance)
        which = states if checks.is_traced(states) else np.searchsorted(everyone, states)
        sides.append(_gathered(mdp, indices, which))
    (source, own_labels, own_size), (target, other_labels, other_size) = sides
    labels = (own_labels, other_labels) if mdp.restricts_actions else ()
    if goal.method == "auto":
        goal = goal._replace(method="pdhg")
    found = differentiable_bounds((source, target, labels), (own_size, other_size), goal, bool(anchored), name)
    return found.replace(lower=not_negative(found.lower))


def _gathered(mdp: MDP, indices: LocalIndices, which) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Transitions [P, n, A, n], labels [P, n, A, 1] and sizes [P] of the given ones of the local models."""
    members, successor = jnp.asarray(indices.members)[which], jnp.asarray(indices.successor)[which]
    allowed = jnp.asarray(mdp.allowed)[members]  # padding reads the last state, whose numbers go nowhere
    weight = jnp.where(allowed[..., None], mdp.probability[members], 0.0)
    count, n, num_actions, _ = successor.shape
    p, i, a = np.ogrid[:count, :n, :num_actions]
    zeros = jnp.zeros((count, n, num_actions, n), mdp.dtype)
    transition = zeros.at[p[..., None], i[..., None], a[..., None], successor].add(weight, mode="drop")
    refused = (members >= 0)[..., None] & ~allowed
    return transition, refused[..., None].astype(mdp.dtype), jnp.asarray(indices.size)[which]


def _concrete_graph(mdp: MDP) -> tuple[HostGraph, np.ndarray, np.ndarray]:
    """The graph, `next_state`, and bool [S, A, N]: which of its slots hold a successor; or `ValueError`."""
    is_open = None
    if not checks.is_traced(mdp.next_state, mdp.probability):
        is_open = np.asarray(mdp.probability) > 0
    elif not mdp.is_dense:
        is_open = mdp.dynamics.known_slots()
    if is_open is None:
        raise ValueError(
            "the graph of the model is traced: close over the model and trace its arrays by mdp.replace(...), "
            "or give table=SimilarityTable(mdp); a model in the dense layout always needs the table where its "
            "probabilities are traced"
        )
    if not checks.is_traced(mdp.allowed):
        is_open &= np.asarray(mdp.allowed)[..., None]
    if not checks.is_traced(mdp.probability, mdp.allowed):
        return host_graph(mdp), np.asarray(mdp.next_state), is_open
    dynamics = mdp.dynamics.replace(probability=is_open.astype(np.float32))
    everything = {"allowed": np.ones(is_open.shape[:2], bool), "restricts_actions": False}
    skeleton = dataclasses.replace(mdp, dynamics=dynamics, **everything)
    return HostGraph(skeleton), np.asarray(mdp.next_state), is_open


def _checked_states(mdp: MDP, states, name: str):
    """States [P], NumPy where they are concrete."""
    if not checks.is_traced(states):
        return check_states(mdp, states, name)
    checks.require_shape(name, states, "[P]", states.ndim == 1)
    if not jnp.issubdtype(states.dtype, jnp.integer):
        raise ValueError(f"{name} must hold integers, got dtype {states.dtype}")
    return states
