"""The two sides of LPAL's certificate, computed on the host in float64 with everything that rounding may hide.

Solvers propose; what they report is computed here, from the policy and the weights alone, whatever the model's type.
Rows of float32 tables miss the sum 1 by 1e-8, which near a discount of 1 is not little: bounds are made for the rows as
they should be and for the rows as they are (`as_stored`).

Below. For any guess mu of a policy's state occupancy, with x = mu pi and what misses in the flow,
r = alpha + gamma T^T x - mu, the expectations are V_i(pi) = phi_i . x + r . v_i, where v_i, the value of feature i, is
at most max |phi_i| / (1 - gamma): the error is at most |r|_1 max |phi_i| / (1 - gamma).

Above. For any values V and b = max_a (r + gamma T V) - V, the optimal value is at most V + max_s b / (1 - gamma)
(Puterman 1994, section 6.6), and at least V + min_s b / (1 - gamma).

Where a guess is too rough, it is replaced by the solution of the linear system: by LU if the model is small or its
graph like a road or a grid, otherwise by BiCGSTAB; values by steps of policy iteration.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from jaxhom.models.mdp import MDP
from jaxhom.planning.host_chains import host_model

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

NEAR_ONE = 0.998  # a discount above which linear systems are better solved on the host
_EPS = np.finfo(np.float64).eps
_DIRECT = 4e6  # states times bandwidth, up to which LU is quick
_ENOUGH = 0.05  # share of the tolerance that errors may take without another attempt
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
        self._mdp, self._is_given = mdp, total is not None
        self.initial = np.asarray(mdp.initial, np.float64)
        self.discount = float(mdp.discount)
        self.features = compact_features(np.asarray(mdp.features), self.allowed).astype(np.float64)
        self.size = np.abs(self.features).max(axis=(0, 1))
        self.features = self.features.reshape(-1, len(self.size))
        kept = self.discount * (np.ones(1) if total is None else total[self.allowed.ravel()])
        self.time = self.initial.sum() / (1.0 - kept.min()), self.initial.sum() / (1.0 - kept.max())
        self._most = 1.0 / (1.0 - kept.max())
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
        if best is None or not best[2].max() <= _ENOUGH * tolerance:
            start = self.initial * self._most if best is None else best[0]
            best = best or self._expected(policy, start)
            found = self._solve(policy, self.initial, start, is_flow=True)
            if np.isfinite(found).all():
                found = self._expected(policy, np.maximum(found, 0.0))
                best = found if found[2].sum() < best[2].sum() else best
        return best

    def _expected(self, policy, mu):
        x = mu[:, None] * policy
        arrived = self.initial + self.discount * (self.rows.T @ x.ravel())
        missing = np.abs(arrived - mu).sum() + (self._in + 8) * _EPS * (np.abs(arrived).sum() + mu.sum())
        visits = mu if len(self.features) == len(mu) else x.ravel()
        expected = visits @ self.features
        rounding = (len(visits) + 8) * _EPS * (visits @ np.abs(self.features))
        return mu, expected, missing * self.size * self._most + rounding

    def plan(
        self,
        weights: Float[np.ndarray, " K"],
        value: Float[np.ndarray, " S"] | None,
        actions: Int[np.ndarray, " S"] | None,
        tolerance: float,
    ) -> tuple[float, Float[np.ndarray, " S"], Int[np.ndarray, " S"]]:
        """The best policy for the reward w . phi.

        Args:
          weights: [K], non-negative.
          value: [S], a guess of the optimal values, or None. actions: [S], of the optimal actions, or None.
          tolerance: an error that does not matter.

        Returns:
          (bound, value [S], actions [S]): the policy of the actions is optimal up to what is open between the bound and
          its own value; no policy is worth more than the bound.
        """
        reward, start = self._reward(weights), np.zeros(len(self.initial))
        size = np.abs(reward).max() + (len(weights) + 2) * _EPS * (weights @ self.size)
        best, states = np.inf, np.arange(len(start))
        if value is not None and np.isfinite(value).all():
            best, open_, greedy = self._bound(reward, size, value, None, len(weights))
            if open_ <= _ENOUGH * tolerance:
                return best, value, greedy
            start, actions = value, greedy if actions is None else actions
        if actions is None:
            actions = np.where(self.allowed, reward, -np.inf).argmax(axis=1)
        value = start
        for _ in range(_MAX_IMPROVEMENTS):
            found = self._solve(actions, reward[states, actions], value, is_flow=False)
            if not np.isfinite(found).all():
                break
            value = found
            bound, open_, greedy = self._bound(reward, size, value, actions, len(weights))
            best = min(best, bound)
            if open_ <= _ENOUGH * tolerance or (greedy == actions).all():
                break
            actions = greedy
        if not np.isfinite(best):
            best, _, actions = self._bound(reward, size, value, None, len(weights))
        return best, value, actions

    def _reward(self, weights) -> np.ndarray:
        reward = (self.features @ weights).reshape(len(self.initial), -1)
        return np.broadcast_to(reward, self.allowed.shape)

    def _bound(self, reward, size, value, actions, num_features):
        """The bound that values prove, what may be open below it, and better actions; those given where none are."""
        action_value = reward + self.discount * (self.rows @ value).reshape(self.allowed.shape)
        action_value = np.where(self.allowed, action_value, -np.inf)
        greedy = action_value.argmax(axis=1)
        gain = action_value.max(axis=1) - value
        largest = np.abs(value).max()
        rounding = (self._out + num_features + 8) * _EPS * (size + 2.0 * largest)
        at_start, top, least, most = self.initial @ value, gain.max(), *self.time
        rounding = most * rounding + (len(value) + 8) * _EPS * (self.initial @ np.abs(value) + abs(top) * most)
        bound = at_start + max(top * least, top * most) + rounding
        if actions is not None:
            own = np.take_along_axis(action_value, actions[:, None], axis=1)[:, 0]
            is_better = action_value.max(axis=1) > own + 8.0 * _EPS * (np.abs(own) + largest)
            greedy = np.where(is_better, greedy, actions)
        return bound, most * (top - gain.min()), greedy

    def _solve(self, policy, right, start, *, is_flow: bool) -> np.ndarray:
        """Solves (I - gamma P_pi) x = right, or with P_pi^T; policy [S, A] or actions [S]. Nobody vouches for x."""
        if self.is_direct and not self._is_given:
            chain = self.model.chain(policy)
            return chain.state_occupancy(right) if is_flow else chain.value(right)
        matrix = self._transition(policy)
        if self.is_direct:
            return _solve_directly(matrix.T if is_flow else matrix, self.discount, right)
        matrix = matrix.T if is_flow else matrix
        shape = (len(right), len(right))
        system = scipy.sparse.linalg.LinearOperator(shape, lambda v: v - self.discount * (matrix @ v), dtype=float)
        with np.errstate(all="ignore"):
            options = {"rtol": _KRYLOV_RESIDUAL, "atol": 0.0, "maxiter": _MAX_KRYLOV_STEPS}
            return scipy.sparse.linalg.bicgstab(system, right, x0=start, **options)[0]

    def _transition(self, policy):
        """P_pi of a policy [S, A] or of actions [S]."""
        num_actions = self.model.num_actions
        if policy.ndim == 1:
            return self.rows[np.arange(len(policy)) * num_actions + policy]
        if not scipy.sparse.issparse(self.rows):
            return np.einsum("sa,saz->sz", policy, self.rows.reshape(*policy.shape, -1))
        state, action = np.nonzero(policy)
        entries = (policy[state, action], (state, state * num_actions + action))
        return scipy.sparse.csr_array(entries, shape=(len(policy), policy.size)) @ self.rows


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


def rounded_down(number: float, dtype: np.dtype | type) -> Float[np.ndarray, ""]:
    """The largest number of the type that is not above the given one."""
    number = np.float64(number)
    with np.errstate(over="ignore"):
        rounded = number.astype(dtype)
    # In float64: Python numbers would be compared in the shorter type, where the two are equal.
    return np.nextafter(rounded, np.array(-np.inf, dtype)) if np.float64(rounded) > number else rounded
