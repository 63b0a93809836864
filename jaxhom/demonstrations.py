"""Demonstrations: padded trajectories, what the expert did where, Monte Carlo expectations, sampling.

Trajectories of unequal length are padded to the longest and masked: `states`, `actions` and `mask` are [M, H].
"""

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxhom import checks
from jaxhom.inputs import as_model, check_policy
from jaxhom.mdp import MDP, uniform_policy


@chex.dataclass(frozen=True)
class Demonstrations:
    """M trajectories of at most H steps. Build it with `Demonstrations.from_trajectories`.

    Attributes:
      states: int32 [M, H], the state of each step; 0 on padding.
      actions: int32 [M, H], the action taken there; 0 on padding.
      mask: bool [M, H], True on the steps that happened, a prefix of every row. Taking steps out of it, such as those
        of a car that is put back to the start, hides them from the learner and leaves the times of the others.
    """

    states: jax.Array
    actions: jax.Array
    mask: jax.Array

    @classmethod
    def from_trajectories(cls, trajectories) -> "Demonstrations":
        """Builds demonstrations from a sequence of (states, actions) pairs of integer sequences.

        Args:
          trajectories: M pairs, each of two equally long, non-empty sequences; lengths may differ between pairs.

        Raises:
          ValueError: if there is no trajectory, one is empty or not a pair, its lengths differ, an entry is negative
            or not whole (the trajectory and the step are named), or all of them padded to the longest are too many
            steps for 32-bit indices.
        """
        try:
            trajectories = list(trajectories)
        except TypeError:
            kind = type(trajectories).__name__
            raise ValueError(f"trajectories must be a sequence of pairs (states, actions), got {kind}") from None
        if not trajectories:
            raise ValueError("at least one trajectory is needed, got none")
        rows = [_validated_trajectory(i, pair) for i, pair in enumerate(trajectories)]
        horizon = max(len(states) for states, _ in rows)
        if len(rows) * horizon > checks.MAX_SLOTS:
            raise ValueError(
                f"{len(rows)} trajectories padded to the longest, {horizon} steps, are more than 2^31 - 2 steps: "
                "cut the long ones into pieces"
            )
        states, actions = np.zeros((2, len(rows), horizon), np.int32)
        mask = np.zeros((len(rows), horizon), bool)
        for i, (row_states, row_actions) in enumerate(rows):
            states[i, : len(row_states)] = row_states
            actions[i, : len(row_actions)] = row_actions
            mask[i, : len(row_states)] = True
        return cls(states=jnp.asarray(states), actions=jnp.asarray(actions), mask=jnp.asarray(mask))

    @property
    def num_trajectories(self) -> int:
        """M."""
        return self.states.shape[-2]

    @property
    def horizon(self) -> int:
        """H, the length of the longest trajectory (padding included)."""
        return self.states.shape[-1]

    def validate(self, mdp: MDP) -> None:
        """Raises `ValueError` naming trajectory and step if a state or action does not exist in `mdp`.

        Does nothing on traced arrays.
        """
        if checks.is_traced(self.states, self.actions, self.mask):
            return
        shape = self.states.shape
        same = self.actions.shape == shape and self.mask.shape == shape
        checks.require_shape("states, actions and mask", self.actions, f"{shape} alike", same)
        mask = np.asarray(self.mask)
        for name, array, limit in (
            ("states", self.states, mdp.num_states),
            ("actions", self.actions, mdp.num_actions),
        ):
            array = np.asarray(array)
            inside = (array >= 0) & (array < limit)
            message = f"must lie in [0, {limit}) (index: trajectory, step)"
            checks.require_all(name, array, inside | ~mask, message)


def empirical_policy(mdp: MDP, demonstrations: Demonstrations) -> tuple[jax.Array, jax.Array]:
    """Frequencies of the expert's actions in the states that were demonstrated.

    Args:
      mdp: the model.
      demonstrations: M trajectories.

    Returns:
      visited: bool [S], the states S^E that occur in the demonstrations.
      policy: [S, A], empirical action frequencies on visited states, uniform elsewhere; rows sum to 1.

    Raises:
      ValueError: if a state or action is out of range.

    Source: Boularias and Chaib-draa 2010, section V.
    """
    demonstrations.validate(mdp)
    shape = (mdp.num_states, mdp.num_actions)
    # Counted in integers and divided in JAX's default type: float32 would stop counting at 2^24, float16 at 2^11.
    weight = demonstrations.mask.astype(jnp.int32)
    counts = jnp.zeros(shape, jnp.int32).at[demonstrations.states, demonstrations.actions].add(weight).astype(float)
    visits = counts.sum(axis=-1, keepdims=True)
    visited = visits[:, 0] > 0
    frequencies = (counts / jnp.maximum(visits, 1.0)).astype(mdp.dtype)
    return visited, jnp.where(visited[:, None], frequencies, uniform_policy(mdp))


