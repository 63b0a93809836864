"""What learners that play against best responses share: the doors, the responses, and the certified end.

`projection` and `mwal` seek a mixture of policies, one best response after the other, on the host in float64 (`exact`).
The mixture's occupancy is the same mixture of the policies' occupancies, and eq. (5) gives the one stationary policy
that has it. What is returned is evaluated anew, from the policy and the weights as they are in the model's type.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import jax
import numpy as np

from jaxhom import checks
from jaxhom.apprenticeship.arguments import check_features, check_tolerance, checked_expectations
from jaxhom.apprenticeship.certificate import ExactSides
from jaxhom.apprenticeship.exact import exact_rows
from jaxhom.apprenticeship.learned import Learned
from jaxhom.apprenticeship.policy_pool import PolicyPool
from jaxhom.apprenticeship.presolve import Reach
from jaxhom.apprenticeship.solution import RARE_STATES
from jaxhom.models.inputs import as_model, require_features
from jaxhom.models.mdp import MDP
from jaxhom.planning import policy_iteration
from jaxhom.planning.occupancy import occupancy, policy_from_occupancy
from jaxhom.planning.optimal import optimal_policy
from jaxhom.solvers.blas_threads import one_blas_thread
from jaxhom.solvers.outward import rounded_down, rounded_up
from jaxhom.status import Status

if TYPE_CHECKING:
    from jaxtyping import ArrayLike, Float, Int

_DIGITS = 1e-3  # share of the tolerance by which responses may miss the best, and evaluations the truth


class Responder:
    """Best responses to weights of any sign on one model; a policy that comes up again is not evaluated again.

    Args:
      sides: the model.
      tolerance: what the caller is after.

    Attributes:
      pool: the policies met.
    """

    def __init__(self, sides: ExactSides, tolerance: float):
        self._mdp, self._exact, self._error = sides.mdp, sides.exact, _DIGITS * tolerance
        self.pool, self._numbers = PolicyPool(sides.mdp), dict[bytes, int]()
        self._value = np.zeros(sides.mdp.num_states)

    def respond(self, weights: Float[np.ndarray, " K"]) -> tuple[float, int]:
        """What no policy's w . V is above, and the number of the best policy in the pool."""
        most, self._value, actions = self._exact.plan(weights, self.guess(weights), None, self._error)
        key = actions.tobytes()
        if key not in self._numbers:
            policy = np.eye(self._exact.allowed.shape[1])[actions]
            mu, expected, _ = self._exact.expectations(policy, self._occupancy(actions, policy), self._error)
            self._numbers[key] = self.pool.add(mu, actions, expected)
        return most, self._numbers[key]

    def add(self, policy: Float[np.ndarray, "S A"]) -> int:
        """Takes a policy that may be random."""
        policy = exact_rows(policy, np.float64)
        mu, expected, _ = self._exact.expectations(policy, self._occupancy(policy, policy), self._error)
        return self.pool.add(mu, policy, expected)

    def guess(self, weights: Float[np.ndarray, " K"]) -> Float[np.ndarray, " S"]:
        """Values of the best policy for the weights, from the last ones: with few factorisations, or by a program."""
        exact = self._exact
        reward = (exact.features @ weights).reshape(len(self._value), -1)
        reward = np.where(exact.allowed, reward, -np.inf)
        if not exact.is_direct:
            plan = optimal_policy(self._mdp, reward.astype(self._mdp.dtype), initial_value=self._value)
            return np.asarray(plan.value, np.float64)
        start = (reward + exact.discount * exact.model.expected_next_value(self._value)).argmax(axis=1)
        found = policy_iteration.iterate(exact.model, reward, start, float(np.finfo(float).eps))
        return self._value if found is None else found.value

    def _occupancy(
        self, choice: Int[np.ndarray, " S"] | Float[np.ndarray, "S A"], policy: Float[np.ndarray, "S A"]
    ) -> Float[np.ndarray, " S"]:
        """That of the states, of a policy and its actions or itself."""
        if self._exact.is_direct:
            return self._exact.model.chain(choice).state_occupancy(self._exact.initial)
        return np.asarray(occupancy(self._mdp, policy), np.float64).sum(axis=1)


class Proposal(NamedTuple):
    """What the rounds of a lane have found; nothing of it certified.

    Attributes:
      x: [S, A], the mixture's occupancy.
      weights: [K]. value: [S], a guess of the best values for them.
      iterations: best responses.
      status: how the rounds ended.
    """

    x: Float[np.ndarray, "S A"]
    weights: Float[np.ndarray, " K"]
    value: Float[np.ndarray, " S"]
    iterations: int
    status: Status


