"""MWAL: the game for LPAL's margin by multiplicative weights (Syed and Schapire 2007).

    v* = max_pi min_{w in simplex} w . (V(pi) - Vhat)

Nature keeps weights w of the features, and makes those larger whose V_i - Vhat_i was small; the learner answers each
w_t with its best policy pi_t. The learner's average, the mixture of all pi_t, then does well against any weights: with
r the regret of nature's weights,

    v*  <=  max_pi wbar . (V(pi) - Vhat)  <=  1/T sum_t w_t . (V(pi_t) - Vhat)  <=  min_i (Vbar_i - Vhat_i) + r / T,

wbar and Vbar the averages. The weights are those of AdaHedge (`jaxhom.solvers.hedge`) in place of the paper's step for
T rounds and features in [-1, 1]: it needs neither T nor the features' size, so that rounds end as soon as both sides
have met, and its regret has the same order. Features that no policy could make the smallest take no part (`presolve`),
and losses are in the units of V: shifts and scales of losses leave AdaHedge's weights alone.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from jaxhom import checks
from jaxhom.apprenticeship.best_responses import Outcome, Proposal, Responder, goal_of, learn_lane_by_lane, mixture
from jaxhom.apprenticeship.certificate import ExactSides, simplex_point
from jaxhom.apprenticeship.learned import Learned
from jaxhom.apprenticeship.presolve import Reach, reduce_expectations
from jaxhom.models.mdp import MDP
from jaxhom.solvers.hedge import AdaHedge
from jaxhom.status import Status

if TYPE_CHECKING:
    from jaxtyping import ArrayLike, Float

_GAP = 1e-3  # of the least that a feature can do which may be the smallest
_BETWEEN_AVERAGES = 1.25  # ratio of the rounds after which the average weights are planned for


@checks.eager_where_concrete
def mwal(
    mdp: MDP,
    expectations: Float[ArrayLike, "*B K"],
    *,
    tolerance: float | Float[ArrayLike, " B"] | None = None,
    max_iterations: int = 1000,
) -> Learned:
    """Finds a policy whose feature expectations exceed the given ones by nearly the largest margin.

    It approaches max_pi min_i V_i(pi) - expectations_i, the problem of `lpal`, by multiplicative weights. `lpal` gets
    closer sooner; this is the algorithm that it came from.

    After T rounds the gap bound - objective is at most

        S (sqrt(ln K / T) + (4/3 ln K + 2) / T),

    S the most by which V_i(pi_t) - expectations_i differ between features in one round: for features within [0, 1] and
    expectations within reach at most 2 / (1 - discount).

    Args:
      mdp: the model, with K >= 1 features.
      expectations: [K] or a batch [B, K], discounted feature expectations of the expert, in the units of
        `feature_expectations` (sums over time). No policy need reach them.
      tolerance: bound - objective to settle for; [B] for each lane its own. By default 1e-3 / (1 - discount) times the
        least that any feature can do in a step which may be the smallest, as in `lpal`, which is a hundred times as
        strict.
      max_iterations: rounds T, per lane, after which to stop. Fewer are played where the gap is closed before.

    Returns:
      `Learned`, with a leading axis [B] if the expectations have one:

      - `policy` [S, A]: one stationary policy with the average occupancy of all rounds' policies.
      - `objective`: its true margin min_i V_i(policy) - expectations_i, computed from it; rounded down.
      - `bound`: no policy's margin is larger: the least that planning has proved for the weights of a round, or for
        average weights; rounded up. Both are computed in float64, whatever the model's type, and hold whatever the
        status.
      - `weights` [K]: those that prove the bound, non-negative, sum 1.
      - `greedy_policy` [S, A]: best for these weights.
      - `iterations`: rounds.

    On the host: inside jit, vmap and grad of concrete values alone.

    Raises:
      ValueError: on wrong shapes, expectations that are not finite, a model without features, features or expectations
        so large that their sums over time overflow, a tolerance that is not positive, a count below 1, or if anything
        is traced.

    Source: Syed and Schapire 2007, Algorithm 1 (MWAL) and Theorem 2; de Rooij, van Erven, Grünwald and Koolen 2014,
    Theorem 6, for the weights and the bound above.

    Example:
      >>> import jaxhom
      >>> mdp = jaxhom.gridworld(4, num_regions=4).mdp
      >>> learned = jaxhom.mwal(mdp, [20.0, 20.0, 20.0, 20.0], tolerance=0.5)
      >>> print(bool(learned.bound - learned.objective <= 0.5), jaxhom.Status(int(learned.status)).name)
      True SOLVED
      >>> print(bool(learned.objective <= jaxhom.lpal(mdp, [20.0] * 4).margin_bound))
      True
    """
    limit = checks.require_count("max_iterations", max_iterations)

    def solve(sides, reach, expectations, tolerance):
        proposal = _rounds(sides, reach, expectations, goal_of(sides.mdp, tolerance), limit)
        return _certified(sides, expectations, tolerance, proposal)

    return learn_lane_by_lane("mwal", mdp, expectations, tolerance, _default_tolerance, solve)


def _default_tolerance(reach: Reach, expectations: Float[np.ndarray, "B K"]) -> Float[np.ndarray, " B"]:
    return _GAP / (1.0 - reach.discount) * reduce_expectations(reach, expectations).least


@dataclasses.dataclass
class _Best:
    """The least bound so far, and the weights [K] that prove it."""

    weights: Float[np.ndarray, " K"]
    bound: float = np.inf

    def offer(self, weights: Float[np.ndarray, " K"], bound: float) -> None:
        """Takes weights if they prove more."""
        if bound < self.bound:
            self.weights, self.bound = weights, bound


def _rounds(
    sides: ExactSides, reach: Reach, expectations: Float[np.ndarray, " K"], goal: float, limit: int
) -> Proposal:
    """Rounds of weights and best responses, until the average policy's margin is within the goal of the bound."""
    plays = ~reduce_expectations(reach, expectations[None]).is_idle[0]
    wanted = expectations[plays]
    responder, hedge = Responder(sides, goal), AdaHedge(len(wanted))
    best, counts = _Best(hedge.weights()), np.zeros(0)
    total, next_average, count = np.zeros_like(wanted), 2.0, 0
    status = Status.ITERATION_LIMIT

    def respond(weights):
        everywhere = np.zeros(len(plays))
        everywhere[plays] = weights
        most, number = responder.respond(everywhere)
        best.offer(weights, most - weights @ wanted)
        return number

    while count < limit and status != Status.SOLVED:
        weights = hedge.weights()
        number = respond(weights)
        gains = responder.pool.expected[:, plays]
        counts = np.append(counts, np.zeros(len(gains) - len(counts)))
        counts[number] += 1
        hedge.update(gains[number] - wanted)
        total, count = total + weights, count + 1
        if count >= next_average or count == limit:
            next_average = _BETWEEN_AVERAGES * count
            respond(total / count)
        margin = (counts @ gains / count - wanted).min()
        status = Status.SOLVED if best.bound - margin <= goal else status
    weights = np.zeros(len(plays))
    weights[plays] = simplex_point(best.weights)
    return Proposal(mixture(responder.pool, counts / count), weights, responder.guess(weights), count, status)


def _certified(
    sides: ExactSides, expectations: Float[np.ndarray, " K"], tolerance: float, proposal: Proposal
) -> Learned:
    outcome, eps = Outcome(sides, proposal, expectations, tolerance), np.finfo(float).eps
    margin = (outcome.low - expectations - 2.0 * eps * (np.abs(outcome.low) + np.abs(expectations))).min()
    bound = outcome.advantage / outcome.weights.astype(np.float64).sum()  # 1 in float64, and nearly so in float32
    bound += 8.0 * eps * abs(bound)
    # Bounds that rounding has made to cross are both uncertain.
    return outcome.learned(min(margin, bound), max(margin, bound), is_above=False)
