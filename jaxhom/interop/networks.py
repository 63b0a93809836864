"""Road networks and other graphs as models: graphs of networkx, GraphML files and lists of edges.

    states="links"    a state is a link driven in its direction, an action an exit at its end. Back where one came from
                      is an exit only where there is no other
    states="nodes"    a state is a node, an action a link that begins there

Exits are numbered clockwise, from the way back or from north, where the nodes have positions, and in the graph's order
elsewhere. Where there are fewer than elsewhere the others are not allowed; dead ends absorb. Links without direction
lead both ways. If links have lengths, minus these are the one feature, of the link that one is on or takes: a
non-negative weight on it prefers short ways.
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import itertools
import os
from collections.abc import Callable, Hashable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxhom import checks
from jaxhom.interop.archives import FileError, errors_of
from jaxhom.interop.imported_model import Entries, ImportedModel, counted, model_of_entries
from jaxhom.interop.numbering import real_of, whole_of
from jaxhom.interop.text_files import open_text, without_gz
from jaxhom.interop.text_tables import TextTable, numbered
from jaxhom.models.padded_rows import rows_and_places

if TYPE_CHECKING:
    from jaxtyping import ArrayLike, Float

STATES = ("links", "nodes")
_LENGTHS = ("length", "weight")
_LOOK = 100  # lines, of which some may be comments, that show what a file is
_COMMENTS = "#%"
_HEADERS = (("u", "source", "from"), ("v", "target", "to"), _LENGTHS)


def from_networkx(
    graph: Any, *, discount: Float[ArrayLike, ""], states: str = "links", length: str | None = None
) -> ImportedModel:
    """Builds the model of a graph (see the module's text).

    Args:
      graph: a graph of networkx, directed or not, with several links between two nodes or not.
      discount: scalar, strictly between 0 and 1.
      states: "links" or "nodes".
      length: the attribute of links that is their length; `length` or `weight` if None, where all links have it.

    Returns:
      The model without a reward. States are named by their nodes, links by (from, to), or (from, to, key) where there
      may be several. Coordinates are the nodes' attributes x and y, or pos, if all have them; links have their middles.

    Raises:
      ValueError: if the graph has no links, `states` is another word, or naming the link or node whose length or
        position is no number.

    Outside jit, vmap and grad only: what is read is checked on the host.

    Example:
      >>> import networkx
      >>> square = networkx.DiGraph(["ab", "ba", "bc", "ca"])
      >>> model = from_networkx(square, discount=0.9)
      >>> model.state_names
      (('a', 'b'), ('b', 'a'), ('b', 'c'), ('c', 'a'))
      >>> model.mdp.transition[0].argmax(axis=-1).tolist()  # on towards c, not back
      [2]
    """
    if not hasattr(graph, "is_multigraph"):
        raise ValueError(f"graph must be a graph of networkx, got {type(graph).__name__}")
    is_multigraph = graph.is_multigraph()
    directed = graph if graph.is_directed() else graph.to_directed()
    nodes, data = [*directed.nodes], [attributes for _, attributes in directed.nodes(data=True)]
    number = {node: n for n, node in enumerate(nodes)}
    links = [*(directed.edges(keys=True, data=True) if is_multigraph else directed.edges(data=True))]
    network = _Network(
        nodes=nodes,
        begin=np.array([number[link[0]] for link in links], int),
        end=np.array([number[link[1]] for link in links], int),
        names=[link[:-1] for link in links],
        length=_lengths(links, length),
        places=_places(nodes, data),
    )
    return _model(network, discount, states, _remarks(links, network.length))


def from_edges(
    path: str | os.PathLike, *, discount: Float[ArrayLike, ""], states: str = "links", directed: bool = True
) -> ImportedModel:
    """Reads a list of links, one a line, or a GraphML file.

    Args:
      path: a file of lines `from to`, or `from to length`, with blanks, commas, semicolons or tabs between them, plain
        or compressed by gzip; lines that begin with # or % are left out. If the first line names columns, they may
        stand in any order: `u`, `source` or `from`; `v`, `target` or `to`; `length` or `weight`; others are ignored.
        `.graphml` files, and lines `from to {attributes}` as networkx writes them, are read by networkx.
      discount: scalar, strictly between 0 and 1.
      states: "links" or "nodes", as in `from_networkx`.
      directed: whether a line leads one way only; GraphML files say it themselves.

    Returns:
      The model, as `from_networkx` has it.

    Raises:
      FileError: if the file is missing or malformed, naming the line.
      ImportError: if networkx is needed and missing.

    Outside jit, vmap and grad only: what is read is checked on the host.

    Example:
      >>> import pathlib, tempfile
      >>> path = pathlib.Path(tempfile.mkdtemp(), "roads.csv")
      >>> _ = path.write_text("from,to,length\\n1,2,350\\n2,3,120\\n3,1,90\\n")
      >>> roads = from_edges(path, discount=0.9)
      >>> roads.state_names, roads.mdp.features[:, 0, 0].tolist()
      (((1, 2), (2, 3), (3, 1)), [-350.0, -120.0, -90.0])
    """
    with errors_of(path):
        graph = _read_by_networkx(path, directed)
        if graph is not None:
            return from_networkx(graph, discount=discount, states=states)
        begin, end, length = _columns(path)
        if not directed:
            back = [n for n, ends in enumerate(zip(begin, end, strict=True)) if ends[0] != ends[1]]  # a loop is its own
            begin, end = begin + [end[n] for n in back], end + [begin[n] for n in back]
            length = None if length is None else np.append(length, length[np.array(back, int)])
        nodes, which = numbered(begin + end)
        first, second = np.split(which, 2)
        names: list[tuple] = [*zip(begin, end, strict=True)]
        if len({*names}) < len(names):  # some are there several times
            times: dict[tuple, int] = {}
            for n, name in enumerate(names):
                times[name] = times.get(name, -1) + 1
                names[n] = (*name, times[name])
        return _model(_Network(nodes, first, second, names, length, None), discount, states)


@dataclasses.dataclass(frozen=True, eq=False)
class _Network:
    """N nodes and L links.

    Attributes:
      nodes: N names.
      begin, end: int [L].
      names: L names.
      length: float [L], or None.
      places: float [N, 2], (x, y), or None.
    """

    nodes: Sequence[Hashable]
    begin: np.ndarray
    end: np.ndarray
    names: Sequence[Hashable]
    length: np.ndarray | None
    places: np.ndarray | None


def _model(network: _Network, discount: Any, states: str, remarks: Sequence[str] = ()) -> ImportedModel:
    if states not in STATES:
        raise ValueError(f"states must be one of {', '.join(STATES)}, got {states!r}")
    if not len(network.begin):
        raise ValueError("the graph has no links")
    by_link = states == "links"
    state, link = _exits(network) if by_link else (network.begin, np.arange(len(network.begin)))
    order, action = _numbered_exits(network, state, link, from_back=by_link)
    state, link = state[order], link[order]
    count = len(network.begin) if by_link else len(network.nodes)
    num_actions = int(action.max(initial=0)) + 1
    features = None
    if network.length is not None:
        features = np.zeros((count, num_actions, 1))
        features[state, action, 0] = -network.length[state if by_link else link]
    places = network.places
    if places is not None and by_link:
        places = (places[network.begin] + places[network.end]) / 2.0
    return model_of_entries(
        Entries(state, action, link if by_link else network.end[link], np.ones(len(state))),
        num_states=count,
        num_actions=num_actions,
        discount=discount,
        features=features,
        state_names=network.names if by_link else network.nodes,
        coordinates=places,
        remarks=remarks,
    )


def _exits(network: _Network) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (link, link that goes on at its end), but for ways back where others are."""
    order = np.argsort(network.begin, kind="stable")
    count = np.bincount(network.begin, minlength=len(network.nodes))
    first = np.cumsum(count) - count
    link, place = rows_and_places(count[network.end])
    exit_ = order[first[network.end[link]] + place]
    is_back = network.end[exit_] == network.begin[link]
    others = np.bincount(link[~is_back], minlength=len(network.end))
    kept = ~is_back | (others[link] == 0)
    return link[kept], exit_[kept]


def _numbered_exits(
    network: _Network, state: np.ndarray, link: np.ndarray, *, from_back: bool
) -> tuple[np.ndarray, np.ndarray]:
    """An order of exits, state by state, and the number of each among those of its state."""
    turn = np.arange(len(link), dtype=float)
    if network.places is not None:
        heading = np.arctan2(*(network.places[network.end] - network.places[network.begin]).T)  # clockwise from north
        turn = (heading[link] - (heading[state] + np.pi if from_back else 0.0)) % (2.0 * np.pi)
    order = np.lexsort((turn, state))
    count = np.bincount(state)
    first = np.cumsum(count) - count
    return order, np.arange(len(order)) - first[state[order]]


def _lengths(links: Sequence[tuple], length: str | None) -> np.ndarray | None:
    """float [L], None without lengths."""
    names = _LENGTHS if length is None else (length,)
    name = next((name for name in names if links and all(name in link[-1] for link in links)), None)
    if name is None:
        if length is None:
            return None
        missing = next((link[:-1] for link in links if length not in link[-1]), "the graph")
        raise ValueError(f"link {missing} has no attribute {length!r}")
    return np.array([_number(link[-1][name], f"{name} of link {link[:-1]}") for link in links])


def _remarks(links: Sequence[tuple], lengths: np.ndarray | None) -> list[str]:
    """Which lengths are not used because some links have none."""
    counts = {name: sum(name in link[-1] for link in links) for name in _LENGTHS} if lengths is None else {}
    return [f"{name} ignored: {counted(len(links) - n, 'link')} without" for name, n in counts.items() if n]


def _places(nodes: Sequence[Hashable], data: Sequence[dict]) -> np.ndarray | None:
    """float [N, 2], None unless all nodes have positions."""
    if data and all("x" in attributes and "y" in attributes for attributes in data):
        pairs = [(attributes["x"], attributes["y"]) for attributes in data]
    elif data and all("pos" in attributes for attributes in data):
        pairs = [attributes["pos"] for attributes in data]
        for node, pair in zip(nodes, pairs, strict=True):
            if np.shape(pair) != (2,):
                raise ValueError(f"position of node {node!r} must be two numbers, got {checks.in_one_line(pair)}")
    else:
        return None
    return np.array(
        [[_number(c, f"position of node {node!r}") for c in p] for node, p in zip(nodes, pairs, strict=True)]
    )


def _number(value: Any, name: str) -> float:
    """A finite number, perhaps as text: GraphML files have texts."""
    try:
        return real_of(value)
    except ValueError:
        raise ValueError(f"{name} must be a number, got {checks.in_one_line(value)}") from None


def _read_by_networkx(path: str | os.PathLike, directed: bool) -> Any:
    """The graph of a GraphML file, or of lines `from to {attributes}` as networkx writes them; None of other files."""
    if without_gz(path).lower().endswith(".graphml"):
        if not os.path.exists(path):
            raise FileError(f"{path}: no such file")
        return _by_networkx(path, "GraphML file", lambda networkx: networkx.read_graphml(path))
    with open_text(path) as file:
        lines = [line for line in itertools.islice(file, _LOOK) if line.strip() and not line.startswith("#")]
        if not lines or not lines[0].rstrip().endswith("}"):
            return None
        lines += file

    ends = lines[0].partition("{")[0]
    delimiter = next((mark for mark in ",;\t" if mark in ends), None)

    def parse(networkx: Any) -> Any:
        several = networkx.MultiDiGraph if directed else networkx.MultiGraph
        graph = networkx.parse_edgelist(lines, create_using=several, delimiter=delimiter)
        single = (networkx.DiGraph if directed else networkx.Graph)(graph)
        return single if single.number_of_edges() == graph.number_of_edges() else graph

    return _by_networkx(path, "list of links", parse)


def _by_networkx(path: str | os.PathLike, what: str, read: Callable[[Any], Any]) -> Any:
    networkx = importlib.import_module("networkx")
    try:
        return read(networkx)
    except Exception as error:  # of damaged files networkx and the XML parser raise what they come upon
        raise FileError(f"{path}: not a readable {what} ({checks.first_line(error)})") from None


def _columns(path: str | os.PathLike) -> tuple[list, list, np.ndarray | None]:
    """Where links begin and end, and their lengths if these are there."""
    with open_text(path) as file:
        first = next((line for line in file if line.strip() and line.lstrip()[0] not in _COMMENTS), "")
    read = TextTable.of_separated if any(mark in first for mark in ",;\t") else TextTable.of_words
    table = read(path, _COMMENTS)
    if not len(table):
        raise FileError(f"{path}: it has no links")
    header = [text.strip().lower() for text in table.row(0)]
    found = [[place for place, name in enumerate(header) if name in names] for names in _HEADERS]
    is_named = bool(found[0] and found[1])
    if is_named:
        table = table.after(1)
    else:
        table.require_width(2, 3, "`from to` or `from to length`")
        found = [[0], [1], [2] * (len(header) == 3)]
    table.require_width(len(header), len(header), f"{len(header)} fields, as many as on the first line")
    begin, end = found[0][0], found[1][0]
    ends: list[list] = [[*map(str.strip, table.columns[place])] for place in (begin, end)]
    for texts in ends:
        if "" in texts:
            raise table.error(texts.index(""), "a link must begin and end somewhere")
    with contextlib.suppress(ValueError):
        ends = _whole_numbers(ends)
    if not is_named and _have_names(ends):
        known = "; ".join(" or ".join(names) for names in _HEADERS)
        raise table.error(0, f"{' '.join(table.row(0))!r} above numbers: columns are called {known}")
    return ends[0], ends[1], table.numbers(found[2][0], "length") if found[2] else None


def _whole_numbers(columns: list[list]) -> list[list]:
    """Columns of texts as whole numbers; `ValueError` if one is none."""
    return [[*map(whole_of, texts)] for texts in columns]


def _have_names(columns: list[list]) -> bool:
    """Whether columns hold texts in the first line and whole numbers in all others."""
    try:
        below = _whole_numbers([column[1:] for column in columns])
    except ValueError:
        return False
    return len(below[0]) > 0 and not any(str(column[0]).lstrip("-").isdecimal() for column in columns)
