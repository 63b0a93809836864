"""Expectations that no policy can reach, brought to the size of what policies do reach, without changing the game.

Feature i of any policy lies in [low_i, high_i], its smallest and largest value times the discounted time, which is
1 / (1 - gamma) where probabilities sum to exactly 1. With Vhat,

    L = min_i low_i - Vhat_i   <=   margin of any policy   <=   U = min_i high_i - Vhat_i.

A feature with low_i - Vhat_i > U is the smallest for no policy, so its Vhat_i may be raised to low_i - U; and adding a
constant c to all of Vhat lowers all margins by c. With c the number in [L, U] that is nearest to 0, expectations are
then within max_i high_i - low_i of some [low_i, high_i]: methods lose no digits to them. Ordinary expectations stay as
they are.

The same numbers say how small a gap is: small against what each of the features that may be the smallest can do.

In NumPy where everything is concrete, and in JAX inside a program.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np

from jaxhom import checks
from jaxhom.apprenticeship.exact import compact_features
from jaxhom.models.mdp import MDP
from jaxhom.status import Record

if TYPE_CHECKING:
    from types import ModuleType

    from jaxtyping import Array, Bool, Float, Int

    Host = np.ndarray | Array

_GAP = 1e-5  # share of what a feature can do: a policy that loses so little is as good
_SAME = 4.0  # roundings of a feature's size within which two of its values are the same


class Reduction(Record):
    """What was changed, per lane.

    Attributes:
      expectations: [B, K], to solve for in place of the given ones.
      shift: [B], c: what margins for the given ones are larger by.
      is_idle: bool [B, K], features that are the smallest for no policy.
      scarcest: [B], a feature that is never larger than those.
      least: [B], the least that a feature can do per step which is not idle; the largest |feature| if none does
        anything.
    """

    expectations: Float[Host, "B K"]
    shift: Float[Host, " B"]
    is_idle: Bool[Host, "B K"]
    scarcest: Int[Host, " B"]
    least: Float[Host, " B"]

    def weights(self, lanes: Int[np.ndarray, " C"] | slice, weights: Float[Host, "C K"]) -> Float[Host, "C K"]:
        """Weights for the given expectations of some lanes from those for the reduced ones.

        Weight on an idle feature goes to the scarcest one, which is smaller for every policy: the bound that it proves
        can only get better.
        """
        numpy, idle = _numpy_of(weights), self.is_idle[lanes]
        is_scarcest = numpy.arange(weights.shape[1]) == self.scarcest[lanes][:, None]
        kept = numpy.where(idle | is_scarcest, 0.0, weights)
        rest = numpy.maximum(0.0, 1.0 - kept.sum(axis=1, keepdims=True))
        return numpy.where(idle.any(axis=1, keepdims=True), numpy.where(is_scarcest, rest, kept), weights)


class Reach(Record):
    """What the features of policies can be, and do.

    Attributes:
      low, high: [K], the least and the largest discounted sum of each feature, whatever the policy; with the sums of
        probabilities as they are after rounding, and as they should be.
      scale: [K], what each feature can do per step; infinite where it is constant.
      size: scalar, the largest |feature|; 1 if all are 0.
      discount: scalar.
    """

    low: Float[Host, " K"]
    high: Float[Host, " K"]
    scale: Float[Host, " K"]
    size: float | Float[Array, ""]
    discount: float | Float[Array, ""]

    @classmethod
    def of(cls, mdp: MDP) -> Reach:
        """That of a model: in float64 if it is concrete, inside a program in the model's type."""
        numpy = jnp if checks.is_traced(mdp) else np
        values, exists = _values(mdp)
        bottom, top = _extremes(values, exists)
        times = _times(mdp)
        size = numpy.abs(values).max()
        return cls(
            low=(bottom * times).min(axis=0),
            high=(top * times).max(axis=0),
            scale=_scales(values, exists, _SAME * float(jnp.finfo(mdp.dtype).eps)),
            size=numpy.where(size > 0, size, 1.0),
            discount=mdp.discount if numpy is jnp else float(mdp.discount),
        )


