"""The best of some choices over the first H steps, for every feature at once, and what each state adds to a loss.

Backward induction: with h steps left V_h = max_a (phi' + gamma T' V_{h-1}), V_0 = 0. The best policies depend on the
time. The performance difference lemma holds step by step: with d_t the distribution of the state at time t under the
best policy, and V_h, Q_h those of another policy with h = H - t steps left,

    V_H(best) - alpha . V_H = sum_{t < H} gamma^t sum_s d_t(s) (Q_h(s, best_h(s)) - V_h(s)).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from jaxhom.guarantees.choices import BestChoices, Choices
from jaxhom.status import Status

if TYPE_CHECKING:
    from jaxtyping import Float, Int


_NUMBERS_AT_A_TIME = 2**22  # values of all times that are held together


def discounted_away(discount: float) -> int:
    """The number of steps after which nothing counts any more, whatever the rewards: gamma^t / (1 - gamma) = 2^-200."""
    return int(np.ceil((-200.0 * np.log(2.0) + np.log1p(-discount)) / np.log(discount)))


def best(choices: Choices, horizon: int) -> BestChoices:
    """What the best policies of the first `horizon` steps are worth; one policy's worth, if every state is fixed."""
    largest = nothing = np.zeros(len(choices.size))
    for step in _backward(choices, slice(None), horizon):
        value, action_value = step
        largest = np.maximum(largest, np.abs(value).max(axis=0))
    lower, upper = choices.bounds(value, (nothing, nothing), largest, horizon)
    return BestChoices(lower, upper, value, _chosen(choices, action_value), int(Status.SOLVED))


def contributions(
    choices: Choices, policy: Choices, share: Float[np.ndarray, " K"], horizon: int
) -> Float[np.ndarray, " S"]:
    """What every state adds, at all times together, to the loss of a policy against the best choices.

    Args:
      choices: what can be chosen. policy: that of the policy, in which every state is fixed.
      share: [K], how much each feature counts.
      horizon: H.
    """
    some, total = np.flatnonzero(share), np.zeros(len(choices.initial))
    width = max(1, _NUMBERS_AT_A_TIME // (len(total) * horizon))
    for first in range(0, len(some), width):
        features = some[first : first + width]
        total += _lost(choices, policy, list(features), horizon) @ share[features]
    return total


def _lost(choices: Choices, policy: Choices, features: list[int], horizon: int) -> Float[np.ndarray, "S L"]:
    """The contributions for some features alone."""
    actions = [_chosen(choices, action_value) for _, action_value in _backward(choices, features, horizon)]
    values = [np.zeros(actions[0].shape), *(value for value, _ in _backward(policy, features, horizon))]
    total = np.zeros(actions[0].shape)
    distribution = np.repeat(choices.initial[:, None], len(features), axis=1)
    for time, left in enumerate(range(horizon, 0, -1)):
        chosen = actions[left - 1][:, None]
        reached = np.take_along_axis(choices.backup(values[left - 1], features), chosen, axis=1)[:, 0]
        total += choices.discount**time * distribution * (reached - values[left])
        distribution = choices.push(distribution, chosen)
    return total


def _backward(
    choices: Choices, features: slice | list[int], horizon: int
) -> Iterator[tuple[Float[np.ndarray, "S L"], Float[np.ndarray, "S A L"]]]:
    """Values, and what they are the best of, with 1, 2, ..., H steps left; A = 1 where there is no choice."""
    value = np.zeros((len(choices.initial), len(choices.size[features])))
    reward, leads = choices.own_reward[:, features], choices.leads(choices.first)
    for _ in range(horizon):
        if choices.is_one:
            action_value = (reward + choices.discount * (leads @ value))[:, None]
        else:
            action_value = choices.backup(value, features)
        value = action_value[:, 0] if choices.is_one else action_value.max(axis=1)
        yield value, action_value


def _chosen(choices: Choices, action_value: Float[np.ndarray, "S A L"]) -> Int[np.ndarray, "S L"]:
    """The best actions."""
    if choices.is_one:
        return np.broadcast_to(choices.first[:, None], (len(action_value), action_value.shape[2]))
    return action_value.argmax(axis=1)
