"""Road networks, against loops over their links and against the seeded network of the benchmarks."""

import gzip
import pathlib
import re
import sys

import networkx
import numpy as np
import pytest
from small_models import dense_transition

from jaxhom.interop import FileError, from_edges, from_networkx

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[2] / "bench"))

import road_graph


def random_graph(seed, kind):
    rng = np.random.default_rng(seed)
    graph = kind()
    graph.add_nodes_from(range(7))
    graph.add_edges_from([tuple(map(int, pair)) for pair in rng.integers(7, size=(14, 2))])
    return graph


def slow_exits(links, link):
    """The links that begin where a link ends; those that lead back only where there is nothing else."""
    exits = [other for other in links if other[0] == link[1]]
    onward = [other for other in exits if other[1] != link[0]]
    return onward or exits


@pytest.mark.parametrize("kind", [networkx.Graph, networkx.DiGraph, networkx.MultiGraph, networkx.MultiDiGraph])
@pytest.mark.parametrize("seed", range(3))
def test_links_and_nodes_as_states(seed, kind):
    graph = random_graph(seed, kind)
    directed = graph if graph.is_directed() else graph.to_directed()
    links = list(directed.edges(keys=True) if graph.is_multigraph() else directed.edges)
    for states in ("links", "nodes"):
        model = from_networkx(graph, discount=0.9, states=states)
        names = links if states == "links" else list(graph.nodes)
        assert model.state_names == tuple(names) and model.coordinates is None and model.mdp.num_features == 0
        transition, allowed = dense_transition(model.mdp), np.asarray(model.mdp.allowed)
        for state, name in enumerate(names):
            exits = slow_exits(links, name) if states == "links" else [link for link in links if link[0] == name]
            targets = [names.index(link if states == "links" else link[1]) for link in exits]
            assert (model.terminal is not None and model.terminal[state]) == (not exits)
            targets = targets or [state] * model.mdp.num_actions
            assert allowed[state].tolist() == [n < len(targets) for n in range(model.mdp.num_actions)]
            assert transition[state, : len(targets)].argmax(axis=-1).tolist() == targets


def as_networkx(road, kind=float):
    """The junctions and links of a seeded network, y upwards."""
    places, which = np.unique(road.ends.reshape(-1, 2), axis=0, return_inverse=True)
    graph = networkx.DiGraph()
    graph.add_nodes_from((n, {"x": kind(x), "y": kind(-y)}) for n, (y, x) in enumerate(places.tolist()))
    lengths = np.linalg.norm(road.ends[:, 1] - road.ends[:, 0], axis=1).tolist()
    links = [(*map(int, link), {"length": kind(d)}) for link, d in zip(which.reshape(-1, 2), lengths, strict=True)]
    graph.add_edges_from(links)
    return graph, [link[:2] for link in links]


@pytest.mark.parametrize("kind", [float, str])
def test_exits_are_numbered_clockwise(kind):
    """As in the network of the benchmarks; numbers that are texts are numbers."""
    road = road_graph.road_graph(5, 0)
    graph, links = as_networkx(road, kind)
    model = from_networkx(graph, discount=0.99)
    order = [model.mdp.state_index(link) for link in links]
    transition = dense_transition(model.mdp)[np.ix_(order, range(model.mdp.num_actions), order)]
    np.testing.assert_array_equal(transition, dense_transition(road.mdp))
    np.testing.assert_allclose(np.asarray(model.mdp.features)[order, 0], -road.mdp.features[:, 0, :1])
    np.testing.assert_allclose(model.coordinates[order] * [1, -1], road.coordinates[:, ::-1])


