"""Methods that compare learners of weights with generalizations of the policy, and with what needs no demonstration.

A learner is fed with demonstrations, with their own feature expectations (Monte Carlo), or with those of the policy of
Algorithm 1. The controls are fed with nothing: a uniform policy, the best one for equal weights, LPAL fed with zeros.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np

import jaxhom
from bench.methods import (
    Learned,
    Method,
    apprentice,
    expert,
    manhattan_knn,
    monte_carlo,
    nothing_fed,
    soft,
    uniform,
)
from bench.problems import Problem
from jaxhom import MDP, Demonstrations

_ROUNDS = 100  # of projection and MWAL


def equal_weights(problem: Problem) -> Learned:
    """The best policy for a reward that is the sum of all features, each in units of its range."""
    mdp = problem.domain.mdp
    features = np.asarray(mdp.features)
    reach = features.max(axis=(0, 1)) - features.min(axis=(0, 1))
    plan = jaxhom.optimal_policy(mdp, (features / np.where(reach > 0, reach, 1.0)).sum(axis=-1))
    return Learned(jnp.broadcast_to(plan.policy, (len(problem.draws), *plan.policy.shape)))


def learned(learn: Callable[[MDP, Demonstrations], jaxhom.Learned], *, is_greedy: bool = True) -> Method:
    """A method that learns from demonstrations draw by draw: the greedy policy of the weights, or the theory's."""

    def method(problem: Problem) -> Learned:
        return _of(problem.once(_each(learn)), is_greedy)

    return method


@functools.cache
def _each(learn: Callable) -> Callable[[Problem], list[jaxhom.Learned]]:
    """What is learned from the demonstrations of each draw."""
    return lambda problem: [learn(problem.domain.mdp, shown) for shown in problem.demonstrations]


def learned_from(source: Method | None, learn: Callable, *, is_greedy: bool = False) -> Method:
    """Likewise from expectations: those of the policies of a method, or of the demonstrations themselves if None."""

    def method(problem: Problem) -> Learned:
        mdp = problem.domain.mdp
        if source is None:
            given = [jaxhom.monte_carlo_feature_expectations(mdp, shown) for shown in problem.demonstrations]
        else:
            given = list(jaxhom.feature_expectations(mdp, problem.once(source).policy))
        return _of([learn(mdp, one) for one in given], is_greedy)

    return method


def inverse_lp_of_policies(source: Method) -> Method:
    """Ng and Russell's program for complete policies, those of a method."""

    def method(problem: Problem) -> Learned:
        mdp = problem.domain.mdp
        return _of([jaxhom.inverse_lp(mdp, policy, nonnegative=True) for policy in problem.once(source).policy], True)

    return method


def _of(found: list[jaxhom.Learned], is_greedy: bool) -> Learned:
    policies = [one.greedy_policy if is_greedy else one.policy for one in found]
    return Learned(jnp.stack(policies), np.array([int(one.status) for one in found]))


def _by_expectations(mdp: MDP, expectations) -> jaxhom.Learned:
    return jaxhom.max_causal_entropy(mdp, expectations=expectations)


_projection = functools.partial(jaxhom.projection, max_iterations=_ROUNDS)
_mwal = functools.partial(jaxhom.mwal, max_iterations=_ROUNDS)
_inverse_lp = functools.partial(jaxhom.inverse_lp, nonnegative=True)

FED_WITH_NOTHING: dict[str, Method] = {
    "uniform": uniform,
    "best for equal weights": equal_weights,
    "LPAL, zeros": nothing_fed,
}
LEARNERS: dict[str, Method] = {
    "expert": expert,
    **FED_WITH_NOTHING,
    "k-NN": manhattan_knn,
    "Algorithm 1": soft,
    "max. causal entropy": learned(jaxhom.max_causal_entropy),
    "max. causal entropy, soft": learned(jaxhom.max_causal_entropy, is_greedy=False),
    "max. causal entropy, Algorithm 1": learned_from(soft, _by_expectations, is_greedy=True),
    "max. causal entropy, Monte Carlo": learned_from(None, _by_expectations, is_greedy=True),
    "LPAL, Algorithm 1": apprentice(soft),
    "LPAL, Monte Carlo": monte_carlo,
    "projection, Algorithm 1": learned_from(soft, _projection),
    "projection, Monte Carlo": learned_from(None, _projection),
    "MWAL, Algorithm 1": learned_from(soft, _mwal),
    "MWAL, Monte Carlo": learned_from(None, _mwal),
    "inverse LP": learned(_inverse_lp),
    "inverse LP, Algorithm 1": inverse_lp_of_policies(soft),
}
"""Fed with demonstrations, or with the expectations of what stands behind the comma."""
