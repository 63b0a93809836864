"""Local models M^{s,d}: what a state leads to within d steps, as small models of their own.

M^{s,d} is the model restricted to s^d, the states within d steps of s by any actions; a transition that leaves
s^d becomes a self-loop on the state it leaves (Boularias and Chaib-draa 2010, section V). The centre s is state 0
of its local model; the others follow in ascending order; padding has no transitions at all.

Models may carry labels of states and actions, which a map has to keep (`homomorphism_lp`). Actions that some states
lack lead to one more absorbing state, "refused", that all local models share, that is mapped to itself and to which
nothing else is mapped. That is one more label, 1 where an action is not allowed; the rows of such actions are zero.
"""

from __future__ import annotations

import numpy as np
import scipy

from jaxhom import checks
from jaxhom.models.graph import HostGraph, host_graph
from jaxhom.models.inputs import check_states
from jaxhom.models.mdp import MDP
from jaxhom.models.padded_rows import rows_and_places
from jaxhom.status import Record

_MAX_ENTRIES = 2**24  # of a transition tensor: 128 MB in float64
_MAX_INDICES = 2**26  # of local models inside programs: 256 MB


class LocalModels(Record):
    """P local models padded to the size n of the largest.

    Attributes:
      members: int32 [P, n], the states of each model, centre first, then ascending; -1 on padding.
      size: int32 [P], the number of states of each model.
      transition: float [P, n, A, n], T^{s,d}; zero where either state is padding, and where an action is not allowed.
      labels: float [P, n, A, L], zero on padding: the labels that were given, and last, where some state lacks some
        action, 1 where an action is not allowed. None where there are neither.
    """

    members: np.ndarray
    size: np.ndarray
    transition: np.ndarray
    labels: np.ndarray | None = None


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
    states = validated_states(mdp, states, distance)
    maker = LocalModelMaker(host_graph(mdp), distance)
    members = maker.members(states)
    return maker.make(states, int(np.diff(members.indptr).max(initial=1)), members)


class LocalIndices(Record):
    """Where the numbers of P local models are found among a model's: what programs read instead of a graph.

    Attributes:
      members: int32 [P, n], as in `LocalModels`.
      size: int32 [P], likewise.
      successor: int32 [P, n, A, N], the number in the local model of the state that each slot of each member leads to,
        its own where that is no member; n where the slot has no successor.
    """

    members: np.ndarray
    size: np.ndarray
    successor: np.ndarray


def local_indices(graph: HostGraph, next_state: np.ndarray, is_open: np.ndarray, states, distance: int) -> LocalIndices:
    """Indices of M^{s,d} for each of the given states.

    Args:
      graph: with the open slots as its transitions.
      next_state: int [S, A, N].
      is_open: bool [S, A, N], the slots that hold a successor.
      states: int [P].
      distance: d >= 1.

    Raises:
      ValueError: if they are more than 2^26.
    """
    rows = graph.reach(states, distance)
    sizes = np.diff(rows.indptr)
    width, (_, num_actions, slots) = int(sizes.max(initial=1)), next_state.shape
    if len(states) * width * num_actions * slots > _MAX_INDICES:
        raise ValueError(
            f"{len(states)} local models of up to {width} states with {num_actions} actions and {slots} successors "
            f"have {len(states)} x {width} x {num_actions} x {slots} indices, more than 2^26: ask for fewer states at "
            "a time, concrete ones, or for a smaller distance"
        )
    members, model, local, position = _numbered(states, rows, width)
    own = local[:, None, None]
    successor = np.full((*members.shape, num_actions, slots), width, np.int32)
    found = position(model[:, None, None], next_state[rows.indices], own)
    successor[model, local] = np.where(is_open[rows.indices], found, width)
    return LocalIndices(members=members, size=sizes.astype(np.int32), successor=successor)