def test_nodes_have_positions_and_lengths():
    graph = networkx.DiGraph()
    for name, place in {"c": (0, 0), "n": (0, 1), "e": (2, 0), "s": (0, -3), "w": (-4, 0)}.items():
        graph.add_node(name, pos=place)
    graph.add_weighted_edges_from([("c", name, length) for length, name in enumerate("wsen", start=1)])
    model = from_networkx(graph, discount=0.9, states="nodes")
    names = [model.state_names[z] for z in model.mdp.transition[0].argmax(axis=-1)]
    assert names == ["n", "e", "s", "w"]  # clockwise from north
    assert model.mdp.features[0, :, 0].tolist() == [-4, -3, -2, -1] and model.coordinates[2].tolist() == [2, 0]
    assert model.terminal.tolist() == [False, True, True, True, True]
    graph.edges["c", "n"].clear()
    some = from_networkx(graph, discount=0.9)
    assert some.mdp.num_features == 0 and "weight ignored: 1 link without" in some.remarks


@pytest.mark.parametrize(
    ("change", "options", "message"),
    [
        (lambda g: None, {"states": "roads"}, "states must be one of links, nodes, got 'roads'"),
        (lambda g: g.clear_edges(), {}, "the graph has no links"),
        (lambda g: None, {"length": "time"}, r"link \(0, 1\) has no attribute 'time'"),
        (lambda g: g.edges[0, 1].update(length="far"), {}, r"length of link \(0, 1\) must be a number, got 'far'"),
        (lambda g: g.edges[0, 1].update(length=None), {}, r"length of link \(0, 1\) must be a number, got None"),
        (lambda g: g.nodes[1].update(x=float("nan")), {}, "position of node 1 must be a number, got nan"),
    ],
)
def test_bad_graphs_are_refused(change, options, message):
    graph = networkx.DiGraph([(0, 1, {"length": 2})])
    graph.add_node(0, x=0, y=0)
    graph.add_node(1, x=1, y=0)
    change(graph)
    with pytest.raises(ValueError, match=message):
        from_networkx(graph, discount=0.9, **options)


def test_what_is_no_graph_is_refused():
    with pytest.raises(ValueError, match="graph must be a graph of networkx, got dict"):
        from_networkx({0: [1]}, discount=0.9)
    graph = networkx.DiGraph([(0, 1)])
    networkx.set_node_attributes(graph, 3, "pos")
    with pytest.raises(ValueError, match="position of node 0 must be two numbers, got 3"):
        from_networkx(graph, discount=0.9)


LINKS = [(1, 2, 5.0), (2, 3, 1.5), (3, 1, 2.0), (2, 1, 5.0)]
FILES = {
    "words": "# roads\n1 2 5\n2 3 1.5\n\n3 1 2\n2 1 5\n",
    "commas": "1,2,5\n2,3,1.5\n3,1,2\n2,1,5\n",
    "comments": "% 4 links, in km\n#from,to\n1,2,5\n2,3,1.5\n # and\n3,1,2\n2,1,5\n",
    "comments and quotes": '# roads\n"1"\t2\t5\n%\n2\t3\t1.5\n3\t1\t2\n2\t1\t5\n',
    "names": "key;length;to;from\n0;5;2;1\n0;1.5;3;2\n0;2;1;3\n0;5;1;2\n",
    "words with names": "u v weight\n1 2 5\n2 3 1.5\n3 1 2\n2 1 5\n",
}


@pytest.mark.parametrize("form", FILES)
@pytest.mark.parametrize("compressed", [False, True])
def test_lists_of_links(tmp_path, form, compressed):
    path = tmp_path / "roads.txt"
    path.write_bytes(gzip.compress(FILES[form].encode()) if compressed else FILES[form].encode())
    model = from_edges(path, discount=0.9)
    assert model.state_names == tuple(link[:2] for link in LINKS)
    assert model.mdp.features[:, 0, 0].tolist() == [-link[2] for link in LINKS]
    graph = networkx.DiGraph()
    graph.add_weighted_edges_from(LINKS)
    expected = from_networkx(graph, discount=0.9)
    order = [expected.mdp.state_index(name) for name in model.state_names]
    transition = dense_transition(expected.mdp)[np.ix_(order, range(expected.mdp.num_actions), order)]
    np.testing.assert_array_equal(dense_transition(model.mdp), transition)