def reduce_expectations(reach: Reach, expectations: Float[Host, "B K"]) -> Reduction:
    """Reduces expectations."""
    numpy, low, high = _numpy_of(expectations), reach.low, reach.high
    most = (high - expectations).min(axis=1)
    least = (low - expectations).min(axis=1)
    floor = low - most[:, None]
    shift = numpy.clip(0.0, least, most)
    is_idle = expectations < floor
    scale = numpy.where(is_idle, numpy.inf, reach.scale).min(axis=1)
    return Reduction(
        expectations=numpy.maximum(expectations, floor) + shift[:, None],
        shift=shift,
        is_idle=is_idle,
        scarcest=(high - expectations).argmin(axis=1),
        least=numpy.where(numpy.isfinite(scale), scale, reach.size),
    )


def default_tolerance(reach: Reach, reduction: Reduction) -> Float[Host, " B"]:
    """A gap that is small against the least that a feature can do which may be the smallest of its lane.

    Where features of two scales bind together, the margin is decided in the units of the smaller one. Constant features
    do nothing.
    """
    return _GAP / (1.0 - reach.discount) * reduction.least


def _numpy_of(array: Host) -> ModuleType:
    return np if isinstance(array, np.ndarray) else jnp


def _scales(values: Float[Host, "N K"], exists: Bool[Host, "N 1"], same: float) -> Float[Host, " K"]:
    """What each feature can do per step; infinite where it is constant.

    Its range; but at most twice the distance from its largest value to the median of the others: a few pairs that are
    very bad (a cliff), which good policies avoid, are not what gaps are measured by.
    """
    numpy, (low, high) = _numpy_of(values), _extremes(values, exists)
    scale = high - low
    same = same * numpy.maximum(abs(low), abs(high))
    is_constant = scale <= same
    is_below = exists & (values < high - same)
    many_high = (is_below & (values > high - 0.5 * scale)).sum(axis=0) >= 0.5 * is_below.sum(axis=0)
    has_cliff = many_high & ~is_constant
    # On the host only what is needed is sorted: millions of pairs and hundreds of features may not be.
    some = np.flatnonzero(has_cliff) if numpy is np else np.arange(values.shape[1])
    others = numpy.sort(numpy.where(is_below[:, some], values[:, some], numpy.inf), axis=0)
    middle = numpy.take_along_axis(others, is_below[:, some].sum(axis=0)[None] // 2, axis=0)[0]
    without_cliff = numpy.minimum(scale[some], 2.0 * (high[some] - middle))
    if numpy is np:
        scale[some] = without_cliff
    else:
        scale = jnp.where(has_cliff, without_cliff, scale)
    return numpy.where(is_constant, numpy.inf, scale)


def _extremes(values: Float[Host, "N K"], exists: Bool[Host, "N 1"]) -> tuple[Float[Host, " K"], Float[Host, " K"]]:
    """The least and the largest value of each feature."""
    return values.min(axis=0, where=exists, initial=np.inf), values.max(axis=0, where=exists, initial=-np.inf)


def _values(mdp: MDP) -> tuple[Float[Host, "N K"], Bool[Host, "N 1"]]:
    """The features of all pairs, and which pairs are allowed."""
    if checks.is_traced(mdp):
        return mdp.features.reshape(-1, mdp.num_features), mdp.allowed.reshape(-1, 1)
    allowed = np.asarray(mdp.allowed)
    features = compact_features(np.asarray(mdp.features), allowed).astype(np.float64)
    exists = allowed if features.shape[1] > 1 else np.ones((len(features), 1), bool)
    return features.reshape(-1, features.shape[-1]), exists.reshape(-1, 1)


def _times(mdp: MDP) -> Float[Host, "2 1"]:
    """The least and the largest discounted time [2, 1], over what rounding leaves open."""
    numpy = jnp if checks.is_traced(mdp) else np
    if numpy is jnp:
        total, initial, discount = mdp.probability.sum(axis=-1), mdp.initial.sum(), mdp.discount
        least = jnp.where(mdp.allowed, total, 1.0).min()
    else:
        total = np.asarray(mdp.probability).sum(axis=-1, dtype=np.float64)[np.asarray(mdp.allowed)]
        least, discount = total.min(), float(mdp.discount)
        initial = np.asarray(mdp.initial).sum(dtype=np.float64)
    kept = discount * numpy.stack([numpy.minimum(least, 1.0), numpy.maximum(total.max(), 1.0)])
    return (initial / (1.0 - kept))[:, None]
