"""The pool of whoever adds columns: the policies that any lane has met, and the bounds, for all lanes to use.

A *cut* is what planning for weights w has proved: no policy's w . V is above h. The upper bound of any lane is then
h - w . Vhat at the most.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxhom.models.mdp import MDP

if TYPE_CHECKING:
    from jaxtyping import Float, Int

_FIRST_SIZE = 64  # policies that there is room for; the room doubles when it is full


class PolicyPool:
    """Policies with their occupancies and feature expectations.

    Deterministic policies are kept as actions, and every occupancy as that of the states: S numbers and S actions.
    Sums of them are float64, whatever the model's type.
    """

    def __init__(self, mdp: MDP):
        self._num_actions = mdp.num_actions
        self._action_dtype = np.min_scalar_type(mdp.num_actions - 1)
        self._expected = np.zeros((_FIRST_SIZE, mdp.num_features))
        self._policies: list[tuple[np.ndarray, np.ndarray]] = []
        self._cuts = np.zeros((_FIRST_SIZE, mdp.num_features + 1))  # w and h
        self._plans: list[tuple[np.ndarray, np.ndarray]] = []

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
        self._expected = _with_room(self._expected, number)
        self._expected[number] = expected
        self._policies.append((occupancy.copy(), policy))
        return number

    def add_cut(
        self,
        weights: Float[np.ndarray, " K"],
        most: float,
        actions: Int[np.ndarray, " S"],
        value: Float[np.ndarray, " S"],
    ) -> None:
        """Takes the cut of weights [K] and the largest w . V, with the best actions [S] and their values [S]."""
        number = len(self._plans)
        self._cuts = _with_room(self._cuts, number)
        self._cuts[number] = [*weights, most]
        self._plans.append((actions.astype(self._action_dtype), value.copy()))

    def best_cut(self, expectations: Float[np.ndarray, " K"]) -> dict[str, Any] | None:
        """The least upper bound for expectations [K]: margin_bound, weights [K], actions [S] and value [S]."""
        if not self._plans:
            return None
        cuts = self._cuts[: len(self._plans)]
        bounds = cuts[:, -1] - cuts[:, :-1] @ expectations
        best = int(bounds.argmin())
        actions, value = self._plans[best]
        return {"margin_bound": bounds[best], "weights": cuts[best, :-1], "actions": actions, "value": value}

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


def _with_room(table: Float[np.ndarray, "N M"], number: int) -> Float[np.ndarray, "R M"]:
    """The table, twice as long where it has no row of this number."""
    return table if number < len(table) else np.concatenate([table, np.zeros_like(table)])
