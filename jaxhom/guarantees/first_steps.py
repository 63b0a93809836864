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

from jaxhom.guarantees.choices import Choices, Found
from jaxhom.status import Status

if TYPE_CHECKING:
    from jaxtyping import Float, Int


def best(choices: Choices, horizon: int) -> Found:
    """What the best policies of the first `horizon` steps are worth; one policy's worth, if every state is fixed."""
    largest = nothing = np.zeros(len(choices.size))
    for step in _backward(choices, slice(None), horizon):
        value, actions = step
        largest = np.maximum(largest, np.abs(value).max(axis=0))
    lower, upper = choices.bounds(value, (nothing, nothing), largest, horizon)
    return Found(lower, upper, value, actions, int(Status.SOLVED))


def contributions(choices: Choices, policy: Choices, k: int, horizon: int) -> Float[np.ndarray, " S"]:
    """What every state adds, at all times together, to the loss of a policy against the best choices for feature k."""
    states, distribution = np.arange(len(choices.initial)), choices.initial
    actions = [actions[:, 0] for _, actions in _backward(choices, [k], horizon)]
    values = [np.zeros((len(states), 1)), *(value for value, _ in _backward(policy, [k], horizon))]
    total = np.zeros(len(states))
    for time, left in enumerate(range(horizon, 0, -1)):
        chosen = actions[left - 1]
        lost = choices.backup(values[left - 1], [k])[states, chosen, 0] - values[left][:, 0]
        total += choices.discount**time * distribution * lost
        distribution = choices.leads(chosen).T @ distribution
    return total


def _backward(
    choices: Choices, features: slice | list[int], horizon: int
) -> Iterator[tuple[Float[np.ndarray, "S L"], Int[np.ndarray, "S L"]]]:
    """Values and best actions with 1, 2, ..., H steps left."""
    value = np.zeros((len(choices.initial), len(choices.size[features])))
    for _ in range(horizon):
        action_value = choices.backup(value, features)
        actions = action_value.argmax(axis=1)
        value = action_value.max(axis=1)
        yield value, actions