class LocalModelMaker:
    """Builds local models of one distance, some at a time, padded to any width.

    Args:
      graph: of the model.
      distance: d >= 1.
      labels: [S, A, L], what a map has to keep besides transitions; None for nothing.

    Attributes:
      graph, distance: as given.
      labels: [S, A, L], those that were given and the one of actions that are not allowed; None where neither is.
      label_size: a power of two that no label exceeds, 1 at least.
    """

    def __init__(self, graph: HostGraph, distance: int, labels: np.ndarray | None = None):
        self.graph, self.distance = graph, distance
        refused = None if graph.refused is None else graph.refused[..., None]
        parts = [part.astype(graph.dtype) for part in (labels, refused) if part is not None and part.size]
        self.labels = np.concatenate(parts, axis=2) if parts else None
        largest = 0.0 if self.labels is None else float(np.abs(self.labels).max(initial=0.0))
        self.label_size = 2.0 ** min(np.ceil(np.log2(max(largest, 1.0))), 1023.0)

    def scaled(self, labels: np.ndarray | None) -> np.ndarray | None:
        """Labels of at most about 1, in float64."""
        return None if labels is None else labels.astype(np.float64) / self.label_size

    def members(self, states: np.ndarray) -> scipy.sparse.csr_array:
        """Boolean [P, S], sorted: the states of each model."""
        return self.graph.reach(states, self.distance)

    def make(self, states: np.ndarray, width: int, members: scipy.sparse.csr_array | None = None) -> LocalModels:
        """M^{s,d} of the given states, none of them larger than `width`; `members` where they are known."""
        members = self.members(states) if members is None else members
        return _restrict(self.graph, states, members, width, self.labels)


def restricted_model(mdp: MDP, states) -> np.ndarray:
    """M^E: the model restricted to the given different states [E], as a dense tensor [E, A, E].

    Transitions that leave the set become self-loops on the state they leave.

    Source: Boularias and Chaib-draa 2010, section V.
    """
    states = np.sort(validated_states(mdp, states, 1))
    rows = scipy.sparse.csr_array(
        (np.ones(len(states), bool), (np.zeros(len(states), int), states)), shape=(1, mdp.num_states)
    )
    model = _restrict(host_graph(mdp), states[:1], rows, len(states))
    order = np.argsort(model.members[0])  # the first state is its centre, and so already in place
    return model.transition[0][order][..., order]


def is_oversized(size: np.ndarray, num_actions: int) -> np.ndarray:
    """Whether a local model of so many states is too large to be told from others or mapped: hubs of thousands."""
    return np.asarray(size, np.int64) ** 2 * num_actions > _MAX_ENTRIES


def require_concrete(mdp: MDP) -> None:
    """Raises `ValueError` on a traced model."""
    if checks.is_traced(mdp):
        raise ValueError("local models are found on the host: call this outside jit, vmap and grad")


def validated_states(mdp: MDP, states, distance: int) -> np.ndarray:
    """States [P] as integers, or `ValueError`; a traced model or a distance below 1 is refused too."""
    require_concrete(mdp)
    checks.require_count("distance", distance)
    return check_states(mdp, states)


def _restrict(graph: HostGraph, states, rows: scipy.sparse.csr_array, width: int, labels=None) -> LocalModels:
    """Local models of `states`, whose members are the rows of a boolean matrix, padded to `width` states."""
    count, num_actions = len(states), graph.num_actions
    members, model, local, position = _numbered(states, rows, width)
    owner, entry = graph.entries_of(rows.indices)
    target = position(model[owner], graph.successor[entry], local[owner])
    row = (model[owner] * width + local[owner]) * num_actions + graph.action[entry]
    shape = (count, width, num_actions, width)
    weight = graph.probability[entry].astype(np.float64)
    flat = np.bincount(row * width + target, weight, minlength=np.prod(shape, dtype=np.int64))
    transition = flat.reshape(shape).astype(graph.dtype)
    marks = None
    if labels is not None:
        marks = np.zeros((count, width, *labels.shape[1:]), graph.dtype)
        marks[model, local] = labels[rows.indices]
    return LocalModels(members=members, size=np.diff(rows.indptr).astype(np.int32), transition=transition, labels=marks)


def _numbered(states, rows: scipy.sparse.csr_array, width: int):
    """The members of local models, int32 [P, width]; of each, the model and its number there; and `position`.

    `position(model, state, otherwise)` looks up numbers of states in models, `otherwise` where a state is no member.
    """
    count, num_states = rows.shape
    model, place = rows_and_places(np.diff(rows.indptr))
    key = model * num_states + rows.indices  # ascending: rows are sorted
    is_centre = rows.indices == states[model]
    centre_place = place[is_centre][model]
    local = np.where(is_centre, 0, place + (place < centre_place))
    members = np.full((count, width), -1, np.int32)
    members[model, local] = rows.indices

    def position(model, state, otherwise):
        wanted = model * num_states + state
        found = np.minimum(np.searchsorted(key, wanted), len(key) - 1)
        return np.where(key[found] == wanted, local[found], otherwise)

    return members, model, local, position