def monte_carlo_feature_expectations(mdp: MDP, demonstrations: Demonstrations) -> jax.Array:
    """Feature expectations as the demonstrations' mean, 1/M sum_m sum_t gamma^t phi(s_t, a_t), t from 0.

    Args:
      mdp: the model, with K features.
      demonstrations: M trajectories.

    Returns:
      [K], in the units of `feature_expectations`, but of a finite horizon.

    Raises:
      ValueError: if a state or action is out of range.

    Source: Boularias and Chaib-draa 2010, eq. (6), with the first step counted as gamma^0.
    """
    demonstrations.validate(mdp)
    steps = jnp.arange(demonstrations.horizon)
    weight = jnp.where(demonstrations.mask, mdp.discount**steps, 0.0)
    # Weights are summed per pair first: [M, H, K] would not fit for long demonstrations and many features.
    shape = (mdp.num_states, mdp.num_actions)
    pairs = jnp.zeros(shape, mdp.dtype).at[demonstrations.states, demonstrations.actions].add(weight)
    return jnp.einsum("sa,sak->k", pairs, mdp.features) / demonstrations.num_trajectories


def sample_demonstrations(
    key: jax.Array, mdp: MDP, policy: jax.Array, num_trajectories: int, horizon: int
) -> Demonstrations:
    """Draws trajectories of a policy, started from the model's initial distribution.

    Args:
      key: a `jax.random` key; the same key gives the same trajectories.
      mdp: the model.
      policy: [S, A], rows sum to 1.
      num_trajectories: M, at least 1.
      horizon: H, steps of every trajectory, at least 1.

    Returns:
      Demonstrations [M, H] without padding.

    Raises:
      ValueError: if `policy` has another shape or a count is below 1.
    """
    mdp = as_model(mdp)
    policy = check_policy(mdp, policy, batch=False)
    if num_trajectories < 1 or horizon < 1:
        raise ValueError(f"num_trajectories and horizon must be at least 1, got {num_trajectories} and {horizon}")
    return _sample(key, mdp, policy, num_trajectories, horizon)


@functools.partial(jax.jit, static_argnums=(3, 4))
def _sample(key, mdp, policy, num_trajectories, horizon) -> Demonstrations:
    initial_key, steps_key = jax.random.split(key)
    lanes = (num_trajectories,)
    uniform = jax.random.uniform(initial_key, lanes, mdp.dtype)
    first = jax.vmap(_inverse_cdf, in_axes=(None, 0))(jnp.cumsum(mdp.initial), uniform)
    draw = jax.vmap(_inverse_cdf)

    def step(state, key):
        draw_action, draw_successor = jax.random.uniform(key, (2, *lanes), mdp.dtype)
        action = draw(jnp.cumsum(policy[state], axis=-1), draw_action)
        slot = draw(jnp.cumsum(mdp.probability[state, action], axis=-1), draw_successor)
        return mdp.next_state[state, action, slot], (state, action)

    _, (states, actions) = jax.lax.scan(step, first, jax.random.split(steps_key, horizon))
    mask = jnp.ones((num_trajectories, horizon), bool)
    return Demonstrations(states=states.T, actions=actions.T, mask=mask)


def _inverse_cdf(cumulative: jax.Array, uniform: jax.Array) -> jax.Array:
    """First index whose cumulative weight, [N], exceeds `uniform` in [0, 1) times the total.

    Scaled by the total and strictly below it: an index of probability zero is never drawn, whatever the rounding.
    """
    total = cumulative[-1]
    target = jnp.minimum(uniform * total, jnp.nextafter(total, jnp.zeros_like(total)))
    return jnp.searchsorted(cumulative, target, side="right").astype(jnp.int32)


def _validated_trajectory(index: int, pair) -> tuple[np.ndarray, np.ndarray]:
    """Checks one (states, actions) pair."""
    try:
        states, actions = pair
    except (TypeError, ValueError):
        raise ValueError(f"trajectory {index} must be a pair (states, actions)") from None
    states = checks.as_host_array(f"trajectory {index} states", states)
    actions = checks.as_host_array(f"trajectory {index} actions", actions)
    for name, array in (("states", states), ("actions", actions)):
        checks.require_shape(f"trajectory {index} {name}", array, "[H]", array.ndim == 1)
    if len(states) != len(actions):
        raise ValueError(f"trajectory {index} has {len(states)} states and {len(actions)} actions; one action a state")
    if not len(states):
        raise ValueError(f"trajectory {index} is empty")
    upper = 2**31 - 1
    states = checks.require_integers(f"trajectory {index} states", states, upper)
    return states, checks.require_integers(f"trajectory {index} actions", actions, upper)
