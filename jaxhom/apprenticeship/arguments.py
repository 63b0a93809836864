"""What callers of LPAL give, checked: expectations, starts, and features that sums over time can hold.

Of traced values only the shapes are.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np

from jaxhom import checks
from jaxhom.apprenticeship.solution import LPALSolution
from jaxhom.models.inputs import check_policy
from jaxhom.models.mdp import MDP

if TYPE_CHECKING:
    from jaxtyping import Array, Float

    Host = np.ndarray | Array

_LARGEST = 2.0**-20  # share of the largest number of a type: what sums of expectations may need stays within it


def check_features(mdp: MDP) -> None:
    """Raises unless features are small enough for sums over time in the model's type."""
    features, largest = np.asarray(mdp.features), _largest(mdp) * (1.0 - float(mdp.discount))
    if max(features.max(), -features.min()) > largest:
        message = f"is too large for sums over time in {mdp.dtype} at this discount"
        checks.require_all("features", features, np.abs(features) <= largest, message)


def checked_expectations(mdp: MDP, expectations) -> Float[np.ndarray, "*B K"] | Float[Array, "*B K"]:
    """Expectations [K] or [B, K], small enough for margins in the model's type where they are concrete."""
    is_traced = checks.is_traced(expectations)
    host = expectations if is_traced else checks.as_host_array("expectations", expectations)
    good = host.ndim in (1, 2) and host.shape[-1] == mdp.num_features and host.size > 0
    checks.require_shape("expectations", host, f"({mdp.num_features},) or (B, {mdp.num_features})", good)
    if is_traced:
        return host
    host = checks.require_floats("expectations", host)
    checks.require_all("expectations", host, np.abs(host) <= _largest(mdp), f"is too large for margins in {mdp.dtype}")
    return host


def check_tolerance(tolerance: Any, expectations: Float[Host, "*B K"]) -> None:
    """Raises unless a tolerance is positive, and one number or, beside expectations [B, K], one for each lane."""
    checks.require_positive("tolerance", tolerance)
    shapes = sorted({(), expectations.shape[:-1]})
    checks.require_shape("tolerance", tolerance, " or ".join(map(str, shapes)), np.shape(tolerance) in shapes)


def _largest(mdp: MDP) -> float:
    return _LARGEST * float(np.finfo(mdp.dtype).max)


def checked_start(
    mdp: MDP, batch: tuple[int, int], initial_policy: Any, warm_start: Any
) -> tuple[Float[Host, "B S A"] | None, Float[Host, "B K"] | None]:
    """Policies and weights to begin with, or None; for expectations of the shape `batch`, [B, K]."""
    weights = None
    if warm_start is not None:
        if not isinstance(warm_start, LPALSolution):
            raise ValueError(f"warm_start must be an LPALSolution, got {type(warm_start).__name__}")
        weights = _for_each_lane("warm_start.weights", warm_start.weights, batch, rank=1)
    is_given = initial_policy is not None
    name = "initial_policy" if is_given or warm_start is None else "warm_start.policy"
    guess = initial_policy if is_given or warm_start is None else warm_start.policy
    policies = None if guess is None else _for_each_lane(name, check_policy(mdp, guess, name), batch, rank=2)
    return policies, weights


def _for_each_lane(name: str, guess: Any, batch: tuple[int, int], rank: int) -> Host:
    """Weights [K] (rank 1) or policies [S, A] (rank 2), one for all lanes of the batch or one for each, as [B, ...]."""
    is_traced = checks.is_traced(guess)
    guess = guess if is_traced else checks.as_host_array(name, guess)
    lane_shape = batch[1:] if rank == 1 else guess.shape[-2:]
    good = guess.shape[-rank:] == lane_shape and guess.shape[:-rank] in ((), batch[:1])
    checks.require_shape(name, guess, f"({batch[0]}, {'K' if rank == 1 else 'S, A'})", good)
    if is_traced:
        return jnp.broadcast_to(guess, (batch[0], *lane_shape))
    return np.broadcast_to(checks.require_distribution(name, guess), (batch[0], *lane_shape))