def test_both_directions_texts_and_several_links(tmp_path):
    path = tmp_path / "roads.edgelist"
    path.write_text("a b\nb c\na b\n")
    model = from_edges(path, discount=0.9, directed=False)
    pairs = [("a", "b", 0), ("b", "c", 0), ("a", "b", 1), ("b", "a", 0), ("c", "b", 0), ("b", "a", 1)]
    assert model.state_names == tuple(pairs) and model.terminal is None
    assert from_edges(path, discount=0.9, states="nodes").terminal.tolist() == [False, False, True]


def test_names_with_underscores_are_no_numbers(tmp_path):
    path = tmp_path / "roads.edgelist"
    path.write_text("1_12 11_2\n11_2 1_12\n")
    assert from_edges(path, discount=0.9, states="nodes").state_names == ("1_12", "11_2")


def test_links_that_begin_where_they_end(tmp_path):
    """Without direction, too, each of them is one."""
    path = tmp_path / "roads.edgelist"
    path.write_text("1 1 3\n1 2 5\n")
    model = from_edges(path, discount=0.9, directed=False)
    assert model.state_names == ((1, 1), (1, 2), (2, 1))
    assert model.mdp.features[:, 0, 0].tolist() == [-3, -5, -5]


@pytest.mark.parametrize("delimiter", [" ", ",", "\t", ";"])
@pytest.mark.parametrize("kind", ["Graph", "DiGraph", "MultiGraph", "MultiDiGraph"])
def test_lists_that_networkx_wrote(tmp_path, kind, delimiter):
    links = [("a", "b", {"weight": 2}), ("b", "c", {"weight": 1}), *[("a", "b", {"weight": 3})] * ("Multi" in kind)]
    graph = getattr(networkx, kind)(links)
    networkx.write_edgelist(graph, tmp_path / "roads.edgelist", delimiter=delimiter)
    model = from_edges(tmp_path / "roads.edgelist", discount=0.9, directed=graph.is_directed())
    expected = from_networkx(graph, discount=0.9)
    assert model.state_names == expected.state_names
    np.testing.assert_array_equal(model.mdp.features, expected.mdp.features)


def test_graphml_says_the_same(tmp_path):
    graph, _ = as_networkx(road_graph.road_graph(4, 1))
    networkx.write_graphml(graph, tmp_path / "road.graphml")
    model, expected = from_edges(tmp_path / "road.graphml", discount=0.9), from_networkx(graph, discount=0.9)
    assert model.state_names == tuple(tuple(map(str, name)) for name in expected.state_names)
    np.testing.assert_array_equal(model.mdp.next_state, expected.mdp.next_state)
    np.testing.assert_allclose(model.coordinates, expected.coordinates)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.edgelist", "", "it has no links"),
        ("a.edgelist", "# nothing\n", "it has no links"),
        ("a.edgelist", "u v\n", "the graph has no links"),
        ("a.edgelist", "1 2\n3\n", "line 2: expected `from to` or `from to length`, got '3'"),
        ("a.edgelist", "1 2 3\n3 1\n", "line 2: expected 3 fields, as many as on the first line, got '3 1'"),
        ("a.edgelist", "1 2 3\n3 1 far\n", "line 2: length must be a number, got 'far'"),
        ("a.csv", "src,dst\n1,2\n2,1\n", "line 1: 'src dst' above numbers: columns are called u or source or from; v"),
        ("a.csv", "u,v,length\n1,2,3\n1,,3\n", "line 3: a link must begin and end somewhere"),
        ("a.csv", "u,v,length\n1,2,3\n1,3\n", "line 3: expected 3 fields"),
        ("a.edgelist", "1 2 {}\n3 1 {\n", "not a readable list of links ("),
        ("a.graphml", "<graphml", "not a readable GraphML file ("),
        ("a.graphml", "1 2\n", "not a readable GraphML file ("),
    ],
)
def test_bad_files_are_refused(tmp_path, name, text, message):
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(FileError, match=f"^{re.escape(str(path))}.*{re.escape(message)}"):
        from_edges(path, discount=0.9)


@pytest.mark.parametrize("name", ["none.edgelist", "none.graphml"])
def test_missing_files(tmp_path, name):
    with pytest.raises(FileError, match=f"{name}: no such file"):
        from_edges(tmp_path / name, discount=0.9)
