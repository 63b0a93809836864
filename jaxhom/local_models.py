"""Local models M^{s,d} and their classes up to a renaming of states.

M^{s,d} is the model restricted to s^d, the states within d steps of s by any actions; a transition that leaves
s^d becomes a self-loop on the state it leaves (Boularias and Chaib-draa 2010, section V). The centre s is state 0
of its local model; the others follow in ascending order; padding has no transitions at all.

Few local models are different: a 48 x 48 grid has nine at d = 1. `local_model_classes` finds them by colour
refinement: every state of a local model gets a hash of its own colour and of the probabilities and colours of
what it leads to and what leads to it, repeatedly; sorting by colour gives a canonical order, and two states are
put into one class only if their models, brought into canonical order, are equal to the entry. A hash that
collides or a tie that is broken badly can miss an isomorphism, which costs time, but never invent one.
"""

import chex
import numpy as np
import scipy.sparse

from jaxhom import checks
from jaxhom.mdp import MDP

_CHUNK_BYTES = 64 * 2**20
_MAX_ONE_BY_ONE = 32  # larger models have their ties broken all at once
_SEED = np.uint64(0x9E3779B97F4A7C15)


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
            for i, key in zip(index, _canonical_keys(models.transition, host.quantum_bits), strict=True):
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


def _canonical_keys(transition: np.ndarray, bits: int) -> list[bytes]:
    """Bytes that are equal only if two models of the same size are equal up to renaming, [P, n, A, n] -> P."""
    quanta = np.rint(transition.astype(np.float64) * 2.0**bits).astype(np.uint64)
    count, size = quanta.shape[:2]
    colour = np.broadcast_to(np.where(np.arange(size) == 0, 1, 2).astype(np.uint64), (count, size))
    colour = _refine(quanta, colour)
    active = np.arange(count)
    while True:
        tied = _tied(colour[active])
        active = active[tied.any(axis=1)]
        if not active.size:
            break
        colour[active] = _refine(quanta[active], _break_ties(colour[active], tied[tied.any(axis=1)]))
    order = np.argsort(np.where(np.arange(size) == 0, np.uint64(0), colour), axis=1, kind="stable")
    rows = np.take_along_axis(quanta, order[:, :, None, None], axis=1)
    canonical = np.take_along_axis(rows, order[:, None, None, :], axis=3)
    return [model.tobytes() for model in canonical]


def _refine(quanta: np.ndarray, colour: np.ndarray) -> np.ndarray:
    """Colour refinement to a stable partition; colours are [P, n] hashes that do not depend on the order.

    A model stops when its own partition is stable: its colours must not depend on the models beside it.
    """
    action = np.arange(quanta.shape[2], dtype=np.uint64)[:, None]
    present = quanta > 0
    edge = _mix(quanta * np.uint64(31) + action)
    colour, active = colour.copy(), np.arange(len(colour))
    while active.size:
        old = colour[active]
        leads_to = np.where(present, _mix(edge + old[:, None, None, :]), np.uint64(0))
        led_to_by = np.where(present, _mix(edge ^ _mix(old)[:, :, None, None]), np.uint64(0))
        outgoing, incoming = leads_to.sum(axis=(2, 3)), led_to_by.sum(axis=(1, 2))
        colour[active] = _mix(old + _mix(outgoing) + _mix(_mix(incoming)))
        refines = _num_colours(colour[active]) != _num_colours(old)
        active, edge, present = active[refines], edge[refines], present[refines]
    return colour


def _num_colours(colour: np.ndarray) -> np.ndarray:
    """Number of different colours in each row."""
    ordered = np.sort(colour, axis=1)
    return 1 + (ordered[:, 1:] != ordered[:, :-1]).sum(axis=1)


def _tied(colour: np.ndarray) -> np.ndarray:
    """Marks, per row, the states whose colour another state has too."""
    order = np.argsort(colour, axis=1, kind="stable")
    ordered = np.take_along_axis(colour, order, axis=1)
    equal = np.zeros((len(colour), colour.shape[1] + 1), bool)
    equal[:, 1:-1] = ordered[:, 1:] == ordered[:, :-1]
    tied = np.zeros(colour.shape, bool)
    np.put_along_axis(tied, order, equal[:, 1:] | equal[:, :-1], axis=1)
    return tied


def _break_ties(colour: np.ndarray, tied: np.ndarray) -> np.ndarray:
    """Gives one state of the smallest tied colour a colour of its own; all tied states if the model is large."""
    rank = np.arange(colour.shape[1], dtype=np.uint64)
    if colour.shape[1] > _MAX_ONE_BY_ONE:
        return np.where(tied, _mix(colour + rank), colour)
    chosen = np.argmin(np.where(tied, colour, np.iinfo(np.uint64).max), axis=1)[:, None]
    return np.where(rank == chosen, _mix(colour + np.uint64(7)), colour)


def _mix(value: np.ndarray) -> np.ndarray:
    """The finaliser of splitmix64 (Steele, Lea and Flood 2014), modulo 2^64."""
    value = value + _SEED
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return value ^ (value >> np.uint64(31))
