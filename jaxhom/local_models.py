"""Local models M^{s,d} and their classes up to a renaming of states.

M^{s,d} is the model restricted to s^d, the states within d steps of s by any actions; a transition that leaves
s^d becomes a self-loop on the state it leaves (Boularias and Chaib-draa 2010, section V). The centre s is state 0
of its local model; the others follow in ascending order; padding has no transitions at all.

Few local models are different: a 48 x 48 grid has nine at d = 1. `local_model_classes` finds them by their canonical
forms (see `canonical_forms`).
"""

import chex
import numpy as np
import scipy.sparse
import scipy.sparse.csgraph

from jaxhom import checks
from jaxhom.canonical_forms import canonical_forms
from jaxhom.mdp import MDP

_CHUNK_BYTES = 64 * 2**20


@chex.dataclass(frozen=True)
class LocalModels:
    """P local models padded to the size n of the largest.

    Attributes:
      members: int32 [P, n], the states of each model, centre first, then ascending; -1 on padding.
      size: int32 [P], the number of states of each model.
      transition: float [P, n, A, n], T^{s,d}; zero where either state is padding.
    """

    members: np.ndarray
    size: np.ndarray
    transition: np.ndarray


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


def reachable_within(mdp: MDP, steps: int) -> scipy.sparse.csr_array:
    """Boolean [S, S] matrix whose row s marks s^steps, the states within `steps` steps of s (s included)."""
    adjacency = _adjacency(mdp)
    reach = scipy.sparse.eye_array(mdp.num_states, dtype=bool, format="csr")
    for _ in range(steps):
        reach = (reach @ adjacency).astype(bool)
    reach.sort_indices()
    return reach


def steps_from(mdp: MDP, state: int) -> np.ndarray:
    """Least number of steps by any actions from a state to every state, float [S]; infinite where none leads."""
    return scipy.sparse.csgraph.dijkstra(_adjacency(mdp), indices=state, unweighted=True)


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
    rows = reachable_within(mdp, distance)[states]
    sizes = np.diff(rows.indptr)
    return _restrict(_HostModel(mdp), states, rows, int(sizes.max(initial=1)))


def restricted_model(mdp: MDP, states) -> np.ndarray:
    """M^E: the model restricted to the given different states [E], as a dense tensor [E, A, E].

    Transitions that leave the set become self-loops on the state they leave.

    Source: Boularias and Chaib-draa 2010, section V.
    """
    states = np.sort(_validated(mdp, states, 1))
    rows = scipy.sparse.csr_array(
        (np.ones(len(states), bool), (np.zeros(len(states), int), states)), shape=(1, mdp.num_states)
    )
    model = _restrict(_HostModel(mdp), states[:1], rows, len(states))
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
      forgives the rounding of differently ordered sums.

    Raises:
      ValueError: if a state is out of range or `distance` is below 1.
    """
    states = _validated(mdp, np.arange(mdp.num_states) if states is None else states, distance)
    rows = reachable_within(mdp, distance)[states]
    sizes = np.diff(rows.indptr)
    host = _HostModel(mdp)
    class_of_key: dict[bytes, int] = {}
    label = np.zeros(len(states), np.int32)
    first = []
    for size in np.unique(sizes):
        (same_size,) = np.nonzero(sizes == size)
        chunk = max(1, _CHUNK_BYTES // (8 * mdp.num_actions * int(size) ** 2))
        for start in range(0, len(same_size), chunk):
            index = same_size[start : start + chunk]
            models = _restrict(host, states[index], rows[index], int(size))
            keys, _ = canonical_forms(models.transition, host.quantum_bits)
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


def isomorphism(one: np.ndarray, other: np.ndarray) -> np.ndarray | None:
    """The renaming that makes two local models equal: state i of `one` is state p[i] of `other`.

    Args:
      one: [n, A, n], centre first, no padding.
      other: [m, A, m], likewise.

    Returns:
      int [n], or None where the canonical forms differ. Equal up to `model_rounding`, as within a class.
    """
    if one.shape != other.shape:
        return None
    (key, other_key), order = canonical_forms(np.stack([one, other]), _quantum_bits(one.dtype))
    if key != other_key:
        return None
    renaming = np.empty(len(one), int)
    renaming[order[0]] = order[1]
    return renaming


class _HostModel:
    """NumPy copies of a model's arrays, made once per call."""

    def __init__(self, mdp: MDP):
        self.num_states, self.num_actions = mdp.num_states, mdp.num_actions
        self.next_state = np.asarray(mdp.next_state)
        self.probability = np.asarray(mdp.probability)
        self.quantum_bits = _quantum_bits(mdp.dtype)


def _quantum_bits(dtype) -> int:
    return 40 if dtype == np.float64 else 20


def _validated(mdp: MDP, states, distance: int) -> np.ndarray:
    if checks.is_traced(mdp):
        raise ValueError("local models are found on the host: call this outside jit, vmap and grad")
    if distance < 1:
        raise ValueError(f"distance must be at least 1, got {distance}")
    states = checks.as_host_array("states", states)
    checks.require_shape("states", states, "[P]", states.ndim == 1)
    return checks.require_integers("states", states, upper=mdp.num_states)


def _adjacency(mdp: MDP) -> scipy.sparse.csr_array:
    """Boolean [S, S]: which states one step by any action, or none, leads to."""
    next_state = np.asarray(mdp.next_state)
    source, _, _ = np.nonzero(np.asarray(mdp.probability) > 0)
    target = next_state[np.asarray(mdp.probability) > 0]
    everyone = np.arange(mdp.num_states)
    ones = np.ones(len(source) + mdp.num_states, bool)
    index = (np.append(source, everyone), np.append(target, everyone))
    adjacency = scipy.sparse.coo_array((ones, index), shape=(mdp.num_states,) * 2)
    return adjacency.astype(np.int8).tocsr().astype(bool)


def _restrict(host: _HostModel, states, rows: scipy.sparse.csr_array, width: int) -> LocalModels:
    """Local models of `states`, whose members are the rows of a boolean matrix, padded to `width` states."""
    count, num_states, num_actions = len(states), host.num_states, host.num_actions
    sizes = np.diff(rows.indptr)
    model = np.repeat(np.arange(count), sizes)
    key = model * num_states + rows.indices  # ascending: rows are sorted
    is_centre = rows.indices == states[model]
    position = np.arange(len(key)) - np.repeat(rows.indptr[:-1], sizes)
    centre_position = position[is_centre][model]
    local = np.where(is_centre, 0, position + (position < centre_position))
    members = np.full((count, width), -1, np.int32)
    members[model, local] = rows.indices

    successor = host.next_state[rows.indices]  # [members, A, N]
    wanted = model[:, None, None] * num_states + successor
    found = np.minimum(np.searchsorted(key, wanted), len(key) - 1)
    inside = key[found] == wanted
    target = np.where(inside, local[found], local[:, None, None])
    row = (model * width + local)[:, None, None] * num_actions + np.arange(num_actions)[:, None]
    shape = (count, width, num_actions, width)
    weight = host.probability[rows.indices].astype(np.float64)
    flat = np.bincount((row * width + target).ravel(), weight.ravel(), minlength=np.prod(shape))
    transition = flat.reshape(shape).astype(host.probability.dtype)
    return LocalModels(members=members, size=sizes.astype(np.int32), transition=transition)
