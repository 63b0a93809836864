"""Expectations that no policy can reach, brought to the size of what policies do reach, without changing the game.

Feature i of any policy lies in [low_i, high_i], its smallest and largest value times the discounted time, which is
1 / (1 - gamma) where probabilities sum to exactly 1. With Vhat,

    L = min_i low_i - Vhat_i   <=   margin of any policy   <=   U = min_i high_i - Vhat_i.

A feature with low_i - Vhat_i > U is the smallest for no policy, so its Vhat_i may be raised to low_i - U; and adding a
constant c to all of Vhat lowers all margins by c. With c the number in [L, U] that is nearest to 0, expectations are
then within max_i high_i - low_i of some [low_i, high_i]: methods lose no digits to them. Ordinary expectations stay as
they are.
"""

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxhom.lpal.certificate import LPALSolution
from jaxhom.mdp import MDP
from jaxhom.pdhg import Status


@chex.dataclass(frozen=True)
class Reduction:
    """What was changed, per lane; NumPy, float64.

    Attributes:
      expectations: [B, K], to solve for in place of the given ones.
      shift: [B], c: what margins for the given ones are larger by.
      is_idle: bool [B, K], features that are the smallest for no policy.
      scarcest: [B], a feature that is never larger than those.
    """

    expectations: np.ndarray
    shift: np.ndarray
    is_idle: np.ndarray
    scarcest: np.ndarray


def reduce_expectations(mdp: MDP, expectations: np.ndarray) -> Reduction:
    """Reduces expectations [B, K], on the host."""
    low, high = _reach(mdp)
    most = (high - expectations).min(axis=1)
    least = (low - expectations).min(axis=1)
    floor = low - most[:, None]
    shift = np.clip(0.0, least, most)
    return Reduction(
        expectations=np.maximum(expectations, floor) + shift[:, None],
        shift=shift,
        is_idle=expectations < floor,
        scarcest=(high - expectations).argmin(axis=1),
    )


def _reach(mdp: MDP) -> tuple[np.ndarray, np.ndarray]:
    """low [K] and high [K]; with the sums of probabilities as they are after rounding."""
    features = np.asarray(mdp.features, np.float64)
    kept = float(mdp.discount) * np.asarray(mdp.probability).sum(axis=-1, dtype=np.float64)
    mass = np.asarray(mdp.initial).sum(dtype=np.float64)
    times = mass / (1.0 - np.array([[kept.min()], [kept.max()]]))
    return (features.min(axis=(0, 1)) * times).min(axis=0), (features.max(axis=(0, 1)) * times).max(axis=0)


def restore(solution: LPALSolution, reduction: Reduction, tolerance: float) -> LPALSolution:
    """The solution for the given expectations from that for the reduced ones.

    Weight on an idle feature goes to the scarcest one, which is smaller for every policy: the bound that it proves
    can only get better.
    """
    idle = jnp.asarray(reduction.is_idle)
    moved = jnp.where(idle, solution.weights, 0.0)
    to = jax.nn.one_hot(reduction.scarcest, idle.shape[1], dtype=moved.dtype)
    weights = solution.weights - moved + moved.sum(axis=1, keepdims=True) * to
    shift = jnp.asarray(reduction.shift, moved.dtype)
    # What was solved differs from what was asked by the rounding of these numbers.
    is_changed = (reduction.shift != 0) | reduction.is_idle.any(axis=1)
    size = np.where(is_changed, np.abs(reduction.shift) + np.abs(reduction.expectations).max(axis=1), 0.0)
    margin = solution.margin + shift
    margin_bound = solution.margin_bound + shift + 4.0 * jnp.finfo(moved.dtype).eps * jnp.asarray(size, moved.dtype)
    is_open = is_changed & (solution.status == Status.SOLVED) & (margin_bound - margin > tolerance)
    status = jnp.where(is_open, jnp.int32(Status.STALLED), solution.status)
    return solution.replace(weights=weights, margin=margin, margin_bound=margin_bound, status=status)
