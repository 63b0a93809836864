"""From what users have to the arrays of a model: checks on the host, and the choice of the layout.

A tensor [S, A, S] and lists of successors [S, A, N] both become ascending lists without repetitions; where N is near S
these are the tensor itself (`dense_tensor`), elsewhere lists with their transpose (`successor_lists`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jaxhom import checks
from jaxhom.models.dense_tensor import DenseTensor
from jaxhom.models.successor_lists import SuccessorLists

if TYPE_CHECKING:
    import jax
    from jax.typing import DTypeLike
    from jaxtyping import ArrayLike, Bool, Float, Int

    from jaxhom.models.dynamics import Dynamics

    Lists = tuple[Int[np.ndarray, "S A N"], Float[np.ndarray, "S A N"], Bool[np.ndarray, "S A"]]

_DENSE_FRACTION = 0.25  # dense layout from N >= S / 4 on, where products beat gathers


def lists_of_tensor(transition: Float[ArrayLike, "S A S"], allowed: Bool[ArrayLike, "S A"] | None) -> Lists:
    """Successors, probabilities and allowed actions of a transition tensor, checked; N = S where they are many.

    Raises:
      ValueError: see `MDP.from_dense`.
    """
    transition = checks.as_host_array("transition", transition)
    shape = transition.shape
    good = len(shape) == 3 and shape[0] == shape[2] and min(shape, default=0) > 0
    checks.require_shape("transition", transition, "[S, A, S] with S, A >= 1", good)
    checks.require_slots(*shape)
    allowed = check_allowed(allowed, shape[:2])
    transition = checks.require_distribution("transition", transition, None if allowed.all() else allowed)
    num_states = shape[0]
    width = int((transition > 0).sum(axis=-1).max())
    if width >= _DENSE_FRACTION * num_states:
        return np.broadcast_to(np.arange(num_states, dtype=np.int32), shape), transition, allowed
    return *_compress(transition, width), allowed


def lists_of_successors(
    next_state: Int[ArrayLike, "S A N"], probability: Float[ArrayLike, "S A N"], allowed: Bool[ArrayLike, "S A"] | None
) -> Lists:
    """Successors, probabilities and allowed actions of lists as users have them, checked; N = S where they are many.

    Raises:
      ValueError: see `MDP.from_successors`.
    """
    next_state = checks.as_host_array("next_state", next_state)
    probability = checks.as_host_array("probability", probability)
    good = next_state.ndim == 3 and min(next_state.shape) > 0
    checks.require_shape("next_state", next_state, "[S, A, N] with S, A, N >= 1", good)
    same = probability.shape == next_state.shape
    checks.require_shape("probability", probability, str(next_state.shape), same)
    checks.require_slots(*next_state.shape)
    allowed = check_allowed(allowed, next_state.shape[:2])
    if not allowed.all():
        next_state = np.where(allowed[..., None], next_state, 0)
    next_state = checks.require_integers("next_state", next_state, upper=len(next_state))
    probability = checks.require_distribution("probability", probability, None if allowed.all() else allowed)
    next_state, probability = _merge_repeated(next_state, probability)
    num_states, num_actions, width = next_state.shape
    if width >= _DENSE_FRACTION * num_states:
        checks.require_slots(num_states, num_actions, num_states)
        return lists_of_tensor(_scatter_dense(next_state, probability), allowed)
    return next_state, probability, allowed


def make_dynamics(
    next_state: Int[np.ndarray, "S A N"], probability: Float[np.ndarray, "S A N"], dtype: DTypeLike
) -> Dynamics:
    """The transitions on the device, in the layout that their lists have; the one place where it is chosen."""
    if next_state.shape[2] == next_state.shape[0]:
        return DenseTensor(
            next_state=checks.to_device(next_state, np.int32), probability=checks.to_device(probability, dtype)
        )
    return SuccessorLists.from_host(next_state, probability, dtype)


def check_allowed(allowed: Bool[ArrayLike, "S A"] | None, shape: tuple[int, int]) -> Bool[np.ndarray, "S A"]:
    """Which actions exist, all if None, or raises."""
    if allowed is None:
        return np.ones(shape, bool)
    allowed = checks.as_host_array("allowed", allowed)
    checks.require_shape("allowed", allowed, str(tuple(shape)), allowed.shape == tuple(shape))
    if allowed.dtype != bool:
        raise ValueError(f"allowed must be bool, got dtype {allowed.dtype}")
    some = allowed.any(axis=1)
    if not some.all():
        raise ValueError(f"allowed[{int(np.argmin(some))}] allows no action: a state needs one at least")
    return allowed


def check_initial(initial: Float[ArrayLike, " S"] | None, num_states: int) -> Float[np.ndarray, " S"]:
    """The distribution of the first state, uniform if None, or raises."""
    if initial is None:
        initial = np.full(num_states, 1.0 / num_states)
    initial = checks.as_host_array("initial", initial)
    checks.require_shape("initial", initial, f"({num_states},)", initial.shape == (num_states,))
    return checks.require_distribution("initial", initial)


def check_features(
    features: Float[ArrayLike, "S A K"] | Float[ArrayLike, "S K"] | None,
    allowed: Bool[np.ndarray, "S A"],
    dtype: DTypeLike,
) -> Float[np.ndarray, "S A K"]:
    """Features per pair in the model's type, zero where an action is not allowed, or raises."""
    num_states, num_actions = allowed.shape
    if features is None:
        return np.zeros((num_states, num_actions, 0))
    features = checks.as_host_array("features", features)
    by_state = features.ndim == 2 and len(features) == num_states
    by_pair = features.ndim == 3 and features.shape[:2] == (num_states, num_actions)
    expected = f"({num_states}, {num_actions}, K) or ({num_states}, K)"
    checks.require_shape("features", features, expected, by_state or by_pair)
    if by_pair and not allowed.all():
        features = np.where(allowed[..., None], features, 0)  # whatever is there is not looked at
    features = checks.require_floats_in(dtype, "features", features)
    if by_pair:
        return features
    features = np.broadcast_to(features[:, None], (num_states, num_actions, features.shape[-1]))
    return features if allowed.all() else np.where(allowed[..., None], features, 0)


