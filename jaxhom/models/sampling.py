"""Walks of a policy through a model, drawn step by step: what `sample_demonstrations` runs."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from jaxhom import checks
from jaxhom.models.mdp import MDP
from jaxhom.programs import quick_jit

if TYPE_CHECKING:
    from jaxtyping import Array, Bool, Float, Int, Key

_SHORT = 1024  # entries of a row
_FEW_STEPS = 100_000  # of all walks, up to which they are drawn in less time than a better program compiles


def sample_walks(
    key: Key[Array, ""], mdp: MDP, policy: Float[Array, "S A"], terminal: Bool[Array, " S"] | None, *counts: int
) -> dict[str, Array]:
    """Walks of at most H steps from the initial distribution; a walk stays where it met a terminal state.

    Args:
      key: of the draws.
      mdp: the model. policy: [S, A]. terminal: bool [S], or None.
      counts: M walks, H steps.

    Returns:
      Fields of `Demonstrations`: `states`, `actions` and `mask` [M, H], 0 where a walk has ended; where states are
      terminal also `terminated` and `final_states` [M].
    """
    is_little = checks.is_at_hand(key, mdp, policy, terminal) and counts[0] * counts[1] <= _FEW_STEPS
    return (_little_program if is_little else _program)(key, mdp, policy, terminal, *counts)


def _walks(
    key: Key[Array, ""],
    mdp: MDP,
    policy: Float[Array, "S A"],
    terminal: Bool[Array, " S"] | None,
    num_walks: int,
    horizon: int,
) -> dict[str, Array]:
    """`sample_walks`."""
    mdp, policy = jax.lax.stop_gradient((mdp, policy))  # draws are constants
    initial_key, steps_key = jax.random.split(key)
    lanes = (num_walks,)
    uniform = jax.random.uniform(initial_key, lanes, mdp.dtype)
    first = jax.vmap(_inverse_cdf, in_axes=(None, 0))(jnp.cumsum(mdp.initial), uniform)
    draw = jax.vmap(_inverse_cdf)
    ends = jnp.zeros(mdp.num_states, bool) if terminal is None else terminal

    def step(state, key):
        draw_action, draw_successor = jax.random.uniform(key, (2, *lanes), mdp.dtype)
        action = draw(jnp.cumsum(policy[state], axis=-1), draw_action)
        slot = draw(jnp.cumsum(mdp.probability[state, action], axis=-1), draw_successor)
        goes_on = ~ends[state]  # an episode that has ended stays where it is
        return jnp.where(goes_on, mdp.next_state[state, action, slot], state), (state, action, goes_on)

    last, (states, actions, mask) = jax.lax.scan(step, first, jax.random.split(steps_key, horizon))
    steps = {"states": jnp.where(mask, states, 0).T, "actions": jnp.where(mask, actions, 0).T, "mask": mask.T}
    return steps if terminal is None else {**steps, "terminated": ends[last], "final_states": last}


_program = jax.jit(_walks, static_argnums=(4, 5))
_little_program = quick_jit(_walks, static_argnums=(4, 5))


def _inverse_cdf(cumulative: Float[Array, " N"], uniform: Float[Array, ""]) -> Int[Array, ""]:
    """First index whose cumulative weight exceeds `uniform` in [0, 1) times the total.

    Scaled by the total and strictly below it: an index of probability zero is never drawn, whatever the rounding.
    """
    total = cumulative[-1]
    target = jnp.minimum(uniform * total, jnp.nextafter(total, jnp.zeros_like(total)))
    # Short rows are looked through: a search would be a loop, which takes XLA longer to compile than it saves.
    method = "compare_all" if len(cumulative) <= _SHORT else "scan"
    return jnp.searchsorted(cumulative, target, side="right", method=method).astype(jnp.int32)
