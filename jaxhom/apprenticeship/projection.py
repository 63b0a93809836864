"""Apprenticeship learning by projection, and by the largest margin (Abbeel and Ng 2004).

The feature expectations V(pi) of all policies, mixtures included, fill a polytope. Both algorithms look for its point
that is nearest to the expert's expectations Vhat,

    d* = min_pi |Vhat - V(pi)|_2 = max_{|w|_2 <= 1} min_pi w . (Vhat - V(pi)),

by turns: w points from the mixture so far to Vhat, and the best policy for the reward w . phi joins. "projection"
(their section 3.1) moves the mixture towards the new policy alone, as far as gets it nearest to Vhat. "max_margin" (the
quadratic program of their section 3) takes the nearest mixture of all policies met: the w of largest margin between
Vhat and them is its direction, by duality.

The right side is the certificate: any w gives min_pi w . (Vhat - V(pi)) / |w|_2 <= d* by planning once.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from jaxhom import checks
from jaxhom.apprenticeship.best_responses import Outcome, Proposal, Responder, goal_of, learn_lane_by_lane, mixture
from jaxhom.apprenticeship.certificate import ExactSides
from jaxhom.apprenticeship.learned import Learned
from jaxhom.apprenticeship.presolve import Reach
from jaxhom.models.mdp import MDP, uniform_policy
from jaxhom.solvers.nearest_point import nearest_mixture
from jaxhom.status import Status

if TYPE_CHECKING:
    from jaxtyping import ArrayLike, Float

    Mix = Callable[[Float[np.ndarray, "M K"], Float[np.ndarray, " M"], int], Float[np.ndarray, " M"]]

_GAP = 1e-4  # of what the feature that can do most can do


@checks.eager_where_concrete
def projection(
    mdp: MDP,
    expectations: Float[ArrayLike, "*B K"],
    *,
    method: str = "max_margin",
    tolerance: float | Float[ArrayLike, " B"] | None = None,
    max_iterations: int = 1000,
) -> Learned:
    """Finds the policy whose feature expectations are nearest to the given ones in the 2-norm.

    It solves min_pi |expectations - V(pi)|_2 over all stationary policies, by best responses to weights of any sign.
    Features count as they are: the distance is in the units of `feature_expectations`, and a feature of a larger scale
    counts for more. Scale features beforehand where they should count alike.

    Args:
      mdp: the model, with K >= 1 features.
      expectations: [K] or a batch [B, K], discounted feature expectations of the expert, in the units of
        `feature_expectations` (sums over time). No policy need reach them.
      method: "max_margin", the paper's quadratic program: in every round the nearest mixture of all policies met,
        exactly, so that few rounds do. "projection", its simpler algorithm: each round projects onto the way to the
        new policy alone; where the expectations are out of reach that zigzags, and takes hundreds of rounds or more.
      tolerance: objective - bound to settle for; [B] for each lane its own. By default 1e-4 / (1 - discount) times the
        most that a feature can do in a step, its range.
      max_iterations: best responses, per lane, after which to stop.

    Returns:
      `Learned`, with a leading axis [B] if the expectations have one:

      - `policy` [S, A]: one stationary policy with the occupancy of the paper's mixture of policies (eq. (5) of
        Boularias and Chaib-draa 2010), so with its feature expectations.
      - `objective`: the distance |expectations - V(policy)|_2 of the returned policy, computed from it; rounded up.
      - `bound`: no policy is nearer; not negative; rounded down. Both are computed in float64, whatever the model's
        type, and hold whatever the status.
      - `weights` [K]: of any sign, |weights|_2 = 1; they prove the bound. They point from the mixture of one round to
        the expectations. All 0 if the first policy, the uniform one, already meets the expectations to the last digit.
      - `greedy_policy` [S, A]: best for these weights.
      - `iterations`: best responses. `status`: STALLED says that rounding keeps the two further apart than the
        tolerance.

    On the host: inside jit, vmap and grad of concrete values alone.

    Raises:
      ValueError: on wrong shapes, expectations that are not finite, a model without features, features or expectations
        so large that their sums over time overflow, an unknown method, a tolerance that is not positive, a count below
        1, or if anything is traced.

    Source: Abbeel and Ng 2004, section 3 and 3.1.

    Example:
      >>> import jaxhom
      >>> mdp = jaxhom.gridworld(4, num_regions=4).mdp
      >>> expert = jaxhom.optimal_policy(mdp, mdp.features[..., 3] - mdp.features[..., 0])
      >>> learned = jaxhom.projection(mdp, jaxhom.feature_expectations(mdp, expert.policy), tolerance=0.01)
      >>> print(bool(learned.objective - learned.bound <= 0.01), jaxhom.Status(int(learned.status)).name)
      True SOLVED
    """
    if not isinstance(method, str) or method not in _METHODS:
        raise ValueError(f"method must be one of {tuple(_METHODS)}, got {checks.in_one_line(method)}")
    limit = checks.require_count("max_iterations", max_iterations)

    def solve(sides, reach, expectations, tolerance):
        proposal = _rounds(sides, expectations, goal_of(sides.mdp, tolerance), limit, _METHODS[method])
        return _certified(sides, expectations, tolerance, proposal)

    return learn_lane_by_lane("projection", mdp, expectations, tolerance, _default_tolerance, solve)


def _default_tolerance(reach: Reach, expectations: Float[np.ndarray, "B K"]) -> float:
    largest = reach.scale.max(where=np.isfinite(reach.scale), initial=0.0) or reach.size
    return _GAP / (1.0 - reach.discount) * float(largest)


def _step_towards(points: Float[np.ndarray, "M K"], shares: Float[np.ndarray, " M"], new: int):
    """The projection of the origin onto the way from the mixture to the new policy, which ends there."""
    now = shares @ points
    way = points[new] - now
    length = way @ way
    step = np.clip(-(now @ way) / length, 0.0, 1.0) if length > 0 else 0.0
    return (1.0 - step) * shares + step * (np.arange(len(points)) == new)


def _nearest_of_all(points: Float[np.ndarray, "M K"], shares: Float[np.ndarray, " M"], new: int):
    """The nearest mixture of all policies met."""
    return nearest_mixture(points, shares)


_METHODS: dict[str, Mix] = {"projection": _step_towards, "max_margin": _nearest_of_all}


def _rounds(sides: ExactSides, expectations: Float[np.ndarray, " K"], goal: float, limit: int, mix: Mix) -> Proposal:
    """Best responses to the direction from the mixture to the expectations, until the gap is below the goal."""
    responder = Responder(sides, goal)
    responder.add(np.asarray(uniform_policy(sides.mdp), np.float64))
    shares, weights, bound = np.ones(1), np.zeros_like(expectations), -np.inf
    points = responder.pool.expected - expectations
    unit = np.abs(points).max() or 1.0  # squares of numbers like 1e200 overflow, and those of 1e-200 are 0
    points, goal = points / unit, goal / unit
    distance = np.linalg.norm(shares @ points)
    iterations, status = 0, Status.SOLVED if distance == 0 else Status.ITERATION_LIMIT
    while status == Status.ITERATION_LIMIT and iterations < limit:
        direction = -(shares @ points) / distance
        most, number = responder.respond(direction)
        iterations += 1
        proved = (direction @ expectations - most) / unit
        if proved > bound:
            bound, weights = proved, direction
        points = (responder.pool.expected - expectations) / unit
        shares = np.append(shares, np.zeros(len(points) - len(shares)))
        mixed = mix(points, shares, number)
        before, after = distance, np.linalg.norm(mixed @ points)
        if after < before:
            shares, distance = mixed, after
        if distance - max(bound, 0.0) <= goal:
            status = Status.SOLVED
        elif not after < before:  # the best response is no nearer: rounding has the last word
            status = Status.STALLED
    return Proposal(mixture(responder.pool, shares), weights, responder.guess(weights), iterations, status)


def _certified(
    sides: ExactSides, expectations: Float[np.ndarray, " K"], tolerance: float, proposal: Proposal
) -> Learned:
    outcome, eps = Outcome(sides, proposal, expectations, tolerance), np.finfo(float).eps
    farthest = np.maximum(np.abs(expectations - outcome.low), np.abs(expectations - outcome.high))
    length = np.linalg.norm(outcome.weights.astype(np.float64))
    rounding = 1.0 + (len(expectations) + 8) * eps
    size = farthest.max() or 1.0
    distance = float(size * np.linalg.norm(farthest / size) * rounding + eps * np.abs(expectations).max())
    bound = max(0.0, -outcome.advantage / (length * rounding)) if length > 0 else 0.0
    return outcome.learned(distance, min(bound, distance), is_above=True)
