"""Inverse reinforcement learning by linear programs (Ng and Russell 2000).

From a policy pi (their sections 3.2 and 4): among the rewards r = phi . w for which pi is optimal, the one that makes
other actions worst, step by step,

    max_w  sum_s min_{a not in pi(s)} (V(s) - Q(s, a))  -  lambda |w|_1,     V - Q >= 0,   |w_k| <= M,

V and Q the values of pi, which are linear in w: V = (I - gamma P_pi)^-1 Phi_pi w. Where the reward does not depend on
the action, V(s) - Q(s, a) is gamma (P_pi - P_a) (I - gamma P_pi)^-1 R at s: gamma times what the paper has.

From demonstrations (their section 5): the weights for which the expert's expectations Vhat are worth more than those of
the policies met so far,

    max_w  sum_i p(w . (Vhat - V(pi_i)))  -  lambda |w|_1,     p(x) = min(x, 2 x),   |w_k| <= M;

the best policy for them is the next one. Both are sums of minima of linear functions (`jaxhom.solvers.sum_of_minima`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import numpy as np

from jaxhom import checks
from jaxhom.apprenticeship.arguments import check_features
from jaxhom.apprenticeship.best_responses import Responder, require_features
from jaxhom.apprenticeship.certificate import ExactSides
from jaxhom.apprenticeship.exact import compact_features
from jaxhom.apprenticeship.learned import Learned
from jaxhom.models.demonstrations import Demonstrations, monte_carlo_feature_expectations
from jaxhom.models.inputs import as_model, check_policy
from jaxhom.models.mdp import MDP, uniform_policy
from jaxhom.planning.host_chains import host_model
from jaxhom.planning.occupancy import feature_expectations, occupancy
from jaxhom.planning.optimal import optimal_policy
from jaxhom.solvers.blas_threads import one_blas_thread
from jaxhom.solvers.outward import rounded_down, rounded_up
from jaxhom.solvers.sum_of_minima import SumOfMinima
from jaxhom.status import Status

if TYPE_CHECKING:
    from jaxtyping import ArrayLike, Float, Int

# In float64, and in shorter types: by what share of the largest that a term can be the program may be missed, and
# what share rounding makes of ties, which the policies of planners have.
_ACCURACY, _SLACK = (1e-6, 1e-4), (1e-8, 1e-5)
_MOST_NUMBERS = 2**27  # of the program's rows, which are dense: 1 GB


@checks.eager_where_concrete
def inverse_lp(
    mdp: MDP,
    expert: Float[ArrayLike, "S A"] | Int[ArrayLike, " S"] | Demonstrations,
    *,
    l1: float = 0.0,
    max_weight: float = 1.0,
    nonnegative: bool = False,
    max_iterations: int = 50,
) -> Learned:
    """Finds a reward that explains an expert, by the linear programs of Ng and Russell.

    Given a policy, known in every state, the reward for which it is optimal and for which other actions would cost
    most: max_w sum_s min_a (V(s) - Q(s, a)) - l1 |w|_1 over |w_k| <= max_weight, subject to V(s) >= Q(s, a) for all
    allowed actions, with V and Q the values of the policy and the minimum over the allowed actions that it does not
    take. If it is random, all actions that it takes with positive probability must be optimal alike, V(s) = Q(s, a).
    States in which no other action is allowed have no term. Constraints may be missed by 1e-8 (1e-5 for models in
    float32) of the largest number that a weight can make of a term: rounding leaves no reward else where actions tie.

    Given demonstrations, the weights for which their mean discounted features (`monte_carlo_feature_expectations`,
    Vhat) are worth more than those of the policies met so far: max_w sum_i p(w . (Vhat - V(pi_i))) - l1 |w|_1 in the
    same box, with p(x) = x, and 2 x where x < 0. The first policy is the uniform one; the best policy for the weights
    joins, until it is one that was met, or worth no more than Vhat.

    Args:
      mdp: the model. With K features the reward is features @ weights. Without, it is one number for every state, and
        demonstrations do not do.
      expert: a policy, [S, A] with rows that sum to 1, integers [S], or what has one as `.policy`; or `Demonstrations`.
      l1: penalty on |weights|_1, not negative, in the units of discounted sums of features: larger ones give simpler
        rewards, and from some size on none. For rewards of states it is gamma times the paper's lambda.
      max_weight: the largest |weight|; without features the paper's R_max.
      nonnegative: whether weights may not be negative.
      max_iterations: policies to meet, beside the first, given demonstrations.

    Returns:
      `Learned`:

      - `weights`: [K]; [S], the reward of every state, where the model has no features. Zero if no other reward makes
        the policy optimal, or `l1` is large: every policy is optimal for it. Many rewards may be as good.
      - `policy` [S, A]: the expert's, if it was given; else the best one for the weights.
      - `greedy_policy` [S, A]: best for the weights, found by planning. Ties go to the lowest action; optimal weights
        often leave some, where it need not do what the expert does.
      - `expectations`: [K] of `policy`; [S], its occupancy of the states, where the model has no features.
      - `objective`: what the program makes largest, recomputed from the weights; given demonstrations, with the last
        set of policies. `bound`: no weights in the box that keep to the constraints reach more, by the multipliers.
        In float64, up to rounding.
      - `iterations`: programs solved. `status`: SOLVED if both are equal and the constraints hold, to 1e-6 of what a
        term can be (1e-4 for models in float32); given demonstrations, also only if the rounds have come to their end.

    On the host: inside jit, vmap and grad of concrete values alone. For models of up to a few thousand states: the
    program has S A K numbers.

    Raises:
      ValueError: if the expert is no policy of the model and no demonstrations of it, an option is no number or out of
        its range, demonstrations come without features, the program is too large, or anything is traced.

    Source: Ng and Russell 2000, sections 3.2, 4 and 5.

    Example:
      >>> import jaxhom
      >>> mdp = jaxhom.gridworld(4, num_regions=4).mdp
      >>> expert = jaxhom.optimal_policy(mdp, mdp.features[..., 3])
      >>> learned = jaxhom.inverse_lp(mdp, expert)
      >>> print(bool((learned.greedy_policy == expert.policy).all()), int(learned.weights.argmax()))
      True 3
    """
    mdp = as_model(mdp)
    if checks.is_traced(mdp, expert, l1, max_weight):
        raise ValueError("the linear programs of inverse_lp are solved on the host: call it outside jit, vmap and grad")
    options = _checked_options(l1, max_weight, nonnegative)
    limit = checks.require_count("max_iterations", max_iterations)
    if mdp.num_features:
        check_features(mdp)
    with one_blas_thread():
        if isinstance(expert, Demonstrations):
            return _from_demonstrations(mdp, expert, options, limit)
        return _from_policy(mdp, np.asarray(check_policy(mdp, expert, "expert", batch=False)), options)


def _checked_options(l1, max_weight, nonnegative) -> dict:
    penalty, largest = checks.require_number("l1", l1), checks.require_number("max_weight", max_weight)
    for name, number, good in (("l1", penalty, penalty >= 0), ("max_weight", largest, largest > 0)):
        if not (good and np.isfinite(number)):
            range_ = "finite and not negative" if name == "l1" else "finite and positive"
            raise ValueError(f"{name} must be {range_}, got {number}")
    return {"penalty": penalty, "largest": largest, "nonnegative": checks.require_switch("nonnegative", nonnegative)}


def _from_policy(mdp: MDP, policy: Float[np.ndarray, "S A"], options: dict) -> Learned:
    allowed, takes = np.asarray(mdp.allowed), policy > 0
    losses = _losses(mdp, policy.astype(np.float64))
    is_tied = takes & (takes.sum(axis=1, keepdims=True) > 1)
    others = allowed & ~takes
    groups = np.unique(np.nonzero(others)[0], return_inverse=True)[1]
    slack = _of_type(mdp, _SLACK)
    program = SumOfMinima(losses[others], groups, losses[is_tied], is_floored=True, slack=slack, **options)
    weights, bound = program.solve()
    return _learned(mdp, program, weights, bound, policy, 1, Status.SOLVED)


def _losses(mdp: MDP, policy: Float[np.ndarray, "S A"]) -> Float[np.ndarray, "S A K"]:
    """V(s) - Q(s, a) of a policy for every feature, or for the indicators of all states if there are none."""
    states, actions = policy.shape
    num_weights = mdp.num_features or states
    if policy.size * num_weights > _MOST_NUMBERS or not host_model(mdp).is_solvable:
        raise ValueError(
            f"the linear program has {states} x {actions} x {num_weights} numbers (states, actions, weights): "
            "too many; give the model fewer features"
        )
    if mdp.num_features:
        features = compact_features(np.asarray(mdp.features), np.asarray(mdp.allowed)).astype(np.float64)
    else:
        features = np.eye(states)[:, None]
    model = host_model(mdp)
    chain = model.chain(policy)
    own = (np.broadcast_to(features, (states, actions, num_weights)) * policy[..., None]).sum(axis=1)
    value = np.stack([chain.value(column) for column in own.T], axis=-1)
    action_value = features + model.discount * (model.rows @ value).reshape(states, actions, num_weights)
    return value[:, None] - action_value


def _from_demonstrations(mdp: MDP, demonstrations: Demonstrations, options: dict, limit: int) -> Learned:
    require_features(mdp)
    expert = np.asarray(monte_carlo_feature_expectations(mdp, demonstrations), np.float64)
    sides = ExactSides(mdp)
    # Values are in units of the largest weight and feature.
    error = _of_type(mdp, _ACCURACY) * options["largest"] * (np.abs(np.asarray(mdp.features)).max() or 1.0)
    responder = Responder(sides, float(error))
    responder.add(np.asarray(uniform_policy(mdp), np.float64))
    iterations, status = 0, Status.ITERATION_LIMIT
    while status == Status.ITERATION_LIMIT and iterations < limit:
        ahead = expert - responder.pool.expected
        groups = np.tile(np.arange(len(ahead)), 2)
        program = SumOfMinima(
            np.concatenate([ahead, 2.0 * ahead]), groups, np.zeros((0, len(expert))), is_floored=False, **options
        )
        weights, bound = program.solve()
        most, _ = responder.respond(weights)
        iterations += 1
        if len(responder.pool.expected) == len(ahead) or most - weights @ expert <= error:
            status = Status.SOLVED
    return _learned(mdp, program, weights, bound, None, iterations, status)


def _learned(
    mdp: MDP,
    program: SumOfMinima,
    weights: Float[np.ndarray, " K"],
    bound: float,
    policy: Float[np.ndarray, "S A"] | None,
    iterations: int,
    status: Status,
) -> Learned:
    """The record: evaluated with the weights as they are in the model's type. `policy`: the best one if None."""
    dtype = np.dtype(mdp.dtype)
    given = weights.astype(dtype)
    weights = given.astype(np.float64)
    value = program.value(weights)
    term = _of_type(mdp, _ACCURACY) * program.largest * program.unit
    terms = max(1, len(np.unique(program.groups)))
    is_exact = program.violation(weights) <= term and bound - value <= terms * term
    if status == Status.SOLVED and not is_exact:
        status = Status.STALLED
    if mdp.num_features:
        reward = np.asarray(mdp.features).astype(np.float64) @ weights
    else:
        reward = np.broadcast_to(weights[:, None], mdp.allowed.shape)
    greedy = optimal_policy(mdp, reward.astype(dtype)).policy
    policy = greedy if policy is None else policy
    if mdp.num_features:
        expectations = feature_expectations(mdp, policy)
    else:
        expectations = np.asarray(occupancy(mdp, policy)).sum(axis=-1)
    learned = Learned(
        policy=policy,
        greedy_policy=greedy,
        weights=given,
        expectations=expectations,
        objective=rounded_down(value, dtype),
        bound=rounded_up(max(bound, value), dtype),
        iterations=np.int32(iterations),
        status=np.int32(status),
    )
    return jax.tree.map(checks.to_device, learned)


def _of_type(mdp: MDP, shares: tuple[float, float]) -> float:
    return shares[0] if mdp.dtype == np.float64 else shares[1]
