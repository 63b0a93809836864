"""Classes of local models that are equal up to a renaming of states which keeps the centre.

Few local models are different: a 48 x 48 grid has nine at d = 1. States of one class share every error of LP (9), so
programs are solved for pairs of classes, never for pairs of states. Classes are found by canonical forms
(`canonical_forms`) as states are met.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping

import numpy as np

from jaxhom import checks
from jaxhom.models.graph import host_graph
from jaxhom.models.mdp import MDP
from jaxhom.similarity.canonical_forms import canonical_forms
from jaxhom.similarity.local_models import LocalModelMaker, is_oversized, validated_states
from jaxhom.status import Record

_CHUNK_BYTES = 64 * 2**20  # of transition tensors at a time
_CHUNK_ENTRIES = 2**22  # of transitions that make them
_KEY_BYTES = 16


class LocalModelClasses(Record):
    """Classes of isomorphic local models.

    Attributes:
      label: int32 [P], the class of each of the given states, numbered 0 ... C - 1.
      representative: int32 [C], the first given state of each class.
      size: int32 [C], the number of states of the class's model.
    """

    label: np.ndarray
    representative: np.ndarray
    size: np.ndarray


class ClassBook:
    """The classes of the states that have been met so far; a class once numbered keeps its number.

    What it holds is true at every moment, whatever may interrupt it.

    Args:
      maker: builds the local models of some distance.
    """

    def __init__(self, maker: LocalModelMaker):
        self._maker = maker
        self._label = np.full(maker.graph.num_states, -1, np.int32)
        self._class_of_key: dict[bytes, int] = {}
        self._classes: list[tuple[int, int]] = []  # the first state that was met, and the size of its model

    def __len__(self) -> int:
        return len(self._classes)

    @property
    def representative(self) -> np.ndarray:
        """int32 [C], the first state that was met of each class."""
        return np.array([state for state, _ in self._classes], np.int32)

    @property
    def size(self) -> np.ndarray:
        """int32 [C], the number of states of each class's model."""
        return np.array([size for _, size in self._classes], np.int32)

    def known_labels(self) -> np.ndarray:
        """int32 [S]: the classes of all states, -1 for those that were not met."""
        return self._label.copy()

    def labels(self, states: np.ndarray) -> np.ndarray:
        """int32 [P]: the classes of states [P]; those that were not met before are looked at."""
        fresh = self._label[states] < 0
        if fresh.any():
            self._meet(np.unique(np.asarray(states)[fresh]))
        return self._label[states]

    def _meet(self, states: np.ndarray) -> None:
        graph, members = self._maker.graph, self._maker.members(states)
        sizes = np.diff(members.indptr)
        weights = np.add.reduceat(graph.num_entries[members.indices], members.indptr[:-1])
        for index in _chunks(sizes, weights, graph.num_actions):
            size = int(sizes[index[0]])
            if is_oversized(size, graph.num_actions):
                keys = [_own_key(state) for state in states[index]]
            else:
                models = self._maker.make(states[index], size, members[index])
                labels = self._maker.scaled(models.labels)
                forms, _ = canonical_forms(models.transition, quantum_bits(graph.dtype), labels)
                keys = [hashlib.blake2b(form, digest_size=_KEY_BYTES).digest() for form in forms]
            for state, key in zip(states[index].tolist(), keys, strict=True):
                if key not in self._class_of_key:
                    self._classes.append((state, size))
                    self._class_of_key[key] = len(self) - 1
                self._label[state] = self._class_of_key[key]

    def contents(self) -> dict[str, np.ndarray]:
        """All classes, as plain arrays for `restore`: of each of S states, -1 if unknown, and what tells C of them."""
        key = np.zeros((len(self), _KEY_BYTES), np.uint8)
        for name, number in self._class_of_key.items():
            if len(name) == _KEY_BYTES:  # others are made of their states
                key[number] = np.frombuffer(name, np.uint8)
        return {"class_of_state": self.known_labels(), "representative": self.representative, "class_key": key}

    def restore(self, contents: Mapping[str, np.ndarray]) -> None:
        """Fills an empty book with the `contents` of another; `ValueError` where they are none."""
        graph = self._maker.graph
        states = checks.require_integers("representative", contents["representative"], upper=graph.num_states)
        checks.require_shape("representative", states, "[C]", states.ndim == 1)
        label, key = contents["class_of_state"], contents["class_key"]
        checks.require_shape("class_of_state", label, f"({graph.num_states},)", label.shape == (graph.num_states,))
        checks.require_integers("class_of_state", label[label != -1], upper=len(states))
        checks.require_shape("class_key", key, f"({len(states)}, {_KEY_BYTES})", key.shape == (len(states), _KEY_BYTES))
        key = checks.require_integers("class_key", key, upper=256).astype(np.uint8)
        size = np.diff(self._maker.members(states).indptr)
        is_alone = is_oversized(size, graph.num_actions)
        told = zip(states, is_alone, key, strict=True)
        names = (_own_key(state) if alone else row.tobytes() for state, alone, row in told)
        self._class_of_key = {name: number for number, name in enumerate(names)}
        self._classes = list(zip(states.tolist(), size.tolist(), strict=True))
        self._label[:] = label


