"""Pairs of states inside programs: their local models by indices that are found beforehand, and their bounds.

What a program is compiled for is the graph of a model: which states a slot of `next_state` leads to, and which slots
hold a successor at all. From it the members of every local model, and their numbers there, are found on the host.
Probabilities, allowed actions and the states themselves are traced: transitions are gathered by the indices.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

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


class TracedStates(NamedTuple):
    """One side of the pairs.

    Attributes:
      mdp: the model.
      states: int [P].
      labels: [S, A, L] or None.
      graph_of: the model whose graph counts, `mdp` itself or a concrete one of the same shape.
      name: of the states.
    """

    mdp: MDP
    states: jax.Array | np.ndarray
    labels: jax.Array | np.ndarray | None
    graph_of: MDP
    name: str


def brackets_in_program(
    source: TracedStates, target: TracedStates, goal: Goal, *, distance: int, anchored: bool, name: str
) -> LocalSimilarity:
    """As `SimilarityTable.brackets`, of JAX arrays, where the models' arrays or the states are traced.

    Args:
      source, target: of one model or of two.
      goal: what to settle for; "auto" is PDHG.
      distance, anchored: as in `local_similarity`.
      name: of the public function.

    Raises:
      ValueError: if a graph is traced, states do not fit, or there are too many indices.
    """
    checks.require_count("distance", distance)
    source, target = (side._replace(states=_checked_states(side)) for side in (source, target))
    fits = len(source.states) == len(target.states)
    checks.require_shape(target.name, target.states, str(source.states.shape), fits)
    has_refused = source.mdp.restricts_actions or target.mdp.restricts_actions
    transitions, labels, sizes = [], [], []
    for side in (source, target):
        graph, next_state, is_open = _concrete_graph(side.graph_of)
        is_traced = checks.is_traced(side.states)
        everyone = np.arange(side.mdp.num_states) if is_traced else np.unique(side.states)
        indices = local_indices(graph, next_state, is_open, everyone, distance)
        which = side.states if is_traced else np.searchsorted(everyone, side.states)
        transitions.append(_gathered(side.mdp, indices, which))
        labels.append(_gathered_labels(side, jnp.asarray(indices.members)[which], has_refused))
        sizes.append(jnp.asarray(indices.size)[which])
    if goal.method == "auto":
        goal = goal._replace(method="pdhg")
    models = *transitions, () if labels[0] is None else tuple(labels)
    found = differentiable_bounds(models, tuple(sizes), goal, anchored, name)
    return found.replace(lower=not_negative(found.lower))


def _gathered(mdp: MDP, indices: LocalIndices, which) -> jax.Array:
    """Transitions [P, n, A, n] of the given ones of the local models."""
    members, successor = jnp.asarray(indices.members)[which], jnp.asarray(indices.successor)[which]
    allowed = jnp.asarray(mdp.allowed)[members]  # padding reads the last state, whose numbers go nowhere
    weight = jnp.where(allowed[..., None], mdp.probability[members], 0.0)
    count, n, num_actions, _ = successor.shape
    p, i, a = np.ogrid[:count, :n, :num_actions]
    zeros = jnp.zeros((count, n, num_actions, n), mdp.dtype)
    return zeros.at[p[..., None], i[..., None], a[..., None], successor].add(weight, mode="drop")


def _gathered_labels(side: TracedStates, members: jax.Array, has_refused: bool) -> jax.Array | None:
    """Labels [P, n, A, L] of members [P, n]: those that were given, and last the one of actions not allowed."""
    parts = [] if side.labels is None else [jnp.asarray(side.labels, side.mdp.dtype)]
    if has_refused:
        parts.append(~jnp.asarray(side.mdp.allowed)[..., None])
    if not parts:
        return None
    labels = jnp.concatenate([part.astype(side.mdp.dtype) for part in parts], axis=2)
    return jnp.where((members >= 0)[..., None, None], labels[members], 0.0)


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


def _checked_states(side: TracedStates):
    """States [P], NumPy where they are concrete."""
    mdp, states, name = side.mdp, side.states, side.name
    if not checks.is_traced(states):
        return check_states(mdp, states, name)
    checks.require_shape(name, states, "[P]", states.ndim == 1)
    if not jnp.issubdtype(states.dtype, jnp.integer):
        raise ValueError(f"{name} must hold integers, got dtype {states.dtype}")
    return states
