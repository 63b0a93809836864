"""How much a policy can lose against an expert whose reward is not known.

The expert maximises, or does not, some reward w . phi with w >= 0; what is known is what it does on S^E, the
demonstrated states in which there was something to decide. For every feature k let U_k = max V_k(pi) over the policies
that agree with the expert on S^E, the expert among them. Then, whatever w >= 0,

    V_w(expert) - V_w(policy)  =  sum_k w_k (V_k(expert) - V_k(policy))  <=  w . (U - V(policy)).

Over weights that sum to 1 the largest such number is the largest gap U_k - V_k(policy). An expert that attains it
exists: the policy that maximises feature k. By the performance difference lemma (Kakade and Langford 2002) a gap is a
sum over states, see `all_time`: the states in which this policy does better than the one at hand are the critical ones.

Everything is computed on the host in float64, whatever the model's type, and rounded outward.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from jaxhom import checks
from jaxhom.apprenticeship.arguments import check_features
from jaxhom.guarantees import all_time, first_steps
from jaxhom.guarantees.choices import BestChoices, Choices
from jaxhom.models.demonstrations import Demonstrations, empirical_policy
from jaxhom.models.inputs import as_model, check_policy, require_features
from jaxhom.models.mdp import MDP, deciding_states
from jaxhom.models.names import Names, described
from jaxhom.solvers.blas_threads import one_blas_thread
from jaxhom.solvers.outward import rounded_down, rounded_up
from jaxhom.status import Record, Status

if TYPE_CHECKING:
    from jaxtyping import Array, ArrayLike, Bool, Float, Int

    Policy = Float[ArrayLike, "*B S A"] | Int[ArrayLike, " S"]

_SHOWN = 5  # states that `print` names
_LEAST_SHOWN = 1e-6  # of the bound: what rounding leaves is no state's fault
_AGREEMENT = 16.0  # roundings of the model's type within which two rows of a policy are the same


class LossBound(Record):
    """How much a policy can lose; with a batch of B policies every field gains a leading axis [B].

    All numbers are discounted sums, in the units of V. Bounds hold whatever the status is. `print` says them in words.

    Attributes:
      bound: scalar, no less than what the expert is worth more than the policy: for the weights that were given, or, if
        none were, for all weights >= 0 of sum 1. Below 0 where the policy is proved to be better than the expert.
      optima: [K], U_k: no policy that agrees with the expert is worth more for feature k. Rounded up.
      expectations: [K], V_k of the policy, rounded down.
      gaps: [K], optima - expectations: the bound for each feature as the reward.
      worst: int32 scalar, the feature of the largest gap; with weights, of the largest weighted gap.
      contributions: [S], what each state adds to the bound: how often the policy that maximises the worst feature
        (each of the weighted features) meets the state, times how much better its step is there than the policy's, if
        the policy goes on afterwards. 0 in states of S^E in which the policy does what the expert does. Some can be
        negative: steps that pay only if the better policy goes on. They sum to the bound, but for what it is rounded
        up by, see `loss_bound`.
      agreed: bool [S], the states S^E in which the expert is known: demonstrated, and something was to be decided.
      weights: [K], as given; None if none were.
      status: int32 scalar, a `jaxhom.Status`: SOLVED where every feature's optimum was found, and the policy's values.
      state_names: what the model calls its states; None without names, and after JAX transformations.
    """

    bound: Float[Array, "*B"]
    optima: Float[Array, "*B K"]
    expectations: Float[Array, "*B K"]
    gaps: Float[Array, "*B K"]
    worst: Int[Array, "*B"]
    contributions: Float[Array, "*B S"]
    agreed: Bool[Array, "*B S"]
    weights: Float[Array, "*B K"] | None = None
    status: Int[Array, "*B"]
    state_names: Names | None = dataclasses.field(default=None, metadata={"dropped": True})

    def __str__(self) -> str:
        try:
            return _in_words(self)
        except Exception:  # a batch, or what is no array but describes one
            return repr(self)


def loss_bound(
    mdp: MDP,
    demonstrations: Demonstrations,
    policy: Policy,
    *,
    weights: Float[ArrayLike, " K"] | None = None,
    horizon: int | None = None,
    progress: bool = False,
) -> LossBound:
    """Bounds how much less a policy is worth than the expert, whose reward is not known.

    It maximises each feature over all policies that agree with the expert on the demonstrated states, and compares
    with the policy. Assumed are the true model, a reward that is a combination w >= 0 of the features, and an expert
    that is deterministic on the demonstrated states, or does there what it was seen to do exactly as often. Nothing is
    assumed of the expert elsewhere, nor that it is optimal.

    Who knows the reward gives it as the only feature, `mdp.replace(features=reward[..., None])`: the bound is then the
    exact worst case over what the expert may do elsewhere.

    Args:
      mdp: the model, with K >= 1 features.
      demonstrations: the expert's trajectories. Absorbing states, in which nothing is decided, are left out. Where
        nothing was demonstrated the expert may be any policy.
      policy: [S, A] or [B, S, A], rows sum to 1; integers [S]; or what has one as `.policy`. It need not agree with
        the expert.
      weights: [K], not negative, of any sum: of the reward features @ weights. The bound is then
        weights @ gaps, which is exact where one weight alone is positive. If None, it holds for all weights >= 0 that
        sum to 1: for those of another sum, times that sum.
      horizon: H, to bound the loss over the first H steps, sums over t < H of gamma^t; for all time if None. The
        expert may then change its mind with time where it is not known, which stationary policies do not: the bound
        holds for both.
      progress: show how many features have been planned for; for all time only.

    Returns:
      `LossBound`. Contributions sum to weights @ (V(pi_k) - V(policy)) or, without weights, to that of the worst
      feature, with pi_k the best policies that were found. That is at most the bound, and less by what planning and
      rounding leave open: in float64 about 1e-14 / (1 - discount) of the largest value, if solved; in
      float32 1e-7 / (1 - discount).

    Raises:
      ValueError: if the model has no features, or such that their sums over time overflow, a demonstration does not
        fit it, `policy` or `weights` have another shape or are none, `horizon` is below 1, or anything is traced.

    Warns:
      ImpossibleStepsWarning: if steps have probability 0; see `Demonstrations.validate`.

    It is computed on the host: inside jit, vmap and grad of concrete values alone.

    Example:
      >>> import jaxhom
      >>> grid = jaxhom.gridworld(4, num_regions=4, discount=0.9)
      >>> demonstrations = jaxhom.Demonstrations.from_trajectories([([0, 1, 2, 3, 7], [2, 2, 2, 1, 1])])
      >>> general = jaxhom.nearest_neighbors(grid, demonstrations)
      >>> loss = loss_bound(grid, demonstrations, general)
      >>> round(float(loss.bound), 3), round(float(loss.contributions.sum()), 3), int(loss.agreed.sum())
      (2.386, 2.386, 5)

    Source: the bound is that of Syed, Bowling and Schapire 2008 for a set of experts; its parts by the performance
    difference lemma of Kakade and Langford 2002.
    """
    mdp = concrete_problem("loss_bound", mdp, demonstrations, getattr(policy, "policy", policy), weights, horizon)
    with checks.at_once(), one_blas_thread():
        policy = np.asarray(check_policy(mdp, policy))
        checks.require_shape("policy", policy, "(B, S, A) with B >= 1", len(policy) > 0)
        weights = None if weights is None else _checked_weights(mdp, weights)
        if horizon is not None:  # after so many steps sums do not change any more
            horizon = min(checks.require_count("horizon", horizon), first_steps.discounted_away(float(mdp.discount)))
        agreeing = Agreeing(mdp, demonstrations, horizon, progress)
        lanes = [agreeing.loss(one, weights) for one in policy.reshape(-1, *policy.shape[-2:])]
        return (
            lanes[0] if policy.ndim == 2 else jax.tree.map(lambda *leaves: checks.to_device(np.stack(leaves)), *lanes)
        )


def concrete_problem(name: str, mdp: Any, *given: Any) -> MDP:
    """The model, or `ValueError` if it has none or too large features, or if it or what else is given is traced."""
    mdp = as_model(mdp)
    if checks.is_traced(mdp, *given):
        raise ValueError(f"{name} plans on the host: call it outside jit, vmap and grad")
    require_features(mdp)
    check_features(mdp)
    return mdp


class Agreeing:
    """The policies that agree with the expert, and the best of them for every feature; to compare policies with.

    Attributes:
      agreed: bool [S], S^E.
      optima: [K], U, rounded up to the model's type.
      status: int, of the planning for U.
    """

    def __init__(
        self, mdp: MDP, demonstrations: Demonstrations, horizon: int | None = None, progress: bool = False
    ) -> None:
        self._mdp, self._horizon = mdp, horizon
        visited, self._expert = (np.asarray(array) for array in empirical_policy(mdp, demonstrations))
        self.agreed = np.asarray(deciding_states(mdp, visited))
        self._choices = Choices(mdp, self.agreed, self._expert)
        self._best = self._plan(self._choices, progress)
        self.optima = rounded_up(self._best.upper, mdp.dtype)
        self.status = self._best.status

    def loss(self, policy: Float[np.ndarray, "S A"], weights: Float[np.ndarray, " K"] | None) -> LossBound:
        """The bound for one policy."""
        choices = Choices(self._mdp, np.ones(len(policy), bool), policy)
        own = all_time.of_policy(choices) if self._horizon is None else first_steps.best(choices, self._horizon)
        dtype = self._mdp.dtype
        expectations = rounded_down(own.lower, dtype)
        # From the rounded numbers, so that whoever subtracts them finds the same.
        gaps = rounded_up(self.optima.astype(np.float64) - expectations, dtype)
        weighted = (gaps if weights is None else weights * gaps).astype(np.float64)
        worst = int(weighted.argmax())
        bound, share = weighted[worst], np.eye(len(gaps))[worst]
        if weights is not None:
            bound, share = _sum_up(weighted), weights
        parts = self._contributions(choices, own, share)
        parts[self._is_as_the_expert(policy)] = 0.0
        fields = {
            "bound": rounded_up(bound, dtype),
            "optima": self.optima,
            "expectations": expectations,
            "gaps": gaps,
            "contributions": parts.astype(dtype),
            "weights": None if weights is None else weights.astype(dtype),
        }
        return LossBound(
            **{name: None if field is None else checks.to_device(field) for name, field in fields.items()},
            worst=checks.to_device(worst, np.int32),
            agreed=checks.to_device(self.agreed),
            status=checks.to_device(self.status if self.status != Status.SOLVED else own.status, np.int32),
            state_names=self._mdp.state_names,
        )

    def _plan(self, choices: Choices, progress: bool) -> BestChoices:
        if self._horizon is None:
            return all_time.best(choices, progress)
        return first_steps.best(choices, self._horizon)

    def _contributions(
        self, policy: Choices, own: BestChoices, share: Float[np.ndarray, " K"]
    ) -> Float[np.ndarray, " S"]:
        if self._horizon is None:
            return all_time.contributions(self._choices, self._best, own, share)
        return first_steps.contributions(self._choices, policy, share, self._horizon)

    def _is_as_the_expert(self, policy: Float[np.ndarray, "S A"]) -> Bool[np.ndarray, " S"]:
        """Where nothing can be lost but by rounding."""
        off = np.abs(policy.astype(np.float64) - self._expert).max(axis=1)
        return self.agreed & (off <= _AGREEMENT * float(np.finfo(self._mdp.dtype).eps))


def _checked_weights(mdp: MDP, weights: Any) -> Float[np.ndarray, " K"]:
    host = checks.as_host_array("weights", weights)
    checks.require_shape("weights", host, f"({mdp.num_features},)", host.shape == (mdp.num_features,))
    host = checks.require_floats_in(mdp.dtype, "weights", host)
    checks.require_all("weights", host, host >= 0, "must not be negative")
    return host.astype(np.float64)


def _sum_up(terms: Float[np.ndarray, " K"]) -> float:
    """A sum, rounded up."""
    return terms.sum() + (len(terms) + 4) * np.finfo(np.float64).eps * np.abs(terms).sum()


def _in_words(loss: LossBound) -> str:
    """The bound, the worst feature, the states that contribute most, and what is assumed."""
    worst, parts = int(loss.worst), np.asarray(loss.contributions)
    given = "for weights of sum 1" if loss.weights is None else "for the given weights"
    best, own = float(loss.optima[worst]), float(loss.expectations[worst])
    least = _LEAST_SHOWN * max(float(loss.bound), 0.0)
    most = [int(s) for s in np.argsort(-parts, kind="stable")[:_SHOWN] if parts[s] > least]
    names = ", ".join(f"{described(s, loss.state_names)} ({parts[s]:.4g})" for s in most) or "none"
    return "\n".join(
        [
            f"at most {float(loss.bound):.6g} is lost against the expert, {given}",
            f"worst feature {worst}: the expert has at most {best:.6g}, the policy {own:.6g}",
            f"states that contribute most: {names}",
            "assumes the true model, and an expert that is deterministic (or whose frequencies are exact) on the "
            f"{int(np.asarray(loss.agreed).sum())} demonstrated states",
            f"status: {Status(int(loss.status)).name}",
        ]
    )
