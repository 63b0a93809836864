"""Eq. (6) after the end: what an episode that is absorbed adds to its discounted sum for ever.

An episode of T steps that ends in an absorbing state z stays there, whatever is done, and

    sum_{t >= T} gamma^t phi(z) = gamma^T phi(z) / (1 - gamma),      phi(z) the mean over the actions allowed in z.

z is the final state where that is known, else it is distributed as the absorbing successors of the last step's (s, a),
given that it led to one of them; if the last step was taken in an absorbing state, z is that state.

An episode that is not known to have terminated goes on like this only where nothing is left to decide: it was seen in
an absorbing state in which the features are the same for every action. A bandit's only state absorbs too, and what the
expert does there is a decision.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np

from jaxhom.models.mdp import MDP, absorbing_states, push_forward, uniform_policy

if TYPE_CHECKING:
    from jaxtyping import Array, Bool, Float, Int


def absorbed_time(mdp: MDP, demonstrations: Any) -> tuple[Float[Array, "S A"], Bool[Array, " M"]]:
    """Discounted time that the episodes spend absorbed after their ends.

    Args:
      mdp: the model.
      demonstrations: M trajectories.

    Returns:
      pairs: [S, A], summed over episodes.
      is_lost: bool [M], the episodes that terminated where the model does not absorb; they add nothing.
    """
    absorbing = absorbing_states(mdp)
    length, state, action = _last_steps(demonstrations)
    final = demonstrations.final_states
    is_known, is_settled = final >= 0, absorbing & _ignores_actions(mdp)
    into = _probability_into(mdp, absorbing)  # [S, A]
    from_pair = ~is_known & (length > 0) & (into[state, action] > 0) & (demonstrations.terminated | is_settled[state])
    in_final = is_known & absorbing[final] & (demonstrations.terminated | is_settled[final])
    weight = mdp.discount**length / (1.0 - mdp.discount)
    left = jnp.zeros(into.shape, mdp.dtype).at[state, action].add(jnp.where(from_pair, weight, 0.0))
    pushed = push_forward(mdp, left / jnp.where(into > 0, into, 1.0))
    stays = jnp.where(absorbing, pushed, 0.0).at[final].add(jnp.where(in_final, weight, 0.0))
    return stays[:, None] * uniform_policy(mdp), demonstrations.terminated & ~from_pair & ~in_final


def refuse_lost(demonstrations: Any, is_lost: Bool[np.ndarray, " M"]) -> None:
    """Raises `ValueError` naming the first of the episodes that terminated where nothing absorbs."""
    if not is_lost.any():
        return
    lost = int(is_lost.argmax())
    length, state, action = (int(column[lost]) for column in _last_steps(demonstrations))
    final = int(demonstrations.final_states[lost])
    if final >= 0:
        where = f"in state {final}, which is not absorbing in this model"
    elif length:
        where = f"after state {state}, action {action}, which lead to no absorbing state of this model"
    else:
        where = "without a step or a final state"
    raise ValueError(f"trajectory {lost} terminated {where}: if it was cut off there, its `terminated` must be False")


def _last_steps(demonstrations: Any) -> tuple[Int[Array, " M"], Int[Array, " M"], Int[Array, " M"]]:
    """Steps [M] up to the last that the mask shows, and that one's state and action; 0, 0, 0 where there is none."""
    mask = demonstrations.mask
    length = jnp.where(mask.any(axis=1), mask.shape[1] - mask[:, ::-1].argmax(axis=1), 0)
    rows, last = jnp.arange(len(mask)), jnp.maximum(length - 1, 0)
    columns = (jnp.where(length > 0, array[rows, last], 0) for array in (demonstrations.states, demonstrations.actions))
    return length, *columns


def _ignores_actions(mdp: MDP) -> Bool[Array, " S"]:
    """The features are the same for all actions that are allowed there."""
    exists = mdp.allowed[..., None]
    highest = jnp.where(exists, mdp.features, -jnp.inf).max(axis=1)
    return (highest == jnp.where(exists, mdp.features, jnp.inf).min(axis=1)).all(axis=-1)


def _probability_into(mdp: MDP, states: Bool[Array, " S"]) -> Float[Array, "S A"]:
    """The probability that a step leads into one of the given states."""
    return jnp.where(states[mdp.next_state], mdp.probability, 0.0).sum(axis=-1)
