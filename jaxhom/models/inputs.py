"""What users pass beside a model: brought to one form, and checked, in one place for all doors of the library.

Values are checked where they are concrete; under jit, vmap and grad only shapes are.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom import checks
from jaxhom.models.mdp import MDP

if TYPE_CHECKING:
    from jaxtyping import Array, ArrayLike, Bool, Float, Int, Num

_FAR = 1e150  # of coordinates: squares of larger ones are infinite


def as_model(mdp: Any) -> MDP:
    """The model itself, or that of an environment or domain (whatever has it as `.mdp`); the doors' first line."""
    model = getattr(mdp, "mdp", mdp)
    if not isinstance(model, MDP):
        raise ValueError(f"a jaxhom.MDP is needed, or what has one as .mdp, got {type(mdp).__name__}")
    if getattr(model.discount, "ndim", 0):
        raise ValueError(f"this is a stack of {len(model.discount)} models: map the function with jax.vmap over it")
    return model


def check_policy(mdp: MDP, policy: Any, name: str = "policy", *, batch: bool = True) -> Float[Array, "*B S A"]:
    """The policy as probabilities in the model's type, whatever form it was given in; every door's one check.

    Args:
      mdp: the model.
      policy: [S, A] or, with `batch`, [B, S, A], rows sum to 1 (within `row_tolerance`, and are then
        brought there); integers [S], the action of every state; or what has one of these as `.policy`
        (a `Plan`, a `Generalization`).
      name: what to call it in messages.
      batch: whether [B, S, A] is accepted.

    Raises:
      ValueError: on another shape; where values are concrete also on entries that are NaN or negative, rows that do
        not sum to 1, and probability on an action that is not allowed, naming the first.
    """
    policy = require_policy_shape(mdp, policy, name, batch=batch)
    is_traced = checks.is_traced(mdp, policy)
    if policy.ndim == 1:
        if not is_traced:
            policy = checks.require_integers(name, policy, upper=mdp.num_actions)
            return checks.to_device(_allowed_only(mdp, name, np.eye(mdp.num_actions)[policy]), mdp.dtype)
        return jax.nn.one_hot(policy, mdp.num_actions, dtype=mdp.dtype)
    if is_traced:
        return jnp.asarray(policy, mdp.dtype)
    policy = checks.require_distribution(name, policy, axes=_axes(mdp, policy.ndim))
    return checks.to_device(_allowed_only(mdp, name, policy), mdp.dtype)


def _axes(mdp: MDP, ndim: int) -> checks.Axes:
    """What messages call the indices of an array [..., S, A]."""
    return (*[None] * (ndim - 2), mdp.state_names, mdp.action_names)


def _allowed_only(mdp: MDP, name: str, policy: Float[np.ndarray, "*B S A"]) -> Float[np.ndarray, "*B S A"]:
    """The policy, or `ValueError` where it takes an action that is not allowed."""
    if mdp.restricts_actions:
        message = "is an action that is not allowed there"
        good = (policy == 0) | np.asarray(mdp.allowed)
        checks.require_all(name, policy, good, message, axes=_axes(mdp, policy.ndim))
    return policy


def require_policy_shape(mdp: MDP, policy: Any, name: str = "policy", *, batch: bool = True) -> Array | np.ndarray:
    """The policy as an array of one of the forms of `check_policy`, its values not looked at; or `ValueError`."""
    policy = getattr(policy, "policy", policy)
    if not isinstance(policy, jax.core.Tracer):
        policy = checks.as_host_array(name, policy)
    states, actions = mdp.num_states, mdp.num_actions
    if policy.shape == (states,) and jnp.issubdtype(policy.dtype, jnp.integer):
        return policy
    good = policy.ndim in ((2, 3) if batch else (2,)) and policy.shape[-2:] == (states, actions)
    checks.require_shape(name, policy, f"({states}, {actions})" + f" or (B, {states}, {actions})" * batch, good)
    return policy


def check_states(mdp: MDP, states: Int[ArrayLike, " P"], name: str = "states") -> Int[np.ndarray, " P"]:
    """Numbers of states, on the host.

    Raises:
      ValueError: if they are not [P], or one is no whole number in [0, S); under jit, vmap and grad.
    """
    states = checks.as_host_array(name, states)
    checks.require_shape(name, states, "[P]", states.ndim == 1)
    return checks.require_integers(name, states, upper=mdp.num_states)


def check_coordinates(mdp: MDP, coordinates: Float[ArrayLike, "S D"]) -> Float[np.ndarray, "S D"]:
    """Positions of the states, in any number D of dimensions, on the host; traced ones as they are.

    Raises:
      ValueError: if they are not [S, D], or one is not finite, or so large that no distance is.
    """
    is_traced = checks.is_traced(coordinates)
    coordinates = coordinates if is_traced else checks.as_host_array("coordinates", coordinates)
    good = coordinates.ndim == 2 and len(coordinates) == mdp.num_states
    checks.require_shape("coordinates", coordinates, f"({mdp.num_states}, D)", good)
    if is_traced:
        return coordinates
    coordinates = checks.require_floats("coordinates", coordinates)
    is_near = np.abs(coordinates.astype(np.float64)) <= _FAR
    checks.require_all("coordinates", coordinates, is_near, f"must not be above {_FAR:.0e} in size")
    return coordinates


def require_features(mdp: MDP) -> None:
    """Raises unless the model has features."""
    if not mdp.num_features:
        raise ValueError("the model has no features: build it with features=[S, A, K], K >= 1")


