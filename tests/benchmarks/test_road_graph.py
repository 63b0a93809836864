"""The road network of the benchmarks: what its docstrings say of it."""

import numpy as np
import pytest

from bench.road_graph import road_graph
from jaxhom.models.graph import host_graph
from jaxhom.similarity.classes import local_model_classes


@pytest.mark.parametrize("slip", [0.0, 0.1])
def test_links_and_exits(slip):
    graph = road_graph(8, 3, slip=slip)
    mdp, ends = graph.mdp, graph.ends
    allowed, next_state = np.asarray(mdp.allowed), np.asarray(mdp.next_state)
    chance = np.asarray(mdp.probability)
    for s, a in np.argwhere(allowed):
        leads_to = next_state[s, a][chance[s, a] > 0]
        assert (ends[leads_to, 0] == ends[s, 1]).all()
        assert len(np.unique(leads_to)) == (1 if slip == 0.0 else allowed[s].sum())
        assert np.isclose(chance[s, a].max(), 1.0 - slip + slip / allowed[s].sum())
    count = allowed.sum(axis=1)
    assert (allowed == (np.arange(mdp.num_actions) < count[:, None])).all() and mdp.num_actions == count.max()
    assert (count < mdp.num_actions).mean() > 0.5
    everyone = host_graph(mdp).reach(np.arange(mdp.num_states), mdp.num_states)
    assert everyone.nnz == mdp.num_states**2


def test_exits_are_counted_clockwise():
    """From the way back on, so that turns are from left to right."""
    graph = road_graph(8, 3)
    direction = graph.ends[:, 1] - graph.ends[:, 0]
    east, south = direction[:, 1], direction[:, 0]
    allowed, next_state = np.asarray(graph.mdp.allowed), np.asarray(graph.mdp.next_state)[..., 0]
    for s in range(graph.mdp.num_states):
        exits = next_state[s][allowed[s]]
        if len(exits) > 1:
            right = np.arctan2(east[s] * south[exits] - south[s] * east[exits], direction[exits] @ direction[s])
            assert (np.diff(right) > 0).all()


def test_hardly_two_links_are_alike():
    for size, most in ((15, 800), (18, 1200)):
        graph = road_graph(size, 1)
        assert most - 200 < graph.mdp.num_states < most
        classes = local_model_classes(graph.mdp, distance=2)
        assert len(classes.size) > 0.85 * graph.mdp.num_states


def test_seeds_destinations_and_links_by_place():
    graph, again, other = road_graph(10, 1), road_graph(10, 1), road_graph(10, 2)
    np.testing.assert_array_equal(graph.coordinates, again.coordinates)
    assert len(graph.coordinates) != len(other.coordinates)
    chosen = graph.coordinates[graph.destinations]
    apart = np.linalg.norm(chosen[:, None] - chosen, axis=2)
    assert apart[~np.eye(4, dtype=bool)].min() > 4.0
    found = graph.coordinates[graph.nearest_links(chosen + 1e-6)]
    np.testing.assert_allclose(found, chosen)
    features = np.asarray(graph.mdp.features)
    assert features.shape[2] == 5
    indicators = features[:, 0, 1:]
    np.testing.assert_array_equal(indicators.argmax(axis=0), graph.destinations)
    np.testing.assert_array_equal(indicators.sum(axis=0), 1.0)
