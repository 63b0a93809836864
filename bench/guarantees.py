"""Methods that compare bounds on losses with true losses, and the policy that loses least in the worst case.

The certificate of a row is a bound per step: on the loss under the true reward ("true weights"), or under any reward
whose weights have the same sum ("worst weights"). The true loss is in the same row, in the same units.
"""

from __future__ import annotations

import functools

import jax.numpy as jnp
import numpy as np

import jaxhom
from bench.learners import learned
from bench.methods import Learned, Method, expert, manhattan_knn, soft, uniform
from bench.problems import Problem

_POLICIES: dict[str, Method] = {
    "expert": expert,
    "uniform": uniform,
    "k-NN": manhattan_knn,
    "Algorithm 1": soft,
    "max. causal entropy": learned(jaxhom.max_causal_entropy),
}
TRUE, WORST, LEAST = "true weights", "worst weights", "least of all policies"


def robust(problem: Problem) -> list[jaxhom.RobustPolicy]:
    """The policy of least worst loss, draw by draw."""
    return [jaxhom.robust_policy(problem.domain.mdp, shown) for shown in problem.demonstrations]


def _robust_policies(problem: Problem) -> Learned:
    found = problem.once(robust)
    return Learned(jnp.stack([one.policy for one in found]), np.array([int(one.status) for one in found]))


_POLICIES["robust policy"] = _robust_policies


def bounds(problem: Problem) -> list[jaxhom.LossBound]:
    """Draw by draw the bounds on the losses of all policies, one lane each, in the order of `_POLICIES`."""
    policies = jnp.stack([problem.once(method).policy for method in _POLICIES.values()], axis=1)
    pairs = zip(problem.demonstrations, policies, strict=True)
    return [jaxhom.loss_bound(problem.domain.mdp, shown, of_draw) for shown, of_draw in pairs]


def bounded(problem: Problem, *, name: str, kind: str) -> Learned:
    """A method's policies with the bounds on their losses, per step."""
    mdp, lane = problem.domain.mdp, list(_POLICIES).index(name)
    found = problem.once(bounds)
    weights = np.asarray(problem.weights)
    if kind == WORST:
        loss = weights.sum(axis=1) * np.array([one.bound[lane] for one in found])
    else:
        loss = np.array([w @ np.asarray(one.gaps[lane]) for w, one in zip(weights, found, strict=True)])
    status = np.array([int(one.status[lane]) for one in found])
    return Learned(problem.once(_POLICIES[name]).policy, status, loss * (1.0 - float(mdp.discount)))


def least(problem: Problem) -> Learned:
    """The robust policy, and what no policy's worst loss is below."""
    one_step = 1.0 - float(problem.domain.mdp.discount)
    floor = np.asarray(problem.weights).sum(axis=1) * np.array([float(one.least_loss) for one in problem.once(robust)])
    policies = problem.once(_robust_policies)
    return Learned(policies.policy, policies.status, floor * one_step)


GUARANTEES: dict[str, Method] = {
    f"{name}, {kind}": functools.partial(bounded, name=name, kind=kind) for kind in (TRUE, WORST) for name in _POLICIES
} | {f"robust policy, {LEAST}": least}
