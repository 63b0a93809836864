"""The two sides of LPAL's certificate, computed on the host in float64 with everything that rounding may hide.

Solvers propose; what they report is computed here, from the policy and the weights alone, whatever the model's type.
Rows of float32 tables miss the sum 1 by 1e-8, which near a discount of 1 is not little: bounds are made for the rows as
they should be and for the rows as they are (`as_stored`).

Below. For any guess mu of a policy's state occupancy, with x = mu pi and what misses in the flow,
r = alpha + gamma T^T x - mu, the expectations are V_i(pi) = phi_i . x + r . v_i. Where v_i, the value of feature i, is
everywhere within h_i of c_i (half the range of phi_i, and its middle, times 1 / (1 - gamma)), they are within h_i |r|_1
of phi_i . x + c_i sum(r).

Above. For any values V and b = max_a (r + gamma T V) - V, the optimal value is at most V + max_s b / (1 - gamma)
(Puterman 1994, section 6.6), and at least V + min_s b / (1 - gamma).

What guesses prove takes a product, for many lanes at once (`evaluate`, `bound`). Where a guess is too rough, it is
replaced by the solution of the linear system (`expectations`, `plan`): by LU if the model is small or its graph like a
road or a grid, otherwise by BiCGSTAB; values by steps of policy iteration.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import scipy

from jaxhom.models.mdp import MDP
from jaxhom.planning import policy_iteration
from jaxhom.planning.host_chains import host_model, transition_under

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

NEAR_ONE = 0.998  # a discount above which linear systems are better solved on the host
_EPS = np.finfo(np.float64).eps
_DIRECT = 4e6  # states times bandwidth, up to which LU is quick
ENOUGH = 0.05  # share of the tolerance that errors may take without another attempt
_ROUNDINGS = 16.0  # by which a row may miss 1 before that is looked at
_MAX_IMPROVEMENTS = 200  # of policy iteration; the bound holds wherever it stops
_MAX_KRYLOV_STEPS, _KRYLOV_RESIDUAL = 500, 1e-13  # to what float64 can give; what is missing widens the bound


class Exact:
    """A model's policies and rewards, evaluated on the host.

    Attributes:
      model: the `jaxhom.planning.host_chains.HostModel`. rows: [S A, S], its transitions, or those as they are stored.
      initial: [S]. features: [S A, K], or [S, K] where they do not depend on the action.
      size: [K], the largest |feature|. time: least and most discounted time, sum(initial) / (1 - gamma).
      allowed: bool [S, A].
    """

    def __init__(self, mdp: MDP, total: Float[np.ndarray, " S*A"] | None = None):
        """`total` [S A]: what rows of probabilities sum to; 1 if None."""
        self.model, self.allowed = host_model(mdp), np.asarray(mdp.allowed)
        self._all_allowed = bool(self.allowed.all())
        self._mdp, self._is_given = mdp, total is not None
        self.initial = np.asarray(mdp.initial, np.float64)
        self.discount = float(mdp.discount)
        self.features = compact_features(np.asarray(mdp.features), self.allowed).astype(np.float64)
        low, high = self.features.min(axis=(0, 1)), self.features.max(axis=(0, 1))
        self.size, self._has_negative = np.maximum(abs(low), abs(high)), bool(low.min() < 0)
        self.features = self.features.reshape(-1, len(self.size))
        kept = self.discount * (np.ones(1) if total is None else total[self.allowed.ravel()])
        self.time = self.initial.sum() / (1.0 - kept.min()), self.initial.sum() / (1.0 - kept.max())
        self._most = 1.0 / (1.0 - kept.max())
        times = np.array([[1.0 / (1.0 - kept.min())], [self._most]])
        low, high = (low * times).min(axis=0), (high * times).max(axis=0)
        self._middle, self._half = 0.5 * (low + high), 0.5 * (high - low) + 4.0 * _EPS * self._most * self.size
        rows = self.model.rows
        if total is not None:
            rows = (
                (scipy.sparse.diags_array(total) @ rows).tocsr()
                if scipy.sparse.issparse(rows)
                else total[:, None] * rows
            )
        self.rows = rows
        if scipy.sparse.issparse(rows):
            self._out, self._in = np.diff(rows.indptr).max(), np.bincount(rows.indices).max()
        else:
            self._out, self._in = rows.shape[1], rows.shape[0]

    def as_stored(self) -> Exact | None:
        """The model with its rows as they are stored; None if they sum to 1 in float64, up to some roundings."""
        total = np.asarray(self._mdp.probability).sum(axis=-1, dtype=np.float64).ravel()
        is_off = np.abs(total - 1.0)[self.allowed.ravel()].max() > _ROUNDINGS * _EPS
        return Exact(self._mdp, np.where(self.allowed.ravel(), total, 1.0)) if is_off else None

    @property
    def is_direct(self) -> bool:
        """Whether linear systems are solved by LU, whatever the discount."""
        return self.model.is_narrow or self.model.num_states * self.model.bandwidth <= _DIRECT

    def expectations(
        self, policy: Float[np.ndarray, "S A"], guess: Float[np.ndarray, " S"] | None, tolerance: float
    ) -> tuple[Float[np.ndarray, " S"], Float[np.ndarray, " K"], Float[np.ndarray, " K"]]:
        """The occupancy of the states, feature expectations, and what these may be off by.

        Args:
          policy: [S, A], rows sum to exactly 1.
          guess: [S], the occupancy of the states, or None.
          tolerance: an error that does not matter.

        Returns:
          (mu [S], V [K], error [K]); V - error is below and V + error above the true expectations.
        """
        best = None
        if guess is not None and np.isfinite(guess).all():
            best = self._expected(policy, guess)
        if best is None or not best[2].max() <= ENOUGH * tolerance:
            start = self.initial * self._most if best is None else best[0]
            best = best or self._expected(policy, start)
            found = self._solve(policy, self.initial, start, is_flow=True)
            if np.isfinite(found).all():
                found = self._expected(policy, np.maximum(found, 0.0))
                best = found if found[2].sum() < best[2].sum() else best
        return best

    def _expected(self, policy, mu):
        expected, error = self.evaluate(policy[None], mu[None])
        return mu, expected[0], error[0]

    def evaluate(
        self, policy: Float[np.ndarray, "B S A"], mu: Float[np.ndarray, "B S"]
    ) -> tuple[Float[np.ndarray, "B K"], Float[np.ndarray, "B K"]]:
        """What guesses of the occupancies prove, without linear solves.

        Args:
          policy: [B, S, A], rows sum to exactly 1.
          mu: [B, S], not negative.

        Returns:
          (V [B, K], error [B, K]), as `expectations`.
        """
        x = (mu[..., None] * policy).reshape(len(mu), -1)
        arrived = self.initial + self.discount * (self.rows.T @ x.T).T
        missing = arrived - mu
        visits = mu if len(self.features) == mu.shape[1] else x
        expected = visits @ self.features
        absolute = visits @ np.abs(self.features) if self._has_negative else expected
        largest, off = self._most * self.size, np.abs(missing).sum(axis=1)[:, None]
        rounding = (self._in + 8) * (arrived + mu).sum(axis=1)[:, None] + (mu.shape[1] + 8) * off
        rounding = _EPS * (rounding * largest + (visits.shape[1] + 8) * absolute)
        return expected + missing.sum(axis=1)[:, None] * self._middle, off * self._half + rounding

    def plan(
        self,
        weights: Float[np.ndarray, " K"],
        value: Float[np.ndarray, " S"] | None,
        actions: Int[np.ndarray, " S"] | None,
        tolerance: float,
    ) -> tuple[float, Float[np.ndarray, " S"], Int[np.ndarray, " S"]]:
        """The best policy for the reward w . phi.

        Args:
          weights: [K].
          value: [S], a guess of the optimal values, or None. actions: [S], of the optimal actions, or None.
          tolerance: an error that does not matter.

        Returns:
          (bound, value [S], actions [S]): the policy of the actions is optimal up to what is open between the bound and
          its own value; no policy is worth more than the bound.
        """
        reward, size = self._reward(weights[None])
        start, own_reward, states = np.zeros(len(self.initial)), reward[0], np.arange(len(self.initial))

        def bound_of(value, actions):
            actions = None if actions is None else actions[None]
            return [part[0] for part in self._bound(reward, size, value[None], actions, len(weights))]

        def backup(value):
            action_value = own_reward + self.discount * (self.rows @ value).reshape(own_reward.shape)
            return action_value if self._all_allowed else np.where(self.allowed, action_value, -np.inf)

        best = np.inf
        if value is not None and np.isfinite(value).all():
            value = np.clip(value, -size * self._most, size * self._most)
            best, open_, greedy = bound_of(value, None)
            if open_ <= ENOUGH * tolerance:
                return best, value, greedy
            start, actions = value, greedy if actions is None else actions
        if actions is None:
            actions = np.where(self.allowed, own_reward, -np.inf).argmax(axis=1)
        value = start
        for _ in range(_MAX_IMPROVEMENTS):
            found = self._solve(actions, own_reward[states, actions], value, is_flow=False)
            if not np.isfinite(found).all():
                break
            value = found
            bound, open_, greedy = bound_of(value, actions)
            best = min(best, bound)
            if open_ <= ENOUGH * tolerance or (greedy == actions).all():
                break
            actions = policy_iteration.swept(self.model, backup, greedy, value)
        if not np.isfinite(best):
            best, _, actions = bound_of(value, None)
        return best, value, actions

    def bound(
        self, weights: Float[np.ndarray, "B K"], value: Float[np.ndarray, "B S"]
    ) -> tuple[Float[np.ndarray, " B"], Float[np.ndarray, " B"], Int[np.ndarray, "B S"]]:
        """What guesses of the optimal values prove, without linear solves.

        Args:
          weights: [B, K].
          value: [B, S]; what no policy can be worth is cut off.

        Returns:
          (bound [B], what may be open below it [B], actions [B, S]), as `plan`.
        """
        reward, size = self._reward(weights)
        most = (size * self._most)[:, None]
        value = np.clip(np.nan_to_num(value), -most, most)
        return self._bound(reward, size, value, None, weights.shape[1])

    def _reward(self, weights):
        """w . phi [B, S, A], or [B, S, 1] if it is the same for all actions, and the largest of each [B]."""
        reward = (weights @ self.features.T).reshape(len(weights), len(self.initial), -1)
        size = np.abs(reward).max(axis=(1, 2)) + (weights.shape[1] + 2) * _EPS * (np.abs(weights) @ self.size)
        return np.broadcast_to(reward, (len(weights), *self.allowed.shape)), size

    def _bound(self, reward, size, value, actions, num_features):
        """The bound that values prove, what may be open below it, and better actions; those given where none are."""
        action_value = np.ascontiguousarray((self.rows @ value.T).T).reshape(reward.shape)
        action_value *= self.discount
        action_value += reward
        if not self._all_allowed:
            action_value[:, ~self.allowed] = -np.inf
        greedy = action_value.argmax(axis=2)
        best = np.take_along_axis(action_value, greedy[..., None], axis=2)[..., 0]
        gain, largest = best - value, np.abs(value).max(axis=1)
        rounding = (self._out + num_features + 8) * _EPS * (size + 2.0 * largest)
        at_start, top, (least, most) = value @ self.initial, gain.max(axis=1), self.time
        terms = value.shape[1] + 8
        rounding = most * rounding + terms * _EPS * (np.abs(value) @ self.initial + np.abs(top) * most)
        bound = at_start + np.maximum(top * least, top * most) + rounding
        if actions is not None:
            own = np.take_along_axis(action_value, actions[..., None], axis=2)[..., 0]
            is_better = best > own + 8.0 * _EPS * (np.abs(own) + largest[:, None])
            greedy = np.where(is_better, greedy, actions)
        return bound, most * (top - gain.min(axis=1)), greedy

    def _solve(self, policy, right, start, *, is_flow: bool) -> np.ndarray:
        """Solves (I - gamma P_pi) x = right, or with P_pi^T; policy [S, A] or actions [S]. Nobody vouches for x."""
        if self.is_direct and not self._is_given:
            chain = self.model.chain(policy)
            return chain.state_occupancy(right) if is_flow else chain.value(right)
        matrix = transition_under(policy, self.rows)
        if self.is_direct:
            return _solve_directly(matrix.T if is_flow else matrix, self.discount, right)
        matrix = matrix.T if is_flow else matrix
        shape = (len(right), len(right))
        system = scipy.sparse.linalg.LinearOperator(shape, lambda v: v - self.discount * (matrix @ v), dtype=float)
        with np.errstate(all="ignore"):
            options = {"rtol": _KRYLOV_RESIDUAL, "atol": 0.0, "maxiter": _MAX_KRYLOV_STEPS}
            return scipy.sparse.linalg.bicgstab(system, right, x0=start, **options)[0]


def _solve_directly(matrix, discount: float, right: np.ndarray) -> np.ndarray:
    """Solves (I - gamma P) x = right."""
    if scipy.sparse.issparse(matrix):
        identity = scipy.sparse.eye_array(len(right), format="csc")
        return scipy.sparse.linalg.splu(scipy.sparse.csc_array(identity - discount * matrix)).solve(right)
    return np.linalg.solve(np.eye(len(right)) - discount * matrix, right)


def compact_features(
    features: Float[np.ndarray, "S A K"], allowed: Bool[np.ndarray, "S A"]
) -> Float[np.ndarray, "S A|1 K"]:
    """Features [S, A, K] as [S, 1, K] where they are the same for all allowed actions."""
    if allowed.all():
        some = features[:, :1]
        depends = (features != some).any()
    else:
        some = np.take_along_axis(features, allowed.argmax(axis=1)[:, None, None], axis=1)
        depends = ((features != some) & allowed[..., None]).any()
    return features if depends else some


def exact_rows(policy: Float[np.ndarray, "*B S A"], dtype: np.dtype | type) -> Float[np.ndarray, "*B S A"]:
    """A policy [..., S, A] in numbers of the given type whose rows sum to exactly 1, in any order of the sum.

    At a discount of 0.99999 a row that misses 1 by a rounding of float32 would move expectations by a hundredth. The
    probabilities are multiples of the type's spacing below 1; the largest takes what is left.
    """
    count = 2.0 ** (np.finfo(dtype).nmant + 1)
    steps = np.floor(np.asarray(policy, np.float64) * count)
    largest = steps.argmax(axis=-1)[..., None]
    rest = count - steps.sum(axis=-1, keepdims=True)
    np.put_along_axis(steps, largest, np.take_along_axis(steps, largest, axis=-1) + rest, axis=-1)
    return (steps / count).astype(dtype)
