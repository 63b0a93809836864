"""The maps behind similarities: for pairs of states, an f of LP (9) together with the bounds that it proves.

Maps are solved for between the models that stand for two classes. Here they are carried over to the models of given
states, by the renaming that makes each equal to the one that stands for its class.
"""

from __future__ import annotations

import numpy as np

from jaxhom.similarity.brackets import LocalSimilarity
from jaxhom.similarity.classes import isomorphism
from jaxhom.similarity.local_models import LocalModelMaker, is_oversized
from jaxhom.status import Record


class CertifiedMaps(Record):
    """Maps from the local models of P source states to those of P target states, NumPy.

    Attributes:
      lower: [P], lower <= e <= upper for the optimal error e of LP (9), rounding included.
      upper: [P], likewise.
      maps: [P, n, m], rows sum to 1: f(i, k) is the share of the source's i-th state that goes to the target's k-th.
        Its own error |K f|_inf is at most `upper`. Zero on padding.
      sources: int [P, n], the states of M^{s,d} that the rows stand for, centre first; -1 on padding.
      targets: int [P, m], the states of M^{s',d} that the columns stand for, likewise.
      status: int [P], a `jaxhom.Status`.
    """

    lower: np.ndarray
    upper: np.ndarray
    maps: np.ndarray
    sources: np.ndarray
    targets: np.ndarray
    status: np.ndarray


def carry_maps(
    maker: LocalModelMaker,
    states: tuple[np.ndarray, np.ndarray],
    centres: np.ndarray,
    maps: list[np.ndarray],
    bounds: LocalSimilarity,
) -> CertifiedMaps:
    """Maps between the local models of P pairs of states, from those between the models that stand for their classes.

    Args:
      maker: builds local models.
      states: int [P] each, sources and targets.
      centres: int [P, 2], the states whose models stand for the classes.
      maps: P maps [n, m] between these.
      bounds: [P], what holds for all members of the classes.
    """
    renamings = _Renamings(maker)
    sources, targets = (_padded_members(maker, side) for side in states)
    result = np.zeros((len(maps), sources.shape[1], targets.shape[1]), bounds.upper.dtype)
    for p, (f, source, target) in enumerate(zip(maps, *states, strict=True)):
        rows, columns = renamings(int(source), int(centres[p, 0])), renamings(int(target), int(centres[p, 1]))
        result[p, : len(rows), : len(columns)] = f[rows][:, columns]
    return CertifiedMaps(
        lower=bounds.lower, upper=bounds.upper, maps=result, sources=sources, targets=targets, status=bounds.status
    )


class _Renamings:
    """Which state of the model around one centre each state of the model around another is; both of one class."""

    def __init__(self, maker: LocalModelMaker):
        self._maker = maker
        self._known: dict[tuple[int, int], np.ndarray] = {}

    def __call__(self, state: int, centre: int) -> np.ndarray:
        if (state, centre) not in self._known:
            self._known[state, centre] = self._find(state, centre)
        return self._known[state, centre]

    def _find(self, state: int, centre: int) -> np.ndarray:
        size = self._maker.members(np.array([state])).nnz
        if state == centre or is_oversized(size, self._maker.graph.num_actions):  # alone in its class
            return np.arange(size)
        models = self._maker.make(np.array([state, centre]), size)
        return isomorphism(*models.transition, self._maker.scaled(models.labels))


def _padded_members(maker: LocalModelMaker, states: np.ndarray) -> np.ndarray:
    """int32 [P, n]: the states of each local model, centre first, then ascending; -1 on padding."""
    rows = maker.members(states)
    members = np.full((len(states), int(np.diff(rows.indptr).max(initial=1))), -1, np.int32)
    for p, state in enumerate(states):
        own = rows.indices[rows.indptr[p] : rows.indptr[p + 1]]
        members[p, : len(own)] = np.append(state, own[own != state])
    return members
