"""Policy iteration on the host, in float64, by direct solves (Howard 1960; Puterman 1994, section 6.4).

Where two recurrent classes keep their values apart, a sweep shrinks the error by gamma and no more: hundreds of
thousands of sweeps at discounts near 1. Policy iteration with exact values takes 3 to 10 steps whatever the discount.

Ties are local: two actions are alike if their difference is what rounding can make of *their* numbers, their rewards
and how far the values of the states differ that they lead to. A reward of -1e6 elsewhere, or a constant that all values
share, decides nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import scipy

from jaxhom.planning.host_chains import HostModel

if TYPE_CHECKING:
    from collections.abc import Callable

    from jaxtyping import Float, Int

_MAX_IMPROVEMENTS = 1000  # never needed: it ends a loop that rounding might keep going
# Between two solves, at most: of models whose factors take no longer than these (grids from 24 x 24 to 48 x 48, at
# discounts from 0.9 to 0.999), and of others.
_FEW_SWEEPS, _SWEEPS = 10, 100
_ROUNDINGS = 16.0  # of the model's type, in rewards and differences of values: a backup adds a few of each up
_ROUNDINGS_OF_VALUES = 64.0  # of float64, in the values themselves, which come from a factorisation


class HostPlan(NamedTuple):
    """What `iterate` returns.

    Attributes:
      actions: int [S], the first of the best actions in every state.
      value: [S], float64. action_value: [S, A], -inf where an action is not allowed.
      residual: max_s |max_a action_value(s, a) - value(s)|.
      iterations: policies that were tried.
      is_settled: whether no action is better; otherwise rounding or the limit came first.
    """

    actions: Int[np.ndarray, " S"]
    value: Float[np.ndarray, " S"]
    action_value: Float[np.ndarray, "S A"]
    residual: float
    iterations: int
    is_settled: bool


def iterate(
    model: HostModel,
    reward: Float[np.ndarray, "S A"],
    actions: Int[np.ndarray, " S"],
    eps: float,
    limit: int = _MAX_IMPROVEMENTS,
) -> HostPlan | None:
    """Improves a policy until no action is better.

    Args:
      model: the model.
      reward: [S, A], float64; -inf where an action is not allowed.
      actions: int [S], allowed ones, to begin with.
      eps: rounding of the numbers that the model was given in.
      limit: policies to try at most.

    Returns:
      `HostPlan`; None if the first policy's values cannot be computed.
    """

    def backup(value):
        return reward + model.discount * model.expected_next_value(value)

    states, best = np.arange(len(actions)), None
    for count in range(1, limit + 1):
        value = model.chain(actions).value(reward[states, actions])
        # Exact values never fall from policy to policy: if they do, rounding has won.
        if not np.isfinite(value).all() or (best is not None and value.sum() < best[1].sum()):
            break
        action_value = backup(value)
        best = (actions, value, action_value, count)
        improved = _improve(actions, action_value)
        if improved is actions:
            return _finish(model, reward, best, eps, is_settled=True)
        actions = swept(model, backup, improved, value)
    return None if best is None else _finish(model, reward, best, eps, is_settled=False)


def swept(
    model: HostModel,
    backup: Callable[[np.ndarray], np.ndarray],
    actions: Int[np.ndarray, " S"],
    value: Float[np.ndarray, " S"],
) -> Int[np.ndarray, " S"]:
    """Better actions by sweeps, as long as these change the policy.

    They cost little beside a factorisation, and carry news from state to state: on a grid of 24 x 24 at a discount of
    0.99 policy iteration ends after 6 of them instead of 11.

    Args:
      model: the model.
      backup: takes values [S], returns action values [S, A].
      actions: those that are best by the values [S], which are not above what the actions are worth.
    """
    states = np.arange(len(actions))
    value = backup(value)[states, actions]
    for _ in range(_FEW_SWEEPS if model.is_band else _SWEEPS):
        action_value = backup(value)
        improved = _improve(actions, action_value)
        if improved is actions:
            break
        actions, value = improved, action_value[states, improved]
    return actions


def _improve(actions: np.ndarray, action_value: np.ndarray) -> np.ndarray:
    """The best actions where they are better than the given ones; the same array where none is."""
    now = action_value[np.arange(len(actions)), actions]
    is_better = action_value.max(axis=1) - now > _ROUNDINGS_OF_VALUES * np.finfo(float).eps * np.abs(now)
    return np.where(is_better, action_value.argmax(axis=1), actions) if is_better.any() else actions


def _finish(model: HostModel, reward, best, eps: float, is_settled: bool) -> HostPlan:
    _, value, action_value, count = best
    top = action_value.max(axis=1)
    alike = top[:, None] - action_value <= _tie_tolerance(model, reward, value, action_value, eps)
    return HostPlan(
        actions=alike.argmax(axis=1),
        value=value,
        action_value=action_value,
        residual=float(np.abs(top - value).max()),
        iterations=count,
        is_settled=is_settled,
    )


def _tie_tolerance(model: HostModel, reward, value, action_value, eps: float) -> np.ndarray:
    """[S, A]: the loss against the best action that rounding can have made: the work's, in float64, and the model's.

    A loss in every step adds up to 1 / (1 - discount) of it: what the model's type hides is counted in the sum.
    """
    size = np.where(np.isfinite(reward), np.abs(reward), 0.0) + _spread(model, value)
    best = action_value.argmax(axis=1)[:, None]
    size = size + np.take_along_axis(size, best, axis=1)
    top = np.abs(np.take_along_axis(action_value, best, axis=1))
    eps = max(eps * (1.0 - model.discount), np.finfo(float).eps)
    return _ROUNDINGS * eps * size + _ROUNDINGS_OF_VALUES * np.finfo(float).eps * top


def _spread(model: HostModel, value: np.ndarray) -> np.ndarray:
    """[S, A]: how far the values of the states differ that a pair leads to."""
    shape = (model.num_states, model.num_actions)
    if not scipy.sparse.issparse(model.rows):
        leads = model.rows > 0
        high, low = np.where(leads, value, -np.inf).max(axis=1), np.where(leads, value, np.inf).min(axis=1)
        return np.where(leads.any(axis=1), high - low, 0.0).reshape(shape)
    spread = np.zeros(shape).ravel()
    is_used = np.diff(model.rows.indptr) > 0
    begin = model.rows.indptr[:-1][is_used]
    of_entries = value[model.rows.indices]
    spread[is_used] = np.maximum.reduceat(of_entries, begin) - np.minimum.reduceat(of_entries, begin)
    return spread.reshape(shape)
