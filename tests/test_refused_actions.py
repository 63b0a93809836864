"""Actions that some states lack, in local similarities: against HiGHS on models with a state "refused"."""

import numpy as np
import oracles
import pytest

from jaxhom import (
    MDP,
    Demonstrations,
    SimilarityTable,
    Status,
    local_similarity,
    locally_similar,
    soft_local_homomorphism,
)
from jaxhom.models.graph import reachable_within
from jaxhom.similarity.classes import local_model_classes
from jaxhom.similarity.local_models import local_models


def random_model(rng, num_states=5, num_actions=3):
    transition = rng.dirichlet(np.full(num_states, 0.6), size=(num_states, num_actions))
    allowed = rng.uniform(size=(num_states, num_actions)) < 0.6
    allowed[np.arange(num_states), rng.integers(num_actions, size=num_states)] = True
    allowed[0, 0], allowed[0, 1] = True, False
    return MDP.from_dense(transition, discount=0.9, allowed=allowed)


def extended_error(mdp, source, target):
    """LP (9) with one more state that refused actions lead to; it is mapped to itself, and nothing else is."""
    models = []
    for state in (source, target):
        local = local_models(mdp, [state])
        size = int(local.size[0])
        extended = np.zeros((size + 1, mdp.num_actions, size + 1))
        extended[:size, :, :size] = local.transition[0, :size, :, :size]
        extended[:size, :, size] = local.labels[0, :size, :, 0]
        extended[size, :, size] = 1
        models.append(extended)
    return oracles.homomorphism_lp(*models, refused=True)[0]


@pytest.mark.parametrize("method", ["pdhg", "interior_point"])
def test_errors_are_those_with_a_refused_state(method, rng):
    mdp = random_model(rng)
    sources, targets = (array.ravel() for array in np.indices((5, 5)))
    found = local_similarity(mdp, sources, targets, method=method)
    for pair, (source, target) in enumerate(zip(sources, targets, strict=True)):
        expected = extended_error(mdp, source, target)
        assert found.lower[pair] - 1e-8 <= expected <= found.upper[pair] + 1e-8
        assert found.upper[pair] - found.lower[pair] <= 1.1e-4


def test_a_state_does_not_map_for_free_to_one_where_other_actions_are_allowed():
    """Three states that stay where they are: two allow both actions, one only the first."""
    allowed = np.array([[True, True], [True, True], [True, False]])
    mdp = MDP.from_dense(np.broadcast_to(np.eye(3)[:, None], (3, 2, 3)), discount=0.9, allowed=allowed)
    found = local_similarity(mdp, [0, 0, 2], [1, 2, 0])
    np.testing.assert_allclose(found.upper, [0, 1, 1], atol=1e-9)
    assert locally_similar(mdp, [0, 0], [1, 2]).tolist() == [True, False]
    assert local_model_classes(mdp).label.tolist() == [0, 0, 1]


def test_nobody_is_told_to_do_what_it_cannot(rng):
    mdp = random_model(rng, 12)
    first = np.asarray(mdp.allowed).argmax(axis=1)
    demonstrations = Demonstrations.from_trajectories([([s], [first[s]]) for s in (0, 3, 7)])
    policy = np.asarray(soft_local_homomorphism(mdp, demonstrations, threshold=0.9).policy)
    assert not policy[~np.asarray(mdp.allowed)].any()
    np.testing.assert_allclose(policy.sum(axis=1), 1)


@pytest.mark.parametrize("num_actions", [255, 256, 257])
def test_many_actions_with_one_successor_are_one_edge(num_actions):
    next_state = np.ones((2, num_actions, 1), int)
    mdp = MDP.from_successors(next_state, np.ones(next_state.shape), discount=0.9)
    assert reachable_within(mdp, 1).toarray().tolist() == [[True, True], [False, True]]


def test_many_paths_of_two_steps_are_one_connection():
    next_state = np.zeros((302, 300, 1), int)
    next_state[0, :, 0] = np.arange(1, 301)
    next_state[1:, :, 0] = 301
    mdp = MDP.from_successors(next_state, np.ones(next_state.shape), discount=0.9)
    assert reachable_within(mdp, 2)[[0]].sum() == 302


def test_a_hub_is_left_open_and_costs_nothing(monkeypatch):
    """A state with very many successors is no reason to make everything as large as its local model."""
    from jaxhom.similarity import local_models

    monkeypatch.setattr(local_models, "_MAX_ENTRIES", 5000)
    num_states = 90
    next_state = np.zeros((num_states, 1, num_states), int)
    probability = np.zeros(next_state.shape)
    next_state[:, 0, 0] = np.maximum(np.arange(num_states) - 1, 0)
    probability[:, 0, 0] = 1
    next_state[50], probability[50] = np.arange(num_states), 1 / num_states
    mdp = MDP.from_successors(next_state, probability, discount=0.9)
    found = local_similarity(mdp, [50, 3, 50], [3, 50, 50])
    assert found.status.tolist() == [1, 1, 0] and (found.upper[:2] == 1).all() and (found.lower[:2] == 0).all()
    table = SimilarityTable(mdp)
    decisions = table.decisions([50, 3], [3, 4])
    assert decisions.similar.tolist() == [False, True]
    assert decisions.status.tolist() == [Status.ITERATION_LIMIT, Status.SOLVED]
