"""Expectations that no policy can reach, brought to the size of what policies do reach, without changing the game.

Feature i of any policy lies in [low_i, high_i], its smallest and largest value times the discounted time, which is
1 / (1 - gamma) where probabilities sum to exactly 1. With Vhat,

    L = min_i low_i - Vhat_i   <=   margin of any policy   <=   U = min_i high_i - Vhat_i.

A feature with low_i - Vhat_i > U is the smallest for no policy, so its Vhat_i may be raised to low_i - U; and adding a
constant c to all of Vhat lowers all margins by c. With c the number in [L, U] that is nearest to 0, expectations are
then within max_i high_i - low_i of some [low_i, high_i]: methods lose no digits to them. Ordinary expectations stay as
they are.

The same numbers say how small a gap is: small against what each of the features that may be the smallest can do.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jaxhom.apprenticeship.exact import compact_features
from jaxhom.models.mdp import MDP
from jaxhom.status import Record

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

_GAP = 1e-5  # share of what a feature can do: a policy that loses so little is as good
_SAME = 4.0  # roundings of a feature's size within which two of its values are the same


class Reduction(Record):
    """What was changed, per lane; NumPy, float64.

    Attributes:
      expectations: [B, K], to solve for in place of the given ones.
      shift: [B], c: what margins for the given ones are larger by.
      is_idle: bool [B, K], features that are the smallest for no policy.
      scarcest: [B], a feature that is never larger than those.
      least: [B], the least that a feature can do per step which is not idle; the largest |feature| if none does
        anything.
    """

    expectations: Float[np.ndarray, "B K"]
    shift: Float[np.ndarray, " B"]
    is_idle: Bool[np.ndarray, "B K"]
    scarcest: Int[np.ndarray, " B"]
    least: Float[np.ndarray, " B"]

    def weights(self, lanes: Int[np.ndarray, " C"], weights: Float[np.ndarray, "C K"]) -> Float[np.ndarray, "C K"]:
        """Weights for the given expectations of some lanes from those for the reduced ones.

        Weight on an idle feature goes to the scarcest one, which is smaller for every policy: the bound that it proves
        can only get better.
        """
        idle, to = self.is_idle[lanes], self.scarcest[lanes][:, None]
        kept = np.where(idle, 0.0, weights)
        np.put_along_axis(kept, to, 0.0, axis=1)
        np.put_along_axis(kept, to, np.maximum(0.0, 1.0 - kept.sum(axis=1, keepdims=True)), axis=1)
        return np.where(idle.any(axis=1, keepdims=True), kept, weights)


class Reach(Record):
    """What the features of policies can be, and do; NumPy, float64.

    Attributes:
      low, high: [K], the least and the largest discounted sum of each feature, whatever the policy; with the sums of
        probabilities as they are after rounding, and as they should be.
      scale: [K], what each feature can do per step; infinite where it is constant.
      size: scalar, the largest |feature|; 1 if all are 0.
      discount: scalar.
    """

    low: Float[np.ndarray, " K"]
    high: Float[np.ndarray, " K"]
    scale: Float[np.ndarray, " K"]
    size: float
    discount: float

    @classmethod
    def of(cls, mdp: MDP) -> Reach:
        """That of a concrete model."""
        values = _values(mdp)
        low, high = _sums(mdp, values)
        same = _SAME * float(np.finfo(mdp.dtype).eps)
        size, discount = float(np.abs(values).max()) or 1.0, float(mdp.discount)
        return cls(low=low, high=high, scale=_scales(values, same), size=size, discount=discount)


def reduce_expectations(reach: Reach, expectations: Float[np.ndarray, "B K"]) -> Reduction:
    """Reduces expectations, on the host."""
    low, high = reach.low, reach.high
    most = (high - expectations).min(axis=1)
    least = (low - expectations).min(axis=1)
    floor = low - most[:, None]
    shift = np.clip(0.0, least, most)
    is_idle = expectations < floor
    scale = np.where(is_idle, np.inf, reach.scale).min(axis=1)
    return Reduction(
        expectations=np.maximum(expectations, floor) + shift[:, None],
        shift=shift,
        is_idle=is_idle,
        scarcest=(high - expectations).argmin(axis=1),
        least=np.where(np.isfinite(scale), scale, reach.size),
    )


def default_tolerance(reach: Reach, reduction: Reduction) -> Float[np.ndarray, " B"]:
    """A gap that is small against the least that a feature can do which may be the smallest of its lane.

    Where features of two scales bind together, the margin is decided in the units of the smaller one. Constant features
    do nothing.
    """
    return _GAP / (1.0 - reach.discount) * reduction.least


def _scales(values: np.ndarray, same: float) -> np.ndarray:
    """What each feature can do per step, from its values [N, K]; infinite where it is constant.

    Its range; but at most twice the distance from its largest value to the median of the others: a few pairs that are
    very bad (a cliff), which good policies avoid, are not what gaps are measured by.
    """
    low, high = values.min(axis=0), values.max(axis=0)
    scale = high - low
    same = same * np.maximum(abs(low), abs(high))
    is_constant = scale <= same
    is_below = values < high - same
    many_high = (is_below & (values > high - 0.5 * scale)).sum(axis=0) >= 0.5 * is_below.sum(axis=0)
    for k in np.flatnonzero(many_high & ~is_constant):
        others = np.sort(values[is_below[:, k], k])
        scale[k] = min(scale[k], 2.0 * (high[k] - others[len(others) // 2]))
    return np.where(is_constant, np.inf, scale)


def _values(mdp: MDP) -> np.ndarray:
    """The features of all pairs that are allowed, [N, K], float64."""
    allowed = np.asarray(mdp.allowed)
    features = compact_features(np.asarray(mdp.features), allowed).astype(np.float64)
    if mdp.restricts_actions and features.shape[1] > 1:
        return features[allowed]
    return features.reshape(-1, features.shape[-1])


def _sums(mdp: MDP, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least and largest discounted sums, low [K] and high [K], over what rounding leaves open."""
    total = np.asarray(mdp.probability).sum(axis=-1, dtype=np.float64)[np.asarray(mdp.allowed)]
    kept = float(mdp.discount) * np.array([[min(total.min(), 1.0)], [max(total.max(), 1.0)]])
    mass = np.asarray(mdp.initial).sum(dtype=np.float64)
    times = mass / (1.0 - kept)
    return (values.min(axis=0) * times).min(axis=0), (values.max(axis=0) * times).max(axis=0)