def check_contraction(probability: Float[ArrayLike, "S A N"] | jax.Array, discount: Float[ArrayLike, ""]) -> None:
    """Raises where a sum within the tolerance of 1 makes discounted sums diverge all the same."""
    total = np.asarray(probability).sum(axis=-1, dtype=np.float64)
    message = f"is too far above 1 for a discount of {discount}"
    checks.require_all("sum of probability", total, total * np.float64(discount) < 1.0, message)


def _compress(transition: Float[np.ndarray, "S A S"], width: int) -> tuple[np.ndarray, np.ndarray]:
    """[S, A, S] -> successors (ascending, padding last) and probabilities, [S, A, width]."""
    s, a, z = np.nonzero(transition)
    shape = transition.shape[:2]
    pair = s * shape[1] + a
    start = np.searchsorted(pair, np.arange(shape[0] * shape[1]))
    slot = np.arange(len(pair)) - start[pair]
    next_state = np.zeros((*shape, width), np.int32)
    probability = np.zeros((*shape, width), transition.dtype)
    next_state[s, a, slot] = z
    probability[s, a, slot] = transition[s, a, z]
    return next_state, probability


def _merge_repeated(next_state, probability) -> tuple[np.ndarray, np.ndarray]:
    """Sorts each row by successor, adds repeated ones up, and drops slots that no row uses.

    Done on the entries alone: with one row of thousands of successors nearly all of the arrays is padding.
    """
    num_states, num_actions, slots = next_state.shape
    entry = np.flatnonzero(probability > 0)
    key = entry // slots * num_states + next_state.ravel()[entry]
    order = np.argsort(key, kind="stable")
    key, entry = key[order], entry[order]
    begin = np.flatnonzero(np.append(True, key[1:] != key[:-1]))
    merged = np.add.reduceat(probability.ravel()[entry], begin)
    pair, successor = np.divmod(key[begin], num_states)
    slot = np.arange(len(pair)) - np.searchsorted(pair, pair)
    shape = (num_states * num_actions, int(slot.max()) + 1)
    merged_state, merged_probability = np.zeros(shape, np.int32), np.zeros(shape, probability.dtype)
    merged_state[pair, slot], merged_probability[pair, slot] = successor, merged
    shape = (num_states, num_actions, -1)
    return merged_state.reshape(shape), merged_probability.reshape(shape)


def _scatter_dense(next_state, probability) -> np.ndarray:
    """Successors without repetitions -> [S, A, S]."""
    states, actions, _ = next_state.shape
    transition = np.zeros((states, actions, states), probability.dtype)
    s, a = np.ogrid[:states, :actions]
    np.add.at(transition, (s[..., None], a[..., None], next_state), probability)
    return transition
