"""Local models M^{s,d} and their classes up to a renaming of states.

M^{s,d} is the model restricted to s^d, the states within d steps of s by any actions; a transition that leaves
s^d becomes a self-loop on the state it leaves (Boularias and Chaib-draa 2010, section V). The centre s is state 0
of its local model; the others follow in ascending order; padding has no transitions at all.

Actions that some states lack lead to one more absorbing state, "refused", that all local models share, that is mapped
to itself and to which nothing else is mapped. That is one label per action, 1 where it is not allowed, which a map has
to keep (`homomorphism_lp`); the rows of such actions are zero.

Few local models are different: a 48 x 48 grid has nine at d = 1. `local_model_classes` finds them by their canonical
forms (see `canonical_forms`).
"""

import hashlib
from collections.abc import Iterator

import chex
import numpy as np
import scipy.sparse

from jaxhom import checks
from jaxhom.models.graph import HostGraph
from jaxhom.models.mdp import MDP
from jaxhom.similarity.canonical_forms import canonical_forms

_CHUNK_BYTES = 64 * 2**20
_CHUNK_ENTRIES = 2**22
_MAX_ENTRIES = 2**24  # of a transition tensor


@chex.dataclass(frozen=True)
class LocalModels:
    """P local models padded to the size n of the largest.

    Attributes:
      members: int32 [P, n], the states of each model, centre first, then ascending; -1 on padding.
      size: int32 [P], the number of states of each model.
      transition: float [P, n, A, n], T^{s,d}; zero where either state is padding, and where an action is not allowed.
      labels: float [P, n, A, 1], 1 where an action is not allowed; None where every state has all actions.
    """

    members: np.ndarray
    size: np.ndarray
    transition: np.ndarray
    labels: np.ndarray | None = None


@chex.dataclass(frozen=True)
class LocalModelClasses:
    """Classes of isomorphic local models.

    Attributes:
      label: int32 [P], the class of each of the given states, numbered 0 ... C - 1.
      representative: int32 [C], the first given state of each class.
      size: int32 [C], the number of states of the class's model.
    """

    label: np.ndarray
    representative: np.ndarray
    size: np.ndarray


def local_models(mdp: MDP, states, distance: int = 1) -> LocalModels:
    """Builds M^{s,d} for each of the given states.

    Args:
      mdp: the model.
      states: int [P].
      distance: d >= 1.

    Returns:
      `LocalModels`, padded to the largest of them: P n^2 A numbers.

    Raises:
      ValueError: if a state is out of range or `distance` is below 1.

    Source: Boularias and Chaib-draa 2010, section V.
    """
    states = _validated(mdp, states, distance)
    graph = HostGraph(mdp)
    rows = graph.reach(states, distance)
    return _restrict(graph, states, rows, int(np.diff(rows.indptr).max(initial=1)))


class LocalModelMaker:
    """Builds local models of one distance, some at a time, padded to any width."""

    def __init__(self, mdp: MDP, distance: int):
        self._graph, self._distance = HostGraph(mdp), distance

    def make(self, states: np.ndarray, width: int) -> LocalModels:
        """M^{s,d} of the given states, none of them larger than `width`."""
        return _restrict(self._graph, states, self._graph.reach(states, self._distance), width)


def restricted_model(mdp: MDP, states) -> np.ndarray:
    """M^E: the model restricted to the given different states [E], as a dense tensor [E, A, E].

    Transitions that leave the set become self-loops on the state they leave.

    Source: Boularias and Chaib-draa 2010, section V.
    """
    states = np.sort(_validated(mdp, states, 1))
    rows = scipy.sparse.csr_array(
        (np.ones(len(states), bool), (np.zeros(len(states), int), states)), shape=(1, mdp.num_states)
    )
    model = _restrict(HostGraph(mdp), states[:1], rows, len(states))
    order = np.argsort(model.members[0])  # the first state is its centre, and so already in place
    return model.transition[0][order][..., order]


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
    states = _validated(mdp, np.arange(mdp.num_states) if states is None else states, distance)
    graph = HostGraph(mdp)
    rows = graph.reach(states, distance)
    sizes = np.diff(rows.indptr)
    weights = np.add.reduceat(graph.num_entries[rows.indices], rows.indptr[:-1]) if len(states) else sizes
    class_of_key: dict[bytes, int] = {}
    label = np.zeros(len(states), np.int32)
    first = []
    for index in _chunks(sizes, weights, mdp.num_actions):
        if is_oversized(int(sizes[index[0]]), mdp.num_actions):
            keys = [b"state %d" % states[i] for i in index]
        else:
            models = _restrict(graph, states[index], rows[index], int(sizes[index[0]]))
            forms, _ = canonical_forms(models.transition, _quantum_bits(mdp.dtype), models.labels)
            keys = [hashlib.blake2b(form, digest_size=16).digest() for form in forms]
        for i, key in zip(index, keys, strict=True):
            number = class_of_key.setdefault(key, len(class_of_key))
            if number == len(first):
                first.append(i)
            label[i] = number
    first = np.array(first, int)
    return LocalModelClasses(
        label=label,
        representative=states[first].astype(np.int32),
        size=sizes[first].astype(np.int32),
    )


