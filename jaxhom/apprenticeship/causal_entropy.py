"""The two objectives of maximum causal entropy, and their gradients: on the host, and in programs.

With the soft optimal policy pi_w, values V_w and action values Q_w of the reward phi(s, a) . w at temperature 1
(`planning.soft_optimal`), the weights minimise, over steps (s, a) with frequencies c(s, a), or given expectations Vhat,

    likelihood   sum_{s, a} c(s, a) (V_w(s) - Q_w(s, a))           the mean of -log pi_w(a | s)
    matching     (1 - gamma) (alpha . V_w - w . Vhat)              convex; its gradient is (1 - gamma) (V(pi_w) - Vhat)

The second is the dual of "the largest causal entropy among the policies with these feature expectations" (Ziebart
2010). By demonstrations whose steps are weighted by gamma^t, and without chance, the two are the same. Both are given
per step, so that a penalty weighs alike in them.

With b = c_s - gamma T^t c (or alpha), (I - gamma P_pi)^t y = b, the derivative of either by the reward of (s, a) is
y(s) pi(s, a) - c(s, a), up to the factor: one linear solve with the transpose, whatever the number of features.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom import checks
from jaxhom.apprenticeship.presolve import Reach
from jaxhom.models.demonstrations import Demonstrations, action_counts
from jaxhom.models.mdp import MDP, deciding_states
from jaxhom.planning.host_chains import HostChain, HostModel
from jaxhom.planning.soft_optimal import soft_optimal_policy, soft_values_on_host

if TYPE_CHECKING:
    from jaxtyping import Array, Float

_RESIDUAL = 1e-11  # of soft values, in sizes of the rewards: gradients are taken from what it leaves
_MAX_STEPS = 100  # of Newton's method; it takes 5 to 15 from nothing, and 1 to 3 from the values before


class Evidence(NamedTuple):
    """What weights are fitted to: frequencies [S, A] that sum to 1, or expectations [K] in units of scaled features."""

    frequencies: Float[Array, "S A"] | None = None
    expectations: Float[Array, " K"] | None = None


def scaled_features(mdp: MDP) -> tuple[Float[Array, "S A K"], Float[Array, " K"]]:
    """Features by what each can do per step, and those scales; constant ones are 0, and their scale is infinite."""
    scale = Reach.of(mdp).scale
    xp = checks.arrays_of(mdp, scale)
    features = xp.where(xp.isinf(scale), 0.0, xp.asarray(mdp.features) / scale)
    if mdp.restricts_actions:
        features = xp.where(xp.asarray(mdp.allowed)[..., None], features, 0.0)
    return features, scale


def frequencies_of(mdp: MDP, demonstrations: Demonstrations) -> Float[Array, "S A"]:
    """How often each action was taken in each state, as shares of all decisions; zero if there was none."""
    counts = action_counts(mdp, demonstrations)
    xp = checks.arrays_of(mdp, counts)
    counts = xp.where(deciding_states(mdp, counts.sum(axis=1) > 0)[:, None], counts, 0).astype(mdp.dtype)
    return counts / xp.maximum(counts.sum(), 1)


class HostObjective:
    """Value and gradient by weights [K] of scaled features, in float64 on the host.

    Each call begins at the values and with the factors of the last one, so weights should change little between calls.
    """

    def __init__(self, mdp: MDP, model: HostModel, features: Float[np.ndarray, "S A K"], evidence: Evidence) -> None:
        self._model, self._features = model, np.asarray(features, np.float64)
        self._missing = ~np.asarray(mdp.allowed) if mdp.restricts_actions else None
        self._expectations = evidence.expectations
        initial = np.asarray(mdp.initial, np.float64)
        if evidence.expectations is None:
            self._frequencies = np.asarray(evidence.frequencies, np.float64)
            self._source = self._frequencies.sum(axis=1) - model.discount * (model.rows.T @ self._frequencies.ravel())
        else:
            self._source = (1.0 - model.discount) * initial
        self._value = np.zeros(mdp.num_states)  # of the last call
        self._chain: HostChain | None = None

    def __call__(self, weights: Float[np.ndarray, " K"]) -> tuple[float, Float[np.ndarray, " K"]]:
        """The objective and its gradient."""
        reward = self._features @ weights
        residual = _RESIDUAL * (1.0 + np.abs(reward).max())
        if self._missing is not None:
            reward = np.where(self._missing, -np.inf, reward)
        found = soft_values_on_host(self._model, reward, self._value, 1.0, residual, _MAX_STEPS, self._chain)
        self._value, chain = found.value, self._model.chain(found.policy, may_iterate=True)
        pairs = chain.flow(self._source)[:, None] * found.policy
        self._chain = chain
        if self._expectations is None:
            taken = self._frequencies > 0
            surprise = np.where(taken, found.value[:, None] - np.where(taken, found.action_value, 0.0), 0.0)
            objective, pairs = (self._frequencies * surprise).sum(), pairs - self._frequencies
            return float(objective), np.einsum("sa,sak->k", pairs, self._features)
        target = (1.0 - self._model.discount) * self._expectations
        objective = self._source @ found.value - weights @ target
        return float(objective), np.einsum("sa,sak->k", pairs, self._features) - target


def objective_in_program(
    mdp: MDP,
    features: Float[Array, "S A K"],
    evidence: Evidence,
    weights: Float[Array, " K"],
    value: Float[Array, " S"],
) -> tuple[Float[Array, ""], Float[Array, " S"]]:
    """The objective at weights of scaled features, differentiable; and the soft values [S], a start for the next call.

    Args:
      mdp: the model.
      features: scaled. evidence: likewise.
      weights: [K].
      value: [S], where to start.
    """
    reward = features @ weights
    if mdp.restricts_actions:
        reward = jnp.where(mdp.allowed, reward, -jnp.inf)
    plan = soft_optimal_policy(mdp, reward, initial_value=jax.lax.stop_gradient(value), max_iterations=_MAX_STEPS)
    if evidence.expectations is None:
        taken = evidence.frequencies > 0
        surprise = jnp.where(taken, plan.value[:, None] - jnp.where(taken, plan.action_value, 0.0), 0.0)
        objective = (evidence.frequencies * surprise).sum()
    else:
        objective = (1.0 - mdp.discount) * (plan.value @ mdp.initial - weights @ evidence.expectations)
    return objective, jax.lax.stop_gradient(plan.value)
