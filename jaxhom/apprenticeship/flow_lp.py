"""LPAL's linear program over occupancies as a saddle-point problem, lanes last, with exact projections on the flow.

Maximise min_i (Phi^T x - Vhat)_i over occupancies: x >= 0 on the Bellman flow F x = alpha (Boularias and Chaib-draa
2010, eqs. 3-4). As a saddle point between the simple constraints and the affine set on which the others hold,

    min_{lambda >= 0, q in s simplex}  max_{(x, u) in A}  lambda . x + q . (u - Vhat / s),
    A = {(x, u): F x = alpha, s u = Phi^T x},

with multipliers lambda of x >= 0 and q = s w, w the weights of the upper bound. The coupling is the identity, so PDHG
on it is Douglas-Rachford splitting (O'Connor and Vandenberghe 2020), its step length 1 whatever the discount: that F is
nearly singular for discounts near 1 only concerns the projection on A, which is exact (`FlowProjection`).

x is scaled to sum 1, and features to about 1, each by a unit c_i of its own where their sizes differ: then q_i = s w_i
c_i / min c, and the simplex is sum_i q_i min c / c_i = s. Pairs that are not allowed have x = 0 and no multiplier. The
primal point is lambda and q stacked, [S A + K, lanes], the dual one x and u.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from jaxhom.models.mdp import MDP, expected_next_values, push_forward
from jaxhom.solvers.projections import project_simplex
from jaxhom.status import Record

if TYPE_CHECKING:
    from jaxtyping import Array, Float, Int

FEATURE_SCALE = 3.0  # s: a step moves weights by 1 / s^2 of what it moves multipliers of x >= 0


class FlowProjection(Record):
    """(M M^T)^-1 of the rows M = [F, 0; Phi^T, -s] of the affine set, by blocks, for products with many lanes.

    F F^T is block tridiagonal in a suitable order of the states, with nb blocks of n (one block: dense). The K feature
    rows are eliminated last.

    Attributes:
      order: int32 [nb n], the state at each place of the order; S, a row of zeros, on padding.
      place: int32 [S], the place of each state.
      lower: [nb, n, n], the block left of the diagonal in the block Cholesky factor with unit diagonal; 0 in the first.
      diagonal: [nb, n, n], inverses of the factor's diagonal blocks.
      behind: [S, K], (F F^T)^-1 F Phi.
      schur: [K, K], inverse of the feature rows' Schur complement.
    """

    order: Int[Array, " nb*n"]
    place: Int[Array, " S"]
    lower: Float[Array, "nb n n"]
    diagonal: Float[Array, "nb n n"]
    behind: Float[Array, "S K"]
    schur: Float[Array, "K K"]

    def solve(
        self, flow: Float[Array, "S lanes"], expected: Float[Array, "K lanes"]
    ) -> tuple[Float[Array, "S lanes"], Float[Array, "K lanes"]]:
        """(M M^T)^-1 of a right-hand side [S, lanes], [K, lanes]."""
        on_features = self.schur @ (expected - self.behind.T @ flow)
        return self._solve_flow(flow) - self.behind @ on_features, on_features

    def _solve_flow(self, right: jax.Array) -> jax.Array:
        """(F F^T)^-1 right, [S, lanes]: forwards and backwards over the blocks."""
        count, size, _ = self.diagonal.shape
        if count == 1:
            return self.diagonal[0] @ right
        right = jnp.concatenate([right, jnp.zeros_like(right[:1])])[self.order].reshape(count, size, -1)

        def forwards(before, block):
            lower, right = block
            reduced = right - lower @ before
            return reduced, reduced

        def backwards(behind, block):
            below, diagonal, reduced = block
            solution = diagonal @ reduced - below.T @ behind
            return solution, solution

        zeros = jnp.zeros_like(right[0])
        _, reduced = jax.lax.scan(forwards, zeros, (self.lower, right))
        below = jnp.roll(self.lower, -1, axis=0)  # that of the last block is 0
        _, solution = jax.lax.scan(backwards, zeros, (below, self.diagonal, reduced), reverse=True)
        return solution.reshape(count * size, -1)[self.place]


class FlowProblem(Record):
    """A batch of programs over one model.

    Attributes:
      mdp: the model.
      features: [S, A, K], or [S, 1, K] where they are those of the state alone; in units of their own.
      expectations: [K, lanes], (1 - gamma) Vhat in the units of `features`.
      projection: the factorisation for these features.
      share: [K], min c / c_i: what a feature's part of q counts for in the simplex. None where all are 1.
    """

    mdp: MDP
    features: Float[Array, "S A|1 K"]
    expectations: Float[Array, "K lanes"]
    projection: FlowProjection
    share: Float[Array, " K"] | None = None

    def start(self) -> tuple[jax.Array, jax.Array]:
        """No multipliers, uniform weights; the point of the affine set next to the uniform x."""
        (num_features, lanes), pairs = self.expectations.shape, self.mdp.num_states * self.mdp.num_actions
        x = jnp.full((self.mdp.num_states, self.mdp.num_actions, lanes), 1.0 / pairs, self.mdp.dtype)
        x = self._allowed(x)
        q = self._project_weights(jnp.full((num_features, lanes), FEATURE_SCALE / num_features, x.dtype))
        return jnp.concatenate([jnp.zeros((pairs, lanes), x.dtype), q]), self.project_dual(self.dual_of(x), None)

    def dual_of(self, x: jax.Array) -> jax.Array:
        """The dual point of x [S, A, lanes], on the affine set if x is on the flow."""
        return jnp.concatenate([x.reshape(-1, x.shape[-1]), self._expected(x) / FEATURE_SCALE])

    def forward(self, primal: jax.Array) -> jax.Array:
        """The identity."""
        return primal

    def adjoint(self, dual: jax.Array) -> jax.Array:
        """The identity."""
        return dual

    def project_primal(self, point: jax.Array, step: jax.Array) -> jax.Array:
        """lambda >= 0; the step on the linear term -q . Vhat / s, then q onto the simplex of sum s."""
        multipliers, q = self._split(point)
        q = self._project_weights(q + step * (self.expectations / FEATURE_SCALE))
        return jnp.concatenate([jnp.maximum(multipliers, 0.0), q])

    def project_dual(self, point: jax.Array, step: jax.Array | None) -> jax.Array:
        """Onto the affine set A."""
        del step
        mdp = self.mdp
        x, u = self._split(point)
        x = self._allowed(x.reshape(mdp.num_states, mdp.num_actions, -1))
        initial = (1.0 - mdp.discount) * mdp.initial[:, None]
        flow = x.sum(axis=1) - mdp.discount * push_forward(mdp, x) - initial
        on_flow, on_features = self.projection.solve(flow, self._expected(x) - FEATURE_SCALE * u)
        change = jnp.tensordot(self.features, on_features, axes=1)
        moved = [on_flow - mdp.discount * value for value in expected_next_values(mdp, on_flow)]
        x = self._allowed(x - change - jnp.stack(moved, axis=1))
        return jnp.concatenate([x.reshape(-1, x.shape[-1]), u + FEATURE_SCALE * on_features])

    def bounds(
        self, primal: jax.Array, dual: jax.Array, forward: jax.Array, adjoint: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """None: certificates are made of policies and weights, outside the iteration."""
        del dual, forward, adjoint
        infinity = jnp.full(primal.shape[-1], jnp.inf, primal.dtype)
        return -infinity, infinity

    def norm_bound(self) -> jax.Array:
        """1."""
        return jnp.ones(self.expectations.shape[-1], self.mdp.dtype)

    def weights(self, primal: jax.Array) -> jax.Array:
        """w [K, lanes], in the simplex."""
        _, q = self._split(primal)
        q = q / FEATURE_SCALE
        return project_simplex(q if self.share is None else q * self.share[:, None])

    def occupancies(self, primal: jax.Array, dual: jax.Array, weight: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Two non-negative readings of x, [S, A, lanes]: on the flow up to clipping, and complementary to lambda."""
        (multipliers, _), (x, _) = self._split(primal), self._split(dual)
        shape = (self.mdp.num_states, self.mdp.num_actions, -1)
        readings = jnp.maximum(x, 0.0), jnp.maximum(x - weight * multipliers, 0.0)
        return tuple(reading.reshape(shape) for reading in readings)

    def _project_weights(self, point: jax.Array) -> jax.Array:
        """q [K, lanes] onto its simplex."""
        if self.share is None:
            return project_simplex(point, FEATURE_SCALE)
        return project_weighted_simplex(point, self.share, FEATURE_SCALE)

    def _allowed(self, x: jax.Array) -> jax.Array:
        """x [S, A, lanes] without what is not allowed."""
        return jnp.where(self.mdp.allowed[..., None], x, 0.0) if self.mdp.restricts_actions else x

    def _split(self, stacked: jax.Array) -> tuple[jax.Array, jax.Array]:
        pairs = self.mdp.num_states * self.mdp.num_actions
        return stacked[:pairs], stacked[pairs:]

    def _expected(self, x: jax.Array) -> jax.Array:
        """Phi^T x, [S, A, lanes] -> [K, lanes]."""
        if self.features.shape[1] == 1:
            x = x.sum(axis=1, keepdims=True)
        return jnp.tensordot(self.features, x, axes=((0, 1), (0, 1)))


def project_weighted_simplex(
    point: Float[Array, "K lanes"], share: Float[Array, " K"], total: float
) -> Float[Array, "K lanes"]:
    """argmin_q |q - point|^2 subject to q >= 0, share . q = total; [K, lanes], share [K] positive.

    q = max(point - t share, 0), with t found from the values of t at which entries become 0.
    """
    share = share[:, None]
    knots = point / share

    def amount(t):
        return (share * jnp.maximum(point - t * share, 0.0)).sum(axis=0)

    # The mass falls with t: the last knot at which it is not yet below the total, and from there a straight line.
    amounts = jax.lax.map(amount, knots)
    reaches = jnp.where(amounts >= total, knots, -jnp.inf).max(axis=0)
    is_active = knots > reaches
    slope = jnp.where(is_active, share * share, 0.0).sum(axis=0)
    t = (jnp.where(is_active, share * point, 0.0).sum(axis=0) - total) / jnp.maximum(slope, jnp.finfo(point.dtype).tiny)
    return jnp.maximum(point - t * share, 0.0)
