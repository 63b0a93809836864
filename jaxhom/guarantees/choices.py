"""Policies that are fixed in some states and free in the others: what can be chosen, on the host, in float64.

In the states that are fixed an action stands for the whole row: its transitions and features are averaged,

    T'(s, a0, .) = sum_a pi(s, a) T(s, a, .),    phi'(s, a0) = sum_a pi(s, a) phi(s, a),

and no other action is left there. Where all states are fixed that is one policy; where none is, the model itself.

Whatever the values V, they bound what is best. With b = max_a (phi' + gamma T' V) - V, no policy is worth more than
alpha . V + max_s b / (1 - gamma), and the best one is worth at least alpha . V + min_s b / (1 - gamma) (Puterman 1994,
section 6.6). What rounding may hide is added outward: that of the work, and rows, in the model's type, that miss 1.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import scipy

from jaxhom.models.mdp import MDP
from jaxhom.planning.host_chains import host_model

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

_EPS = np.finfo(np.float64).eps


class BestChoices(NamedTuple):
    """The best choices for every feature.

    Attributes:
      lower, upper: [K], between which the discounted sum of the best policy lies.
      values: [S, K], of the best policies, and actions: int [S, K]; of sums over H steps those with all of them left.
      status: int, a `jaxhom.Status`.
    """

    lower: Float[np.ndarray, " K"]
    upper: Float[np.ndarray, " K"]
    values: Float[np.ndarray, "S K"]
    actions: Int[np.ndarray, "S K"]
    status: int


class Choices:
    """A model in which some states are fixed; all numbers in float64, features last.

    Attributes:
      model: the `jaxhom.planning.host_chains.HostModel` of what is left. discount: gamma. initial: [S], alpha.
      reward: [S, A, K], the features; -inf where an action cannot be taken.
      size: [K], the largest |feature| that can be met.
      first: int [S], in fixed states the action that stands for the row; elsewhere the first that is allowed.
      is_one: whether every state is fixed. own_reward: [S, K], the features under `first`.
    """

    def __init__(self, mdp: MDP, is_fixed: Bool[np.ndarray, " S"], policy: Float[np.ndarray, "S A"]) -> None:
        """`policy` [S, A] is read where `is_fixed`; its rows sum to 1 in the model's type."""
        given, allowed = host_model(mdp), np.asarray(mdp.allowed)
        self.discount, self.initial = given.discount, np.asarray(mdp.initial, np.float64)
        pairs = (mdp.num_states, mdp.num_actions)
        share = np.asarray(policy, np.float64)
        total = share.sum(axis=1, keepdims=True)
        share = share / total
        self.first = np.where(is_fixed, share.argmax(axis=1), allowed.argmax(axis=1))
        mix = _mixing(is_fixed, self.first, share)
        self.model = given.with_rows(mix @ given.rows)
        is_left = allowed & ~is_fixed[:, None]
        is_left[np.arange(pairs[0]), self.first] = True
        features = mix @ np.asarray(mdp.features, np.float64).reshape(-1, mdp.num_features)
        features = features.reshape(*pairs, -1)
        self.size = np.abs(np.where(is_left[..., None], features, 0.0)).max(axis=(0, 1))
        self.reward = np.where(is_left[..., None], features, -np.inf)
        self.is_one, self.own_reward = bool(is_fixed.all()), features[np.arange(pairs[0]), self.first]
        # By how much rows may miss what they should be: those of the model, and those that are fixed.
        stored = np.asarray(mdp.probability).sum(axis=-1, dtype=np.float64)
        self._missed_rows = float(np.abs(stored - 1.0)[allowed].max())
        is_mixed = is_fixed & (share.max(axis=1) < 1.0)
        self._missed_shares = float(np.abs(total - 1.0).max(where=is_fixed[:, None], initial=0.0))
        self._missed_shares += float(np.finfo(mdp.dtype).eps) * bool(is_mixed.any())
        self._missed_start = abs(self.initial.sum() - 1.0)
        rows = self.model.rows
        self._terms = rows.shape[1] if not scipy.sparse.issparse(rows) else int(np.diff(rows.indptr).max())

    def backup(self, value: Float[np.ndarray, "S L"], features: slice | list[int]) -> Float[np.ndarray, "S A L"]:
        """phi' + gamma T' V of some features; -inf where an action cannot be taken."""
        action_value = (self.model.rows @ value).reshape(*self.reward.shape[:2], -1)
        action_value *= self.discount  # in place: arrays of millions of numbers
        action_value += self.reward[..., features]
        return action_value

    def push(
        self, distribution: Float[np.ndarray, "S L"], actions: Int[np.ndarray, "S 1 L"]
    ) -> Float[np.ndarray, "S L"]:
        """Where distributions of states are one step later, each under actions of its own."""
        pairs = np.zeros((len(distribution), self.model.num_actions, distribution.shape[1]))
        np.put_along_axis(pairs, actions, distribution[:, None], axis=1)
        return self.model.rows.T @ pairs.reshape(-1, distribution.shape[1])

    def leads(self, actions: Int[np.ndarray, " S"]) -> Float[np.ndarray, "S S"] | scipy.sparse.csr_array:
        """The transitions of actions."""
        return self.model.rows[np.arange(len(actions)) * self.model.num_actions + actions]

    def bounds(
        self,
        value: Float[np.ndarray, "S K"],
        gain: tuple[Float[np.ndarray, " K"], Float[np.ndarray, " K"]],
        largest: Float[np.ndarray, " K"],
        horizon: int | None = None,
    ) -> tuple[Float[np.ndarray, " K"], Float[np.ndarray, " K"]]:
        """What the best policy is worth at least and at most, alpha . V, rounding included.

        Args:
          value: [S, K].
          gain: the least and the largest of b, each [K]; zeros for sums over `horizon` steps, which leave nothing open.
          largest: [K], the largest |V| that was met.
          horizon: H, or None for all time.
        """
        kept = self.discount * (1.0 + self._missed_rows) * (1.0 + self._missed_shares)
        time = 1.0 / (1.0 - kept) if kept < 1.0 else np.inf
        if horizon is not None:
            time = min(float(horizon), time)
        met = self.size + largest
        hidden = (self._terms + 10) * _EPS * 2.0 * met + (self._missed_rows + self._missed_shares) * met
        at_start = self.initial @ value
        rounding = ((len(value) + 8) * _EPS + self._missed_start) * largest
        low = at_start + np.minimum(gain[0] - hidden, 0.0) * time - rounding
        high = at_start + np.maximum(gain[1] + hidden, 0.0) * time + rounding
        return low, high


def _mixing(is_fixed, first, share) -> scipy.sparse.csr_array:
    """[S A, S A]: what every pair becomes. Free states stay; in fixed ones the first action takes the row's average."""
    num_actions = share.shape[1]
    kept = np.flatnonzero(np.repeat(~is_fixed, num_actions))
    state, action = np.nonzero(np.where(is_fixed[:, None], share, 0.0))
    row = np.concatenate([kept, state * num_actions + first[state]])
    column = np.concatenate([kept, state * num_actions + action])
    entries = np.concatenate([np.ones(len(kept)), share[state, action]])
    return scipy.sparse.csr_array((entries, (row, column)), shape=(share.size, share.size))
