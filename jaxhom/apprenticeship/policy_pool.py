"""The pool of LPAL on columns: the policies that any lane has met, for all lanes to use."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import jax
import numpy as np

from jaxhom.models.mdp import MDP

if TYPE_CHECKING:
    from jaxtyping import Array, Float, Int

_FIRST_SIZE = 64  # policies that there is room for; the room doubles when it is full


class PolicyPool:
    """Policies with their occupancies and feature expectations.

    Deterministic policies are kept as actions, and every occupancy as that of the states: S numbers and S actions.
    Sums of them are float64, whatever the model's type.
    """

    def __init__(self, mdp: MDP):
        self._num_actions, self._dtype = mdp.num_actions, np.dtype(mdp.dtype)
        self._action_dtype = np.min_scalar_type(mdp.num_actions - 1)
        self._expected = np.zeros((_FIRST_SIZE, mdp.num_features))
        self._policies: list[tuple[np.ndarray, np.ndarray]] = []

    @property
    def expected(self) -> Float[np.ndarray, "M K"]:
        """Feature expectations [M, K] of the policies so far."""
        return self._expected[: len(self._policies)]

    def add(
        self,
        occupancy: Float[np.ndarray, " S"],
        policy: Int[np.ndarray, " S"] | Float[np.ndarray, "S A"],
        expected: Float[np.ndarray, " K"],
    ) -> int:
        """Takes a policy, given by actions [S] or probabilities [S, A], with mu [S] and V [K]; returns its number."""
        policy = policy.astype(self._action_dtype) if policy.ndim == 1 else policy
        number = len(self._policies)
        if number == len(self._expected):
            self._expected = np.concatenate([self._expected, np.zeros_like(self._expected)])
        self._expected[number] = expected
        self._policies.append((occupancy.copy(), policy))
        return number

    def mixture(self, numbers: Sequence[int], probabilities: Sequence[float]) -> Float[np.ndarray, "S A"]:
        """The occupancy sum_j q_j x_j [S, A] of policies mixed with the given probabilities."""
        states = np.arange(len(self._policies[0][0]))
        x = np.zeros((len(states), self._num_actions))
        for number, probability in zip(numbers, probabilities, strict=True):
            mu, policy = self._policies[number]
            if policy.ndim == 1:
                x[states, policy] += probability * mu
            else:
                x += probability * mu[:, None] * policy
        return x

    def one_hot(self, actions: Int[np.ndarray, "*B S"]) -> Float[Array, "*B S A"]:
        """Actions [..., S] as a policy [..., S, A]."""
        return jax.nn.one_hot(actions, self._num_actions, dtype=self._dtype)
