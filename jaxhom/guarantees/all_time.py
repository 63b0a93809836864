"""The best of some choices over all time, for every feature at once, and what each state adds to a loss.

Sweeps are shared by all features: one product a sweep. They end soon where the graph mixes; where it does not, each
feature goes on by policy iteration with direct solves (`jaxhom.planning.policy_iteration`). All of it in float64,
whatever the model's type: the optimum of a feature is a bound, and a loss is a difference of such numbers.

A loss in states is by the performance difference lemma (Kakade and Langford 2002). For pi with occupancy mu and any
other policy, of values V and Q,

    V(pi) - alpha . V = sum_s mu(s) (sum_a pi(s, a) Q(s, a) - V(s)).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jaxhom.guarantees.choices import Choices, Found
from jaxhom.planning import policy_iteration
from jaxhom.status import Status

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

_EPS = float(np.finfo(np.float64).eps)
_SWEEPS = 100  # before linear systems are solved, where that is quick; where it is not, as long as the span falls
_SLOW, _MOST_SWEEPS = 0.5, 10_000  # to half of what it was after so many
_DIRECT = 1e7  # states times bandwidth up to which a direct solve takes less than hundreds of sweeps
_TOLERANCE, _ROUNDINGS = 1e-12, 8.0  # of what b may span: a share of the largest |feature|, and roundings of |V|


def best(choices: Choices) -> Found:
    """The best policy for each feature."""
    value, is_open = _swept(choices)
    actions, status = choices.backup(value, slice(None)).argmax(axis=1), Status.SOLVED
    may_solve = choices.model.is_solvable
    for k in np.flatnonzero(is_open):
        plan = may_solve and policy_iteration.iterate(choices.model, choices.reward[..., k], actions[:, k], _EPS)
        if plan:
            value[:, k], actions[:, k] = plan.value, plan.actions
        if not plan or not plan.is_settled:
            status = Status.STALLED
    return _found(choices, value, actions, status)


def of_policy(choices: Choices) -> Found:
    """The values of a policy, of choices in which every state is fixed."""
    actions = choices.first
    value = _solved(choices, actions, choices.own_reward, is_flow=False)
    status = Status.SOLVED if np.isfinite(value).all() else Status.STALLED
    return _found(choices, np.nan_to_num(value), np.broadcast_to(actions[:, None], value.shape), status)


def contributions(choices: Choices, best: Found, own: Found, share: Float[np.ndarray, " K"]) -> Float[np.ndarray, " S"]:
    """What every state adds to the loss of a policy against the best choices.

    Args:
      choices: what can be chosen. best: what was found for them.
      own: of the policy.
      share: [K], how much each feature counts.
    """
    states, total = np.arange(len(choices.initial)), np.zeros(len(choices.initial))
    for k in np.flatnonzero(share):
        actions = best.actions[:, k]
        mu = _solved(choices, actions, choices.initial[:, None], is_flow=True)[:, 0]
        reached = choices.backup(own.values[:, [k]], [k])[states, actions, 0]
        total += share[k] * np.maximum(np.nan_to_num(mu), 0.0) * (reached - own.values[:, k])
    return total


def _found(choices: Choices, value, actions, status: int) -> Found:
    gain = choices.backup(value, slice(None)).max(axis=1) - value
    largest = np.abs(value).max(axis=0)
    lower, upper = choices.bounds(value, (gain.min(axis=0), gain.max(axis=0)), largest)
    return Found(lower, upper, value, actions, int(status))


def _swept(choices: Choices) -> tuple[Float[np.ndarray, "S K"], Bool[np.ndarray, " K"]]:
    """Values after sweeps, shifted by the constant that halves what is open, and which features are still open."""
    value, former = np.zeros((len(choices.initial), len(choices.size))), np.inf
    shift = 0.5 * choices.discount / (1.0 - choices.discount)
    for count in range(1, _MOST_SWEEPS + 1):
        improved = choices.backup(value, slice(None)).max(axis=1)
        change = improved - value
        low, high = change.min(axis=0), change.max(axis=0)
        value, span = improved + shift * (low + high), high - low
        is_open = span > _TOLERANCE * choices.size + _ROUNDINGS * _EPS * np.abs(value).max(axis=0)
        if not is_open.any():
            break
        if count % _SWEEPS == 0:
            if _is_direct(choices) or (span > _SLOW * former)[is_open].any():
                break
            former = span
    return value, is_open


def _is_direct(choices: Choices) -> bool:
    """Whether linear systems are solved by elimination before anything else is tried."""
    model = choices.model
    return model.is_solvable and (model.is_narrow or model.num_states * model.bandwidth <= _DIRECT)


def _solved(choices: Choices, actions, right: Float[np.ndarray, "S L"], *, is_flow: bool) -> Float[np.ndarray, "S L"]:
    """Values of rewards, or occupancies of distributions, under actions [S]; NaN where nothing is found."""
    chain = choices.model.chain(actions, may_iterate=True)
    return chain.flow(right) if is_flow else chain.value(right)