def check_reward(
    mdp: MDP, reward: Num[ArrayLike, "*B S A"], policy_shape: tuple[int, ...]
) -> Float[Array | np.ndarray, "*B S A"]:
    """A reward that goes with a policy, in the model's type; 0 where an action is not allowed.

    Args:
      mdp: the model.
      reward: [S, A], or [B, S, A] beside a batch of policies.
      policy_shape: (S, A) or (B, S, A), or (S,) of actions.

    Raises:
      ValueError: if the shape does not fit, or a concrete value is not finite.
    """
    pair = (mdp.num_states, mdp.num_actions)
    if not checks.is_traced(reward):
        reward = checks.as_host_array("reward", reward)
    good = reward.shape == pair or (len(policy_shape) == 3 and reward.shape == tuple(policy_shape))
    checks.require_shape("reward", reward, f"{pair} or the policy's", good)
    return check_reward_values(mdp, reward)


def check_reward_values(
    mdp: MDP, reward: Num[ArrayLike, "..."], *, forbidden: float = 0.0, may_forbid: bool = False
) -> Float[Array | np.ndarray, "..."]:
    """Rewards [..., S, A] or [..., S] in the model's type; `forbidden` stands where an action is not allowed.

    In NumPy where they are concrete.

    Raises:
      ValueError: naming the first concrete value that is NaN or infinite; with `may_forbid`, -inf is accepted.
    """
    if checks.is_traced(reward):
        reward = jnp.asarray(reward, mdp.dtype)
    else:
        host = checks.as_host_array("reward", reward)
        with_actions = host.shape[-2:] == (mdp.num_states, mdp.num_actions)
        if mdp.restricts_actions and with_actions and not checks.is_traced(mdp.allowed):
            host = np.where(np.asarray(mdp.allowed), host, np.zeros_like(host))
        minus = (host == -np.inf) if may_forbid and host.dtype.kind == "f" else np.zeros(host.shape, bool)
        axes = _axes(mdp, host.ndim) if with_actions else ()
        finite = checks.require_floats_in(mdp.dtype, "reward", np.where(minus, np.zeros_like(host), host), axes)
        reward = np.where(minus, -np.inf, finite).astype(mdp.dtype)
    if mdp.restricts_actions and reward.shape[-2:] == (mdp.num_states, mdp.num_actions):
        xp = checks.arrays_of(mdp.allowed, reward)
        reward = xp.where(xp.asarray(mdp.allowed), reward, forbidden)
    return reward


def check_labels(
    mdp: MDP,
    labels: Num[ArrayLike, "S A L"] | Num[ArrayLike, "S L"] | Num[ArrayLike, "S A"],
    label_weight: Num[ArrayLike, ""] = 1.0,
    name: str = "labels",
) -> Float[Array | np.ndarray, "S A L"]:
    """Labels that maps between states have to keep, for every pair, in the model's type; times their weight.

    In NumPy where they are concrete. Where an action is not allowed they count as given, and as 0 where not finite.

    Args:
      mdp: the model.
      labels: [S, A, L], or [S, L] for labels of the state, which count for every action. [S, A], a reward say, is one
        label of every action.
      label_weight: scalar, not negative.
      name: what to call the labels in messages.

    Raises:
      ValueError: if a shape does not fit; where values are concrete also if the weight is negative, or naming the first
        entry that is not finite where its action is allowed, or is larger than the root of what the model's type holds.
    """
    states, actions = mdp.num_states, mdp.num_actions
    is_traced = checks.is_traced(labels, mdp.allowed)
    xp = jnp if is_traced else np
    labels = jnp.asarray(labels, mdp.dtype) if is_traced else checks.as_host_array(name, labels)
    by_state = labels.ndim == 2 and labels.shape[0] == states and labels.shape != (states, actions)
    if labels.shape == (states, actions):
        labels = labels[..., None]
    by_pair = labels.ndim == 3 and labels.shape[:2] == (states, actions)
    checks.require_shape(name, labels, f"({states}, {actions}, L) or ({states}, L)", by_state or by_pair)
    checks.require_shape("label_weight", label_weight, "()", np.ndim(label_weight) == 0)
    checks.require_positive("label_weight", label_weight, or_zero=True)
    if by_pair and mdp.restricts_actions and labels.dtype.kind == "f":
        labels = xp.where(xp.asarray(mdp.allowed)[..., None] | xp.isfinite(labels), labels, 0)
    if not is_traced:
        labels = checks.require_floats_in(mdp.dtype, name, labels)
    if is_traced or checks.is_traced(label_weight):
        labels = jnp.asarray(labels, mdp.dtype) * jnp.asarray(label_weight, mdp.dtype)
    else:
        with np.errstate(over="ignore"):
            weighted = labels * np.asarray(label_weight, mdp.dtype)
        labels = checks.require_floats_in(mdp.dtype, f"label_weight * {name}", weighted)
        most = float(np.finfo(mdp.dtype).max) ** 0.5
        checks.require_all(name, labels, np.abs(labels) <= most, f"must be at most {most:.1g} in size")
    xp = np if isinstance(labels, np.ndarray) else jnp
    return labels if by_pair else xp.broadcast_to(labels[:, None], (states, actions, labels.shape[-1]))


def asked_states(mdp: MDP, states: Bool[ArrayLike, " S"] | None) -> Bool[Array | np.ndarray, " S"]:
    """The states that something is wanted for, all if None; in NumPy where they are concrete.

    Raises:
      ValueError: if they are not bool [S]. Numbers of states are no mask.
    """
    if states is None:
        return np.ones(mdp.num_states, bool)
    states = states if checks.is_traced(states) else checks.as_host_array("states", states)
    checks.require_shape("states", states, f"({mdp.num_states},)", states.shape == (mdp.num_states,))
    if states.dtype != bool:
        raise ValueError(f"states must be a mask of booleans, got dtype {states.dtype}")
    return states
