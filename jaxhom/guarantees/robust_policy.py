"""The policy that loses least in the worst case, over everything that the expert may do and want.

With U_k, the most that a policy which agrees with the expert on the demonstrated states is worth for feature k (see
`loss_bound`), the worst loss of a policy is max_k U_k - V_k(policy), over all rewards whose weights are >= 0 and sum to
1. To make it small is LPAL with U in the place of the expert's feature expectations (Syed, Bowling and Schapire 2008):

    min_pi max_k U_k - V_k(pi)  =  - max_pi min_k V_k(pi) - U_k.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jaxhom import checks
from jaxhom.apprenticeship.lpal import lpal
from jaxhom.apprenticeship.presolve import Reach, default_tolerance, reduce_expectations
from jaxhom.guarantees.loss_bound import Agreeing, LossBound, concrete_problem
from jaxhom.models.demonstrations import Demonstrations
from jaxhom.models.mdp import MDP
from jaxhom.solvers.blas_threads import one_blas_thread
from jaxhom.status import Record, Status

if TYPE_CHECKING:
    from jaxtyping import Array, Float, Int

_LEEWAY = 1.1  # of the tolerance: what is computed twice differs in its last digits


class RobustPolicy(Record):
    """The policy of least worst loss, and what proves it.

    Attributes:
      policy: [S, A], rows sum to 1.
      loss: the `LossBound` of the policy, without weights: `loss.bound` is its worst loss at most.
      least_loss: scalar, no policy has a `loss_bound(...).bound` below it: `loss.bound - least_loss` is the
        certificate.
      weights: [K], non-negative, sum 1: the reward that proves `least_loss`, the worst one against all policies.
      iterations: int32 scalar, those of LPAL.
      status: int32 scalar, a `jaxhom.Status`: that of LPAL, or of the planning for U where that was not solved; STALLED
        where rounding leaves the certificate wider than what was asked for.
    """

    policy: Float[Array, "S A"]
    loss: LossBound
    least_loss: Float[Array, ""]
    weights: Float[Array, " K"]
    iterations: Int[Array, ""]
    status: Int[Array, ""]


def robust_policy(
    mdp: MDP,
    demonstrations: Demonstrations,
    *,
    tolerance: float | None = None,
    method: str = "auto",
    max_iterations: int | None = None,
) -> RobustPolicy:
    """Finds the policy whose worst loss against the expert is the least, over all rewards and all that it may do.

    It solves min_pi max_k U_k - V_k(pi) over all stationary policies. Rewards have weights >= 0 that sum to 1; the
    expert is known where it was seen, and may do anything elsewhere. No generalization is involved.

    The policy need not do what the expert does, not even where it was seen: where the reward is not known, hedging
    between features can be worth more. The bound holds all the same. And it guards against the worst: a generalized
    policy can well be better against the expert that there is.

    Args:
      mdp: the model, with K >= 1 features.
      demonstrations: the expert's trajectories, as for `loss_bound`.
      tolerance: largest `loss.bound - least_loss` to settle for; by default that of `lpal`.
      method: of `lpal`.
      max_iterations: of `lpal`; `status` is then ITERATION_LIMIT.

    Returns:
      `RobustPolicy`. Both bounds hold whatever the status.

    Raises:
      ValueError: if the model has no features, a demonstration does not fit it, an option is none of `lpal`, or
        anything is traced.

    Warns:
      ImpossibleStepsWarning: if steps have probability 0; see `Demonstrations.validate`.

    It is computed on the host: inside jit, vmap and grad of concrete values alone.

    Example:
      >>> import jaxhom
      >>> grid = jaxhom.gridworld(4, num_regions=4, discount=0.9)
      >>> demonstrations = jaxhom.Demonstrations.from_trajectories([([0, 1, 2, 3, 7], [2, 2, 2, 1, 1])])
      >>> robust = robust_policy(grid, demonstrations)
      >>> other = jaxhom.loss_bound(grid, demonstrations, jaxhom.nearest_neighbors(grid, demonstrations))
      >>> bool(robust.least_loss <= robust.loss.bound <= other.bound)
      True

    Source: Syed, Bowling and Schapire 2008, with the largest expectations that an expert can have for those of one.
    """
    mdp = concrete_problem("robust_policy", mdp, demonstrations)
    with checks.at_once(), one_blas_thread():
        agreeing = Agreeing(mdp, demonstrations)
        if tolerance is None:
            tolerance = _default_tolerance(mdp, np.asarray(agreeing.optima))
        solution = lpal(mdp, agreeing.optima, tolerance=tolerance, method=method, max_iterations=max_iterations)
        least = -np.asarray(solution.margin_bound)
        loss = agreeing.loss(np.asarray(solution.policy), None)
        status = agreeing.status if agreeing.status != Status.SOLVED else int(solution.status)
        # LPAL has its own rounding to answer for; to that the rounding of U and of the loss are added.
        if status == Status.SOLVED and float(loss.bound) - float(least) > _LEEWAY * tolerance:
            status = Status.STALLED
        return RobustPolicy(
            policy=solution.policy,
            loss=loss,
            least_loss=checks.to_device(least),
            weights=solution.weights,
            iterations=solution.iterations,
            status=checks.to_device(status, np.int32),
        )


def _default_tolerance(mdp: MDP, optima: Float[np.ndarray, " K"]) -> float:
    """That of `lpal`."""
    reach = Reach.of(mdp)
    return float(default_tolerance(reach, reduce_expectations(reach, optima[None].astype(np.float64)))[0])
