"""A seeded model of a road network, irregular as real ones are: hardly two states have the same local model.

Junctions lie on a square grid and are then moved at random; roads join neighbours, some of them diagonally, and some
roads are missing or lead one way only. A state is a directed link, a road driven in one direction, and an action says
which exit to take at its end, counted clockwise from the way back. There are as many actions as the largest junction
has exits; states that end at smaller ones lack some. The way back itself is an exit only where there is no other.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import scipy

import jaxhom

_SHIFT = 0.3  # of a junction, in widths of a cell, either way
_STEPS = ((0, 1), (1, 0), (1, 1), (1, -1))  # to half of the neighbours; the last two are diagonals


@dataclasses.dataclass(frozen=True)
class RoadGraph:
    """A road network and its geometry. See `road_graph`.

    Attributes:
      mdp: S directed links, A exits, K = 1 + number of destinations features.
      coordinates: float [S, 2], the middle of each link.
      ends: float [S, 2, 2], where it begins and where it ends.
      destinations: int [D], links.
    """

    mdp: jaxhom.MDP
    coordinates: np.ndarray
    ends: np.ndarray
    destinations: np.ndarray

    def nearest_links(self, points) -> np.ndarray:
        """int [Q]: the links whose middles are the nearest to points [Q, 2], to drive to or to begin at."""
        return scipy.spatial.KDTree(self.coordinates).query(np.asarray(points, float))[1]


def road_graph(
    size: int,
    seed: int = 0,
    *,
    missing: float = 0.2,
    diagonal: float = 0.15,
    one_way: float = 0.1,
    slip: float = 0.0,
    num_destinations: int = 4,
    discount: float = 0.99,
    dtype=None,
) -> RoadGraph:
    """Draws a road network on a grid of size x size junctions: about 700 links for 15, and 1,000 for 18.

    Args:
      size: of the grid.
      seed: of everything that is drawn.
      missing: probability that two neighbours in a row or column are not joined.
      diagonal: probability that two diagonal neighbours are.
      one_way: probability that a road leads one way only.
      slip: probability that the exit is drawn uniformly from all that there are, whichever was chosen.
      num_destinations: how many links to choose as destinations, far apart from one another.
      discount: of the model.
      dtype: of the model; float64 if None.

    Returns:
      `RoadGraph` of the largest part in which every link leads to every other; features are the length of the link, in
      widths of a cell, and indicators of the destinations.
    """
    rng = np.random.default_rng(seed)
    junctions = np.stack(np.divmod(np.arange(size**2), size), axis=1)
    places = junctions + rng.uniform(-_SHIFT, _SHIFT, junctions.shape)
    links = _links(rng, size, missing, diagonal, one_way)
    leads_to = _exits(places, links)
    links, leads_to = _strongly_connected(links, leads_to)
    ends = places[links]
    exists = leads_to >= 0
    count = exists.sum(axis=1)
    num_exits = leads_to.shape[1]
    # Successors of every action: all exits, the chosen one most likely.
    chance = np.eye(num_exits) * (1.0 - slip) + (exists * (slip / count[:, None]))[:, None]
    coordinates = ends.mean(axis=1)
    destinations = _far_apart(rng, coordinates, num_destinations)
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    mdp = jaxhom.MDP.from_successors(
        np.repeat(np.maximum(leads_to, 0)[:, None], num_exits, axis=1),
        chance.astype(dtype or np.float64),
        discount=discount,
        features=np.column_stack([length, np.arange(len(links))[:, None] == destinations]),
        allowed=exists,
    )
    return RoadGraph(mdp=mdp, coordinates=coordinates, ends=ends, destinations=destinations)


def _links(rng, size: int, missing: float, diagonal: float, one_way: float) -> np.ndarray:
    """int [S, 2]: the junctions that each directed link joins."""
    row, column = np.divmod(np.arange(size**2), size)
    roads = []
    for down, right in _STEPS:
        inside = (row + down < size) & (column + right < size) & (column + right >= 0)
        inside &= rng.random(size**2) < (diagonal if down and right else 1.0 - missing)
        (begin,) = np.nonzero(inside)
        roads.append(np.stack([begin, begin + down * size + right], axis=1))
    roads = np.concatenate(roads)
    roads = np.where(rng.random(len(roads))[:, None] < 0.5, roads, roads[:, ::-1])
    leads_back = rng.random(len(roads)) >= one_way
    return np.concatenate([roads, roads[leads_back, ::-1]])


def _exits(places: np.ndarray, links: np.ndarray) -> np.ndarray:
    """int [S, A]: the links that each leads to, clockwise from the way back; -1 where it has no more."""
    begin, end = links.T
    angle = np.arctan2(*(places[end] - places[begin]).T)  # clockwise from the vertical
    beginning = _beginning_at(begin, len(places))[end]
    joins = beginning >= 0
    joins &= (end[beginning] != begin[:, None]) | (joins.sum(axis=1, keepdims=True) == 1)
    back = angle[:, None] + np.pi
    turn = np.where(joins, (angle[beginning] - back) % (2.0 * np.pi), np.inf)
    num_exits = int(joins.sum(axis=1).max())
    order = np.argsort(turn, axis=1, kind="stable")[:, :num_exits]
    exits = np.take_along_axis(beginning, order, axis=1)
    return np.where(np.take_along_axis(joins, order, axis=1), exits, -1)


def _beginning_at(begin: np.ndarray, num_junctions: int) -> np.ndarray:
    """int [J, D]: the links that begin at each junction, in their order; -1 where there are no more."""
    order = np.argsort(begin, kind="stable")
    count = np.bincount(begin, minlength=num_junctions)
    found = np.full((num_junctions, count.max()), -1)
    found[begin[order], np.arange(len(begin)) - (np.cumsum(count) - count)[begin[order]]] = order
    return found


def _strongly_connected(links: np.ndarray, leads_to: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The largest part in which all links lead to one another, renumbered; exits that leave it are closed."""
    begin, exit_ = np.nonzero(leads_to >= 0)
    index, shape = (begin, leads_to[begin, exit_]), (len(links),) * 2
    graph = scipy.sparse.coo_array((np.ones(len(begin), bool), index), shape=shape)
    _, part = scipy.sparse.csgraph.connected_components(graph.tocsr(), connection="strong")
    kept = part == np.bincount(part).argmax()
    number = np.append(np.where(kept, np.cumsum(kept) - 1, -1), -1)
    inside = np.sort(np.where(number[leads_to] < 0, len(links), np.arange(leads_to.shape[1])), axis=1)[kept]
    exits = np.take_along_axis(leads_to[kept], np.minimum(inside, leads_to.shape[1] - 1), axis=1)
    return links[kept], np.where(inside < len(links), number[exits], -1)


def _far_apart(rng, coordinates: np.ndarray, count: int) -> np.ndarray:
    """int [D]: a link at random, then again and again the one that is the farthest from all that were chosen."""
    chosen = [int(rng.integers(len(coordinates)))]
    while len(chosen) < count:
        distance = np.linalg.norm(coordinates[:, None] - coordinates[chosen], axis=2).min(axis=1)
        chosen.append(int(distance.argmax()))
    return np.array(chosen[:count], int)