class Outcome:
    """What a lane returns, evaluated: the policy of a mixture, and what its weights prove.

    Args:
      sides: the model.
      proposal: of the lane.
      expectations: [K], as the caller gave them. tolerance: of the lane.

    Attributes:
      policy: [S, A], in the model's type, rows sum to exactly 1.
      greedy_policy: [S, A], the best actions for the weights.
      weights: [K], in the model's type.
      low, high: [K], what the policy's feature expectations are at least and at most.
      advantage: scalar, no policy's weights . (V - expectations) is larger.
    """

    def __init__(self, sides: ExactSides, proposal: Proposal, expectations: Float[np.ndarray, " K"], tolerance: float):
        dtype, error, x = np.dtype(sides.mdp.dtype), _DIGITS * tolerance, proposal.x
        self._proposal, self._tolerance = proposal, tolerance
        self.weights = proposal.weights.astype(dtype)
        self.advantage, actions = sides.advantage(self.weights.astype(np.float64), expectations, proposal.value, error)
        best = np.eye(x.shape[1])[actions]
        self.greedy_policy = best.astype(dtype)
        self.policy = exact_rows(policy_from_occupancy(sides.mdp, x, best, RARE_STATES), dtype)
        self.low, self.high = sides.expected(self.policy, error)

    def learned(self, objective: float, bound: float, *, is_above: bool) -> Learned:
        """The record of the lane. `is_above`: whether the objective is to come down to the bound, or up."""
        dtype, stopped = self.policy.dtype, self._proposal.status
        high, low = (objective, bound) if is_above else (bound, objective)
        high, low = rounded_up(high, dtype), rounded_down(low, dtype)
        is_closed = float(high) - float(low) <= self._tolerance
        if stopped == Status.SOLVED:
            stopped = Status.STALLED  # unless what is returned agrees
        return Learned(
            policy=self.policy,
            greedy_policy=self.greedy_policy,
            weights=self.weights,
            expectations=(0.5 * (self.low + self.high)).astype(dtype),
            objective=high if is_above else low,
            bound=low if is_above else high,
            iterations=np.int32(self._proposal.iterations),
            status=np.int32(Status.SOLVED if is_closed else stopped),
        )


def learn_lane_by_lane(
    name: str,
    mdp: MDP,
    expectations: Float[ArrayLike, "*B K"],
    tolerance: float | Float[ArrayLike, " B"] | None,
    default_tolerance: Callable[[Reach, Float[np.ndarray, "B K"]], Float[np.ndarray, "*B"] | float],
    solve: Callable[[ExactSides, Reach, Float[np.ndarray, " K"], float], Learned],
) -> Learned:
    """Checks what a caller of `name` gave, solves lane by lane, and stacks what comes out."""
    mdp = as_model(mdp)
    if checks.is_traced(mdp, expectations, tolerance):
        raise ValueError(
            f"{name} plans on the host: call it outside jit, vmap and grad, or use lpal there, which works inside"
        )
    require_features(mdp)
    check_features(mdp)
    expectations = checked_expectations(mdp, expectations)
    batch = np.atleast_2d(expectations).astype(np.float64)
    sides, reach = ExactSides(mdp), Reach.of(mdp)
    if tolerance is None:
        tolerance = default_tolerance(reach, batch)
    else:
        check_tolerance(tolerance, expectations)
    tolerance = np.broadcast_to(np.asarray(tolerance, np.float64), len(batch))
    with one_blas_thread():  # matrices are small: where other work keeps cores busy, threads wait for each other
        lanes = [solve(sides, reach, batch[k], float(tolerance[k])) for k in range(len(batch))]
    learned = jax.tree.map(lambda *leaves: np.stack(leaves), *lanes) if expectations.ndim == 2 else lanes[0]
    return jax.tree.map(checks.to_device, learned)


def goal_of(mdp: MDP, tolerance: float) -> float:
    """The gap at which rounds may end: what is left of the tolerance is for what the model's type hides."""
    return (0.9 if np.dtype(mdp.dtype) == np.float64 else 0.5) * tolerance


def mixture(pool: PolicyPool, shares: Float[np.ndarray, " M"]) -> Float[np.ndarray, "S A"]:
    """The occupancy of the pool's policies, mixed."""
    (numbers,) = np.nonzero(shares)
    return pool.mixture(numbers.tolist(), shares[numbers].tolist())