def local_model_classes(mdp: MDP, states=None, distance: int = 1) -> LocalModelClasses:
    """Groups states whose local models are equal up to a renaming of states that keeps the centre.

    Args:
      mdp: the model.
      states: int [P]; all states if None.
      distance: d >= 1.

    Returns:
      `LocalModelClasses`. Probabilities count as equal if they agree to about 12 digits (6 in float32), which
      forgives the rounding of differently ordered sums. A model too large to be compared (`is_oversized`) is a class of
      its own.

    Raises:
      ValueError: if a state is out of range or `distance` is below 1.
    """
    states = validated_states(mdp, np.arange(mdp.num_states) if states is None else states, distance)
    book = ClassBook(LocalModelMaker(host_graph(mdp), distance))
    label = book.labels(states)
    _, first = np.unique(label, return_index=True)
    return LocalModelClasses(label=label, representative=states[first].astype(np.int32), size=book.size)


def model_rounding(dtype) -> float:
    """Largest difference between two probabilities that count as equal; between labels, as a share of `label_size`."""
    return 2.0 ** -quantum_bits(dtype)


def isomorphism(one: np.ndarray, other: np.ndarray, labels=None) -> np.ndarray | None:
    """The renaming that makes two local models equal: state i of `one` is state p[i] of `other`.

    Args:
      one: [n, A, n], centre first, no padding.
      other: [m, A, m], likewise.
      labels: those of both, [n, A, L] and [m, A, L], 1 at most; or None.

    Returns:
      int [n], or None where the canonical forms differ. Equal up to `model_rounding`, as within a class.
    """
    if one.shape != other.shape:
        return None
    stacked = None if labels is None else np.stack(labels)
    (key, other_key), order = canonical_forms(np.stack([one, other]), quantum_bits(one.dtype), stacked)
    if key != other_key:
        return None
    renaming = np.empty(len(one), int)
    renaming[order[0]] = order[1]
    return renaming


def _own_key(state: int) -> bytes:
    """Of a class of its own; no longer or shorter than others' by accident."""
    return b"the class of state %d alone" % state


def _chunks(sizes: np.ndarray, weights: np.ndarray, num_actions: int) -> Iterator[np.ndarray]:
    """Numbers of models of one size, as many at a time as memory allows: for their tensors, and for their entries."""
    for size in np.unique(sizes):
        (same,) = np.nonzero(sizes == size)
        most = max(1, _CHUNK_BYTES // (8 * num_actions * int(size) ** 2))
        batch = np.maximum(np.cumsum(weights[same]) // _CHUNK_ENTRIES, np.arange(len(same)) // most)
        yield from np.split(same, np.flatnonzero(np.diff(batch)) + 1)


def quantum_bits(dtype) -> int:
    """Numbers of models are equal to what compares these if they agree to so many binary digits after the point."""
    return 40 if dtype == np.float64 else 20
