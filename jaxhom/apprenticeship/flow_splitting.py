"""LPAL's linear program over occupancies by PDHG, lanes last, with exact projections on the Bellman flow.

Maximise min_i (Phi^T x - Vhat)_i over occupancies: x >= 0 on the Bellman flow F x = alpha (Boularias and Chaib-draa
2010, eqs. 3-4). As a saddle point between the simple constraints and the affine set on which the others hold,

    min_{lambda >= 0, w in simplex}  max_{(x, u) in A}  lambda . x + w . (u - Vhat),
    A = {(x, u): F x = alpha, u = Phi^T x},

with multipliers lambda of x >= 0 and w, the weights of the upper bound. The coupling is the identity, so PDHG on it is
Douglas-Rachford splitting (O'Connor and Vandenberghe 2020), whatever the discount: that F is nearly singular for
discounts near 1 only concerns the projection on A, which is exact (`FlowFactor`). With t and v the points that are
iterated, tau the primal weight of a lane and rho the relaxation, one iteration is

    x = max(t, 0),   lambda = max(-t, 0) / tau,   w = projection of (Vhat - v) / tau on the simplex,   u = v + tau w,
    (x', u') = projection of (2 x - t, 2 u - v) on A,   t += rho (x' - x),   v += rho (u' - u).

2 x - t is |t|, and x' = |t| - F^T y - Phi m with y and m the multipliers of the projection: one array of pairs is read,
and one written. At rest y / tau are the optimal values for w. The right tau differs between lanes by factors of 30, and
a wrong one costs thousands of iterations: every ten iterations it moves to where x and lambda travel equally far.

x is scaled to sum 1, and features to about 1, each by a unit c_i of its own where their sizes differ: then w_i stands
for w_i c_i / min c, and its simplex is sum_i w_i min c / c_i = 1. Pairs that are not allowed have x = 0 and no
multiplier. The states are in the order in which F F^T is block tridiagonal.
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

RELAXATION = 1.8  # rho: from 1, the plain method, to 2, the reflected one
STEPS_PER_WEIGHT = 10  # iterations between two looks at the weight: 16 lanes of grid16 (bench.instances) take a median
# of 150 iterations and twelve columns to the default gap, 250 and 16 with twenty
_MOST_CHANGE = 3.0  # of a weight at a look
_WEIGHTS = (1e-4, 1e4)  # what rounding in float32 allows


class FlowFactor(Record):
    """(M M^T)^-1 of the rows M = [F, 0; Phi^T, -1] of the affine set, by blocks, for products with many lanes.

    F F^T is block tridiagonal, with nb blocks of n (one block: dense). The K feature rows are eliminated last.

    Attributes:
      lower: [nb, n, n], the block left of the diagonal in the block Cholesky factor with unit diagonal; 0 in the first.
      diagonal: [nb, n, n], inverses of the factor's diagonal blocks.
      behind: [S, K], (F F^T)^-1 F Phi.
      schur: [K, K], inverse of the feature rows' Schur complement.
      order: int [2, S], the states in the order of the blocks, and its inverse; None where that is the caller's.
    """

    lower: Float[Array, "nb n n"]
    diagonal: Float[Array, "nb n n"]
    behind: Float[Array, "S K"]
    schur: Float[Array, "K K"]
    order: Int[Array, "2 S"] | None = None

    def solve(
        self, flow: Float[Array, "S lanes"], expected: Float[Array, "K lanes"]
    ) -> tuple[Float[Array, "S lanes"], Float[Array, "K lanes"]]:
        """(y, m) with M M^T (y, m) = (flow, expected)."""
        on_features = self.schur @ (expected - self.behind.T @ flow)
        return self.solve_flow(flow) - self.behind @ on_features, on_features

    def solve_flow(self, right: Float[Array, "S lanes"]) -> Float[Array, "S lanes"]:
        """(F F^T)^-1 of some columns."""
        (count, size, _), (num_states, lanes) = self.diagonal.shape, right.shape
        if self.order is not None:
            ordered = self.replace(order=None).solve_flow(right[self.order[0]])
            return ordered[self.order[1]]
        if count == 1:
            return self.diagonal[0] @ right
        right = jnp.pad(right, ((0, count * size - num_states), (0, 0))).reshape(count, size, lanes)

        def forwards(before, block):
            lower, right = block
            reduced = right - lower @ before
            return reduced, reduced

        def backwards(known, block):
            lower, right = block
            solution = right - known
            return lower.T @ solution, solution

        zeros = jnp.zeros_like(right[0])
        _, reduced = jax.lax.scan(forwards, zeros, (self.lower, right))
        _, solution = jax.lax.scan(backwards, zeros, (self.lower, self.diagonal @ reduced), reverse=True)
        return solution.reshape(count * size, lanes)[:num_states]


class Splitting(Record):
    """What all lanes share.

    Attributes:
      mdp: the model without features, its states in the order of the factor.
      features: [S, A, K], or [S, 1, K] where they are those of the state alone; in units of their own.
      factor: for these features.
      share: [K], min c / c_i: what a feature's part of w counts for in the simplex. None where all are 1.
    """

    mdp: MDP
    features: Float[Array, "S A|1 K"]
    factor: FlowFactor
    share: Float[Array, " K"] | None = None

    def expected(self, x: Float[Array, "S A lanes"]) -> Float[Array, "K lanes"]:
        """Phi^T x."""
        if self.features.shape[1] == 1:
            return self.features[:, 0].T @ x.sum(axis=1)
        return jnp.tensordot(self.features, x, axes=((0, 1), (0, 1)))

    def project_weights(self, point: Float[Array, "K lanes"]) -> Float[Array, "K lanes"]:
        """w onto its simplex."""
        if self.share is None:
            return project_simplex(point)
        return project_weighted_simplex(point, self.share, 1.0)

    def multipliers(
        self, x: Float[Array, "S A lanes"], u: Float[Array, "K lanes"]
    ) -> tuple[Float[Array, "S lanes"], Float[Array, "K lanes"]]:
        """(y, m) of the projection of (x, u) on the affine set."""
        mdp = self.mdp
        initial = (1.0 - mdp.discount) * mdp.initial[:, None]
        flow = x.sum(axis=1) - mdp.discount * push_forward(mdp, x) - initial
        return self.factor.solve(flow, self.expected(x) - u)

    def rows(self, y: Float[Array, "S lanes"], m: Float[Array, "K lanes"]) -> list[Float[Array, "S lanes"]]:
        """F^T y + Phi m, action by action."""
        discount, next_values = self.mdp.discount, expected_next_values(self.mdp, y)
        if self.features.shape[1] == 1:
            base = y + self.features[:, 0] @ m
            return [base - discount * value for value in next_values]
        return [y + self.features[:, a] @ m - discount * value for a, value in enumerate(next_values)]

    def allowed(self, x: Float[Array, "S A lanes"]) -> Float[Array, "S A lanes"]:
        """x without what is not allowed."""
        return jnp.where(self.mdp.allowed[..., None], x, 0.0) if self.mdp.restricts_actions else x


class State(Record):
    """Where the lanes are.

    Attributes:
      t: [S, A, lanes]. v: [K, lanes]. weight: [lanes], tau.
      x: [S, A, lanes], x' of the last iteration, on the flow; entries below 0 are cut off by whoever reads it.
      value: [S, lanes], y / tau there.
      change: [lanes], sum |x' - x| there: x sums to about 1, and is off the flow by no more.
      moved: [lanes], sum |w - former w| since the weight was looked at: 0 where w has arrived at a vertex.
      iterations: int32 [lanes].
    """

    t: Float[Array, "S A lanes"]
    v: Float[Array, "K lanes"]
    weight: Float[Array, " lanes"]
    x: Float[Array, "S A lanes"]
    value: Float[Array, "S lanes"]
    change: Float[Array, " lanes"]
    moved: Float[Array, " lanes"]
    iterations: Int[Array, " lanes"]


class Goal(Record):
    """What is asked of each lane: expectations [K, lanes], (1 - gamma) Vhat in the units of the features; and where to
    begin: x [S, A, lanes] and w [K, lanes]."""

    expectations: Float[Array, "K lanes"]
    x: Float[Array, "S A lanes"]
    w: Float[Array, "K lanes"]


class Point(Record):
    """x [S, A, lanes] and lambda, w [K, lanes] and u of a state."""

    x: Float[Array, "S A lanes"]
    multiplier: Float[Array, "S A lanes"]
    w: Float[Array, "K lanes"]
    u: Float[Array, "K lanes"]


def begin(splitting: Splitting, goal: Goal) -> State:
    """At x and w, without any multipliers of x >= 0."""
    one = jnp.ones(goal.w.shape[-1], goal.w.dtype)
    x = splitting.allowed(goal.x)
    v = splitting.expected(x) - goal.w
    value = jnp.zeros((len(x), len(one)), x.dtype)
    return State(t=x, v=v, weight=one, x=x, value=value, change=one, moved=one, iterations=0 * one.astype(jnp.int32))


def point(splitting: Splitting, goal: Goal, state: State) -> Point:
    """The proximal step: t and v in their two parts."""
    w = splitting.project_weights((goal.expectations - state.v) / state.weight)
    x, multiplier = jnp.maximum(state.t, 0.0), jnp.maximum(-state.t, 0.0) / state.weight
    return Point(x=x, multiplier=multiplier, w=w, u=state.v + state.weight * w)


def advance(splitting: Splitting, goal: Goal, state: State) -> State:
    """Some iterations, and a better weight."""
    old = point(splitting, goal, state)

    def iterations(k, state):
        # All but one, then one: what the last one did is looked at, and an iteration is compiled once.
        before = state.t
        count = jnp.where(k == 0, STEPS_PER_WEIGHT - 1, 1)
        state = jax.lax.fori_loop(0, count, lambda _, state: _iterate(splitting, goal, state), state)
        moved = (state.t - before) / RELAXATION
        return state.replace(x=jnp.maximum(before, 0.0) + moved, change=jnp.abs(moved).sum(axis=(0, 1)))

    state = jax.lax.fori_loop(0, 2, iterations, state)
    new = point(splitting, goal, state)
    travelled = _length(new.x - old.x, new.u - old.u) / _length(new.multiplier - old.multiplier, new.w - old.w)
    weight = jnp.clip(jnp.sqrt(state.weight * travelled), state.weight / _MOST_CHANGE, state.weight * _MOST_CHANGE)
    weight = jnp.where(jnp.isfinite(weight), jnp.clip(weight, *_WEIGHTS), state.weight)
    return state.replace(
        t=new.x - weight * new.multiplier,
        v=new.u - weight * new.w,
        weight=weight,
        moved=jnp.abs(new.w - old.w).sum(axis=0),
        iterations=state.iterations + STEPS_PER_WEIGHT,
    )


def _iterate(splitting: Splitting, goal: Goal, state: State) -> State:
    now = point(splitting, goal, state)
    y, m = splitting.multipliers(jnp.abs(state.t), 2.0 * now.u - state.v)
    kept = jnp.maximum(state.t, 0.0) + (RELAXATION - 1.0) * jnp.maximum(-state.t, 0.0)
    t = splitting.allowed(kept - RELAXATION * jnp.stack(splitting.rows(y, m), axis=1))
    # u' - u with u' = 2 u - v + m.
    return state.replace(t=t, v=state.v + RELAXATION * (now.u - state.v + m), value=y / state.weight)


def _length(first: Float[Array, "S A lanes"], second: Float[Array, "K lanes"]) -> Float[Array, " lanes"]:
    return jnp.sqrt((first * first).sum(axis=(0, 1)) + (second * second).sum(axis=0))


def reading(
    splitting: Splitting, goal: Goal, state: State
) -> tuple[Float[Array, "S A lanes"], Float[Array, "K lanes"], Float[Array, "S lanes"]]:
    """What a state says: x >= 0, which is on the flow up to what is cut off, the weights w, and values for them."""
    w = point(splitting, goal, state).w
    return jnp.maximum(state.x, 0.0), w if splitting.share is None else w * splitting.share[:, None], state.value


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
