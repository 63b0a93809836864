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
import scipy

from jaxhom.guarantees.choices import Choices, Found
from jaxhom.planning import policy_iteration
from jaxhom.status import Status

if TYPE_CHECKING:
    from jaxtyping import Float

_EPS = float(np.finfo(np.float64).eps)
_SWEEPS = 100  # before linear systems are solved, where that is quick
_MOST_SWEEPS = 10_000  # where it is not: their error falls by gamma with each, and faster where the graph mixes
_DIRECT = 1e7  # states times bandwidth up to which a direct solve takes less than hundreds of sweeps
_TOLERANCE = 1e-11  # of what b may span, as a share of the largest |feature|
_KRYLOV_STEPS, _KRYLOV_RESIDUAL = 1000, 1e-13


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
    actions, states = choices.first, np.arange(len(choices.first))
    value = _solved(choices, actions, choices.reward[states, actions], is_flow=False)
    return _found(choices, value, np.broadcast_to(actions[:, None], value.shape), Status.SOLVED)


def contributions(choices: Choices, best: Found, own: Found, k: int) -> Float[np.ndarray, " S"]:
    """What every state adds to the loss of a policy of values `own` against the best choices for feature k."""
    actions = best.actions[:, k]
    mu = np.maximum(_solved(choices, actions, choices.initial[:, None], is_flow=True)[:, 0], 0.0)
    action_value = choices.backup(own.values[:, [k]], [k])[..., 0]
    return mu * (action_value[np.arange(len(mu)), actions] - own.values[:, k])


def _found(choices: Choices, value, actions, status: int) -> Found:
    gain = choices.backup(value, slice(None)).max(axis=1) - value
    largest = np.abs(value).max(axis=0)
    lower, upper = choices.bounds(value, (gain.min(axis=0), gain.max(axis=0)), largest)
    return Found(lower, upper, value, actions, int(status))


def _swept(choices: Choices) -> tuple[Float[np.ndarray, "S K"], np.ndarray]:
    """Values after sweeps, shifted by the constant that halves what is open, and which features are still open."""
    sweeps = _SWEEPS if _is_direct(choices) else _MOST_SWEEPS
    value = np.zeros((len(choices.initial), len(choices.size)))
    time = 1.0 / (1.0 - choices.discount)
    for _ in range(sweeps):
        improved = choices.backup(value, slice(None)).max(axis=1)
        change = improved - value
        low, high = change.min(axis=0), change.max(axis=0)
        value = improved + choices.discount * time * 0.5 * (low + high)
        is_open = high - low > _TOLERANCE * choices.size
        if not is_open.any():
            break
    return value, is_open


def _is_direct(choices: Choices) -> bool:
    """Whether linear systems are solved by elimination before anything else is tried."""
    model = choices.model
    return model.is_solvable and (model.is_narrow or model.num_states * model.bandwidth <= _DIRECT)


def _solved(choices: Choices, actions, right: Float[np.ndarray, "S L"], *, is_flow: bool) -> Float[np.ndarray, "S L"]:
    """Values of rewards, or occupancies of distributions, under actions [S]; zeros where nothing is found.

    What is wrong with them is seen in the bounds.
    """
    model = choices.model
    found = np.full_like(right, np.nan)
    if not _is_direct(choices):
        found = _by_krylov(choices, actions, right, is_flow)
    if not np.isfinite(found).all() and model.is_solvable:
        chain = model.chain(actions)
        found = chain.state_occupancy(right[:, 0])[:, None] if is_flow else chain.value(right)
    return np.nan_to_num(found)


def _by_krylov(choices: Choices, actions, right, is_flow: bool) -> Float[np.ndarray, "S L"]:
    """BiCGSTAB for each right-hand side; NaN where it does not get there."""
    matrix = choices.leads(actions)
    matrix = matrix.T if is_flow else matrix
    shape, discount = matrix.shape, choices.discount
    system = scipy.sparse.linalg.LinearOperator(shape, lambda v: v - discount * (matrix @ v), dtype=float)
    options = {"rtol": _KRYLOV_RESIDUAL, "atol": 0.0, "maxiter": _KRYLOV_STEPS}
    found = np.full_like(right, np.nan)
    for lane, one in enumerate(right.T):
        with np.errstate(all="ignore"):
            solution, flag = scipy.sparse.linalg.bicgstab(system, one, **options)
        if flag == 0:
            found[:, lane] = solution
    return found
