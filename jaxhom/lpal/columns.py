"""LPAL on columns: the zero-sum game between features and the policies met so far.

v* is the value of a game with one row per feature and one column V(pi) - Vhat per policy. Only the columns that
matter are made: solve the game over the present ones for row weights w and column probabilities q, add the best
response to w, and repeat. The mixture sum_j q_j x_j of occupancies is the occupancy of a policy, so the game's lower
bound is that policy's margin; planning for any w gives the upper bound.

With many features the weights of a game over few columns jump about. Asking for the response to weights between them
and those of the best bound so far (in-out separation, Ben-Ameur and Neto 2007) then needs far fewer columns.
"""

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from jaxhom.lpal.certificate import LPALSolution, better_bound, bound_by_planning, certify
from jaxhom.mdp import MDP
from jaxhom.occupancy import occupancy
from jaxhom.pdhg import Status, engine
from jaxhom.pdhg.matrix_game import MatrixGame

_FIRST_CAPACITY = 8
_GROWTH = 2
_STABILISED_FEATURES = 8  # up to here the weights do not jump
_STABILISATION = 0.3  # share of the best bound's weights in a query
_LOOSE_PLANNING = 0.1  # share of an open gap that planning may add to the bound
_GAME_ITERATIONS = 4096  # per column: an inexact game still gives valid weights


def solve_by_columns(
    mdp: MDP,
    expectations: jax.Array,
    initial_policy: jax.Array | None,
    tolerance: float,
    *,
    max_iterations: int = 500,
    progress: bool = False,
) -> LPALSolution:
    """`lpal` on a batch: expectations [B, K], initial_policy [B, S, A] or None."""
    lanes, num_features = expectations.shape
    weights = jnp.full((lanes, num_features), 1.0 / num_features, mdp.dtype)
    value = jnp.zeros((lanes, mdp.num_states), mdp.dtype)
    pull = _STABILISATION if num_features > _STABILISED_FEATURES else 0.0
    accuracy = jnp.full(lanes, tolerance, mdp.dtype)
    bound, value, x, column = _respond(mdp, expectations, weights, value, accuracy)
    columns = _Columns(expectations)
    columns.add(x, column)
    if initial_policy is not None:
        columns.add(*_column_of(mdp, initial_policy, expectations))
    game = columns.play(None, tolerance)
    with tqdm(disable=not progress, desc="LPAL", unit="column") as bar:
        while True:
            gap = np.asarray(bound.margin_bound - game.lower)
            bar.set_postfix(gap=f"{gap.max():.2e}")
            bar.update()
            if (gap <= tolerance).all() or columns.count >= max_iterations:
                break
            query = pull * bound.weights + (1.0 - pull) * game.best_primal.T
            accuracy = jnp.asarray(np.maximum(_LOOSE_PLANNING * gap, tolerance), mdp.dtype)
            new_bound, value, x, column = _respond(mdp, expectations, query, value, accuracy)
            bound = better_bound(bound, new_bound)
            columns.add(x, column)
            gap = np.asarray(bound.margin_bound - game.lower)
            game = columns.play(game, np.maximum(0.1 * gap, 0.25 * tolerance))
    x = columns.mix(game.best_dual)
    # The game takes its gap for closed, the certificate knows better: float32 has nothing more to give.
    is_closed = bool((gap <= tolerance).all())
    stopped = Status.STALLED if is_closed else Status.ITERATION_LIMIT
    return certify(mdp, expectations, x, bound, tolerance, columns.count, stopped=stopped)


class _Columns:
    """The policies met so far: occupancies, and a payoff array that grows by factors, so that few shapes occur."""

    def __init__(self, expectations: jax.Array):
        lanes, num_features = expectations.shape
        self.count = 0
        self._occupancies: list[jax.Array] = []
        self._payoff = np.zeros((lanes, num_features, _FIRST_CAPACITY), expectations.dtype)

    def add(self, x: jax.Array, column: jax.Array) -> None:
        """Adds one policy per lane: occupancy [B, S, A] and V(pi) - Vhat [B, K]."""
        if self.count == self._payoff.shape[2]:
            room = np.zeros_like(self._payoff)
            self._payoff = np.concatenate([self._payoff] + [room] * (_GROWTH - 1), axis=2)
        self._payoff[:, :, self.count] = np.asarray(column)
        self._occupancies.append(x)
        self.count += 1

    def play(self, former: engine.PDHGState | None, tolerance) -> engine.PDHGState:
        """Solves the game to the tolerance (scalar or [B]), started from the former strategies."""
        lanes, _, capacity = self._payoff.shape
        is_column = np.broadcast_to((np.arange(capacity) < self.count)[:, None], (capacity, lanes))
        if former is None:
            start = None
        else:
            q = np.zeros((capacity, lanes), self._payoff.dtype)
            q[: len(former.best_dual)] = former.best_dual
            start = (former.best_primal, q)
        tolerance = jnp.broadcast_to(jnp.asarray(tolerance, self._payoff.dtype), (lanes,))
        return _play(self._payoff, is_column, start, tolerance)

    def mix(self, q: jax.Array) -> jax.Array:
        """The occupancy sum_j q_j x_j, [B, S, A], of probabilities q [m, B]."""
        total = jnp.zeros_like(self._occupancies[0])
        for probability, x in zip(np.asarray(q), self._occupancies, strict=False):
            if probability.any():
                total += probability[:, None, None] * x
        return total


@jax.jit
def _play(payoff, is_column, start, tolerance) -> engine.PDHGState:
    """Payoffs are scaled to at most 1 per lane inside, and the bounds back."""
    scale = jnp.maximum(jnp.abs(payoff).max(axis=(1, 2)), jnp.finfo(payoff.dtype).tiny)
    game = MatrixGame(payoff=payoff / scale[:, None, None], is_column=is_column)
    state = engine.init(game, start)
    state = engine.solve(game, state, tolerance=tolerance / scale, max_iterations=_GAME_ITERATIONS)
    return state.replace(lower=state.lower * scale, upper=state.upper * scale)


@jax.jit
def _respond(mdp, expectations, weights, value, tolerance):
    """The best response to weights [B, K]: its bound, value function, occupancy and column."""
    bound, plan = bound_by_planning(mdp, expectations, weights, value, tolerance)
    return bound, plan.value, *_column_of(mdp, plan.policy, expectations)


@jax.jit
def _column_of(mdp, policy, expectations):
    """Occupancy [B, S, A] and column V(pi) - Vhat [B, K] of a policy [B, S, A]."""
    x = occupancy(mdp, policy)
    return x, jnp.einsum("bsa,sak->bk", x, mdp.features) - expectations