def model_rounding(dtype) -> float:
    """Largest difference between two probabilities that `local_model_classes` takes as equal."""
    return 2.0 ** -_quantum_bits(dtype)


def isomorphism(one: np.ndarray, other: np.ndarray, labels=None) -> np.ndarray | None:
    """The renaming that makes two local models equal: state i of `one` is state p[i] of `other`.

    Args:
      one: [n, A, n], centre first, no padding.
      other: [m, A, m], likewise.
      labels: those of both, [n, A, L] and [m, A, L]; or None.

    Returns:
      int [n], or None where the canonical forms differ. Equal up to `model_rounding`, as within a class.
    """
    if one.shape != other.shape:
        return None
    stacked = None if labels is None else np.stack(labels)
    (key, other_key), order = canonical_forms(np.stack([one, other]), _quantum_bits(one.dtype), stacked)
    if key != other_key:
        return None
    renaming = np.empty(len(one), int)
    renaming[order[0]] = order[1]
    return renaming


def is_oversized(size: np.ndarray, num_actions: int) -> np.ndarray:
    """Whether a local model of so many states is too large to be told from others or mapped: hubs of thousands."""
    return np.asarray(size, np.int64) ** 2 * num_actions > _MAX_ENTRIES


def _chunks(sizes: np.ndarray, weights: np.ndarray, num_actions: int) -> Iterator[np.ndarray]:
    """Numbers of models of one size, as many at a time as memory allows: for their tensors, and for their entries."""
    for size in np.unique(sizes):
        (same,) = np.nonzero(sizes == size)
        most = max(1, _CHUNK_BYTES // (8 * num_actions * int(size) ** 2))
        batch = np.maximum(np.cumsum(weights[same]) // _CHUNK_ENTRIES, np.arange(len(same)) // most)
        yield from np.split(same, np.flatnonzero(np.diff(batch)) + 1)


def _quantum_bits(dtype) -> int:
    return 40 if dtype == np.float64 else 20


def _validated(mdp: MDP, states, distance: int) -> np.ndarray:
    if checks.is_traced(mdp):
        raise ValueError("local models are found on the host: call this outside jit, vmap and grad")
    checks.require_count("distance", distance)
    states = checks.as_host_array("states", states)
    checks.require_shape("states", states, "[P]", states.ndim == 1)
    return checks.require_integers("states", states, upper=mdp.num_states)


def _restrict(graph: HostGraph, states, rows: scipy.sparse.csr_array, width: int) -> LocalModels:
    """Local models of `states`, whose members are the rows of a boolean matrix, padded to `width` states."""
    count, num_states, num_actions = len(states), graph.num_states, graph.num_actions
    sizes = np.diff(rows.indptr)
    model = np.repeat(np.arange(count, dtype=np.int64), sizes)
    key = model * num_states + rows.indices  # ascending: rows are sorted
    is_centre = rows.indices == states[model]
    position = np.arange(len(key)) - np.repeat(rows.indptr[:-1], sizes)
    centre_position = position[is_centre][model]
    local = np.where(is_centre, 0, position + (position < centre_position))
    members = np.full((count, width), -1, np.int32)
    members[model, local] = rows.indices

    owner, entry = graph.entries_of(rows.indices)
    wanted = model[owner] * num_states + graph.successor[entry]
    found = np.minimum(np.searchsorted(key, wanted), len(key) - 1)
    target = np.where(key[found] == wanted, local[found], local[owner])
    row = (model[owner] * width + local[owner]) * num_actions + graph.action[entry]
    shape = (count, width, num_actions, width)
    weight = graph.probability[entry].astype(np.float64)
    flat = np.bincount(row * width + target, weight, minlength=np.prod(shape, dtype=np.int64))
    transition = flat.reshape(shape).astype(graph.dtype)
    labels = None
    if graph.refused is not None:
        labels = np.zeros((count, width, num_actions, 1), graph.dtype)
        labels[model, local, :, 0] = graph.refused[rows.indices]
    return LocalModels(members=members, size=sizes.astype(np.int32), transition=transition, labels=labels)
