"""Best responses of LPAL on columns: the policy that is worth most for given weights, and its feature expectations."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom import checks
from jaxhom.apprenticeship.certificate import simplex_point
from jaxhom.apprenticeship.exact import Exact, compact_features, exact_rows
from jaxhom.apprenticeship.planning_bound import bound_by_planning
from jaxhom.models.mdp import MDP
from jaxhom.planning.chain_solver import rough_state_occupancy

if TYPE_CHECKING:
    from jaxtyping import Array, Float

LOOSE_GAME = 0.5  # share of the open gap that a game may leave
LOOSE_PLANNING = 0.1  # share of the open gap that planning may add to a bound: more digits prove nothing more


def with_compact_features(mdp: MDP) -> MDP:
    """The model with features [S, 1, K] where they do not depend on the action: a quarter of the numbers, with four."""
    features = compact_features(np.asarray(mdp.features), np.asarray(mdp.allowed))
    return mdp if features.shape[1] > 1 else dataclasses.replace(mdp, features=checks.to_device(features))


@jax.jit
def respond(
    mdp: MDP,
    expectations: Float[Array, "L K"],
    weights: Float[Array, "L K"],
    value: Float[Array, "L S"],
    accuracy: Float[Array, " L"],
    error: Float[Array, ""],
) -> dict[str, Array]:
    """The best responses to weights, and the bounds that they prove.

    Args:
      mdp: the model; its features may be [S, 1, K].
      expectations, weights: [L, K].
      value: [L, S], a start for planning.
      accuracy: [L], a gap that planning may be a tenth of; infinite where nothing is asked for.
      error: scalar, what an expected feature may be off by.

    Returns:
      weights [L, K] and margin_bound [L]; value [L, S]; actions [L, S]; occupancy of the states [L, S] and expected
      features [L, K] of these actions.
    """
    bound, plan = bound_by_planning(mdp, expectations, weights, value, accuracy)
    mu, expected = expected_features(mdp, plan.policy, jnp.where(jnp.isfinite(accuracy), error, jnp.inf))
    return {
        "weights": bound.weights,
        "margin_bound": bound.margin_bound,
        "value": plan.value,
        "actions": plan.policy.argmax(axis=-1),
        "occupancy": mu.T,
        "expected": expected,
    }


@jax.jit
def evaluate(
    mdp: MDP, policy: Float[Array, "L S A"], error: Float[Array, ""]
) -> tuple[Float[Array, "L S"], Float[Array, "L K"]]:
    """State occupancies and feature expectations of policies, these up to an error."""
    mu, expected = expected_features(mdp, policy, error)
    return mu.T, expected


def expected_features(
    mdp: MDP, policy: Float[Array, "L S A"], error: Float[Array, "*L"], *, is_quick: bool = False
) -> tuple[Float[Array, "S L"], Float[Array, "L K"]]:
    """State occupancies and feature expectations of policies, these up to `error`; for use under `jit`.

    `is_quick`: by iterations alone; NaN where they take long.
    """
    largest = jnp.abs(mdp.features).max()
    residual = error * (1.0 - mdp.discount) / (jnp.sqrt(mdp.num_states) * jnp.where(largest > 0, largest, 1.0))
    mu = rough_state_occupancy(mdp, jnp.moveaxis(policy, 0, -1), residual, is_quick=is_quick)
    if mdp.features.shape[1] == 1:
        return mu, mu.T @ mdp.features[:, 0]
    return mu, jnp.einsum("sl,lsa,sak->lk", mu, policy, mdp.features)


def respond_on_host(
    exact: Exact,
    expectations: Float[np.ndarray, " K"],
    weights: Float[np.ndarray, " K"],
    value: Float[np.ndarray, " S"],
    accuracy: float,
    error: float,
) -> dict[str, np.ndarray]:
    """`respond` for one lane, without its axis, by linear solves in float64: right at any discount, in any type."""
    weights = simplex_point(weights)
    best, value, actions = exact.plan(weights, value, None, accuracy)
    mu, expected = evaluate_on_host(exact, np.eye(exact.allowed.shape[1])[actions], error)
    return {
        "weights": weights,
        "margin_bound": np.float64(best - weights @ expectations),
        "value": value,
        "actions": actions,
        "occupancy": mu,
        "expected": expected,
    }


def evaluate_on_host(
    exact: Exact, policy: Float[np.ndarray, "S A"], error: float
) -> tuple[Float[np.ndarray, " S"], Float[np.ndarray, " K"]]:
    """`evaluate`, on the host likewise."""
    mu, expected, _ = exact.expectations(exact_rows(policy, np.float64), None, error)
    return mu, expected
