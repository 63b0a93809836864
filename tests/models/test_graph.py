"""The graph of a model on the host: against breadth-first search, and made once per model."""

import copy
import pickle
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxhom.domains.gridworld import gridworld
from jaxhom.models import graph
from jaxhom.models.graph import HostGraph, host_graph, reachable_within, steps_from


def breadth_first(leads, state):
    """Steps from a state to every other, by hand."""
    steps, count = np.full(len(leads), np.inf), 0
    frontier = np.arange(len(leads)) == state
    while frontier.any():
        steps[frontier] = count
        frontier = leads[frontier].any(axis=0) & np.isinf(steps)
        count += 1
    return steps


def test_steps_and_reach_are_those_of_a_breadth_first_search(case):
    mdp, leads = case.mdp, (np.asarray(case.mdp.transition) > 0).any(axis=1)
    steps = np.array([breadth_first(leads, s) for s in range(mdp.num_states)])
    np.testing.assert_array_equal([steps_from(mdp, s) for s in range(mdp.num_states)], steps)
    for most in (1, 2, mdp.num_states):
        np.testing.assert_array_equal(reachable_within(mdp, most).toarray(), steps <= most)


@pytest.fixture
def made(monkeypatch):
    """The models that a graph was made of."""
    models = []
    monkeypatch.setattr(graph, "HostGraph", lambda mdp: models.append(mdp) or HostGraph(mdp))
    return models


def test_a_graph_is_made_once(made):
    mdp = gridworld(4).mdp
    first = host_graph(mdp)
    reachable_within(mdp, 2), steps_from(mdp, 3)
    assert host_graph(mdp) is first and len(made) == 1
    assert host_graph(gridworld(4).mdp) is not first


CHANGES = {
    "replace": lambda mdp: mdp.replace(discount=0.5),
    "tree.map": lambda mdp: jax.tree.map(lambda leaf: leaf, mdp),
    "jit": jax.jit(lambda mdp: mdp),
    "pickle": lambda mdp: pickle.loads(pickle.dumps(mdp)),
    "copy": copy.copy,
}


@pytest.mark.parametrize("change", CHANGES)
def test_what_is_made_of_a_model_has_no_graph_yet(change, made):
    mdp = gridworld(3).mdp
    first, leaves = host_graph(mdp), len(jax.tree.leaves(gridworld(3).mdp))
    assert len(jax.tree.leaves(mdp)) == leaves and len(pickle.dumps(mdp)) == len(pickle.dumps(gridworld(3).mdp))
    other = host_graph(CHANGES[change](mdp))
    assert other is not first and len(made) == 2
    np.testing.assert_array_equal(other.probability, first.probability)


def test_threads_share_one():
    mdp, found, gate = gridworld(12).mdp, [], threading.Barrier(8)

    def ask():
        gate.wait()
        found.append(host_graph(mdp))

    threads = [threading.Thread(target=ask) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 8 and len(set(map(id, found))) == 1


def test_traced_transitions_are_refused_and_all_else_may_be_traced():
    mdp = gridworld(3).mdp
    with pytest.raises(ValueError, match="graph of a model is searched on the host"):
        jax.jit(lambda model: reachable_within(model, 1).nnz)(mdp)
    with pytest.raises(ValueError, match="outside jit, vmap and grad"):
        jax.grad(lambda p: steps_from(mdp.replace(probability=p), 0).sum())(mdp.probability)
    seen = []
    jax.jit(lambda discount: seen.append(host_graph(mdp.replace(discount=discount))) or discount)(jnp.asarray(0.5))
    assert seen[0].num_states == 9
