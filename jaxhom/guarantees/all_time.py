"""The best of some choices over all time, for every feature at once, and what each state adds to a loss.

Every feature is planned for by policy iteration with direct solves (`jaxhom.planning.policy_iteration`) where these are
quick; elsewhere by sweeps, which end soon where the graph mixes. All of it in float64, whatever the model's type: the
optimum of a feature is a bound, and a loss is a difference of such numbers.

A loss in states is by the performance difference lemma (Kakade and Langford 2002). For pi with occupancy mu and any
other policy, of values V and Q,

    V(pi) - alpha . V = sum_s mu(s) (sum_a pi(s, a) Q(s, a) - V(s)).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from tqdm import tqdm

from jaxhom.guarantees.choices import BestChoices, Choices
from jaxhom.planning import policy_iteration
from jaxhom.status import Status

if TYPE_CHECKING:
    from jaxtyping import Float, Int

_EPS = float(np.finfo(np.float64).eps)
_SWEPT = 1e-9  # relative error that sweeps may leave, where nothing else gets there
_SHARED_SWEEPS = 100  # before linear systems are solved
_BLOCK = 15  # sweeps with the actions that were chosen, between two over all of them
_LOOK_BACK, _SLOW = 8, 0.5  # after so many blocks a span that has not fallen to that of what it was counts as slow
_MOST_BLOCKS, _LAST_SWEEPS = 1000, 100
_NARROW_STATES = 20_000  # of a graph like a grid; with 65,000 factors took 21 s where sweeps take 8
_DIRECT = 1e7  # states times bandwidth up to which a direct solve takes less than hundreds of sweeps
_TOLERANCE, _ROUNDINGS = 1e-12, 8.0  # of what b may span: a share of the largest |feature|, and roundings of |V|


def best(choices: Choices, progress: bool = False) -> BestChoices:
    """The best policy for each feature, with a bar over features if `progress`."""
    shape = len(choices.initial), len(choices.size)
    value, status = np.zeros(shape), Status.SOLVED
    for _ in range(_SHARED_SWEEPS if _is_direct(choices) else 0):  # one product for all features
        value = choices.backup(value, slice(None)).max(axis=1)
    actions = choices.backup(value, slice(None)).argmax(axis=1)
    for k in tqdm(range(shape[1]), "features", disable=not progress):
        reward = np.ascontiguousarray(choices.reward[..., k])
        plan = _planned(choices, reward, choices.size[k], actions[:, k])
        value[:, k], actions[:, k] = plan.value, plan.actions
        status = status if plan.is_settled else Status.STALLED
    return _found(choices, value, actions, status)


def of_policy(choices: Choices) -> BestChoices:
    """The values of a policy, of choices in which every state is fixed."""
    actions = choices.first
    value = _solved(choices, actions, choices.own_reward, is_flow=False)
    status = Status.SOLVED if np.isfinite(value).all() else Status.STALLED
    return _found(choices, np.nan_to_num(value), np.broadcast_to(actions[:, None], value.shape), status)


def contributions(
    choices: Choices, best: BestChoices, own: BestChoices, share: Float[np.ndarray, " K"]
) -> Float[np.ndarray, " S"]:
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


def _found(choices: Choices, value, actions, status: int) -> BestChoices:
    gain = choices.backup(value, slice(None)).max(axis=1) - value
    largest = np.abs(value).max(axis=0)
    lower, upper = choices.bounds(value, (gain.min(axis=0), gain.max(axis=0)), largest)
    return BestChoices(lower, upper, value, actions, int(status))


class _Planned(NamedTuple):
    value: Float[np.ndarray, " S"]
    actions: Int[np.ndarray, " S"]
    is_settled: bool


def _planned(choices: Choices, reward: Float[np.ndarray, "S A"], size: float, start: Int[np.ndarray, " S"]) -> _Planned:
    """The best choices for one reward, whose size is at most `size`; `start` is where solves begin."""
    swept = None if _is_direct(choices) else _swept(choices, reward, size)
    if swept and (swept.is_settled or not choices.model.is_solvable):
        return swept
    plan = policy_iteration.iterate(choices.model, reward, swept.actions if swept else start, _EPS)
    return _Planned(plan.value, plan.actions, plan.is_settled) if plan else swept or _swept(choices, reward, size)


def _swept(choices: Choices, reward: Float[np.ndarray, "S A"], size: float) -> _Planned:
    """Modified policy iteration: a sweep over all actions, then a block of sweeps with those that it chose.

    Values are shifted by the constant that halves what is open (as in `planning.modified_policy_iteration`). Where the
    span hardly falls, sweeps over all actions end it: blocks leave bounds that are further apart.
    """
    states, shift = np.arange(len(reward)), 0.5 * choices.discount / (1.0 - choices.discount)
    value, former, blocks, left = np.zeros(len(reward)), np.inf, 0, _MOST_BLOCKS
    while True:
        action_value = reward + choices.discount * choices.model.expected_next_value(value)
        actions = action_value.argmax(axis=1)
        improved = action_value[states, actions]
        low, high = (improved - value).min(), (improved - value).max()
        value, span, left = improved + shift * (low + high), high - low, left - 1
        is_settled = bool(span <= _TOLERANCE * size + _ROUNDINGS * _EPS * np.abs(value).max())
        if is_settled or left <= 0:
            return _Planned(value, actions, is_settled)
        blocks += 1
        if blocks % _LOOK_BACK == 0:
            left, former = min(left, _LAST_SWEEPS) if span > _SLOW * former else left, span
        if left > _LAST_SWEEPS:
            chain, own = choices.leads(actions), reward[states, actions]
            for _ in range(_BLOCK):
                value = own + choices.discount * (chain @ value)


def _is_direct(choices: Choices) -> bool:
    """Whether linear systems are solved by elimination before anything else is tried."""
    model = choices.model
    is_small = model.num_states <= _NARROW_STATES and model.is_narrow
    return model.is_solvable and (is_small or model.num_states * model.bandwidth <= _DIRECT)


def _solved(choices: Choices, actions, right: Float[np.ndarray, "S L"], *, is_flow: bool) -> Float[np.ndarray, "S L"]:
    """Values of rewards, or occupancies of distributions, under actions [S]; NaN where nothing is found."""
    chain = choices.model.chain(actions, may_iterate=True)
    if is_flow and choices.model.moves_sooner(_SWEPT):
        found = np.stack([chain.moved(column, _SWEPT) for column in right.T], axis=1)
        if np.isfinite(found).all():
            return found
    found = chain.flow(right) if is_flow else chain.value(right)
    for k in np.flatnonzero(np.isnan(found).any(axis=0)):  # of a large model
        found[:, k] = chain.swept(right[:, k], _SWEPT, is_flow=is_flow)
    return found
