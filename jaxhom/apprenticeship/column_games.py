"""The games over the columns of LPAL: some at a time, padded to a common number of columns.

Each is a zero-sum matrix game with a row per feature and a column V(pi) - Vhat per policy
(`jaxhom.solvers.game_interior_point`); games that are large on both sides go to PDHG (`jaxhom.solvers.game_pdhg`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom.programs import host_jit
from jaxhom.solvers import pdhg
from jaxhom.solvers.game_interior_point import GameSolution, solve_game
from jaxhom.solvers.game_pdhg import MatrixGame

if TYPE_CHECKING:
    from jaxtyping import ArrayLike, Float

_FIRST_CAPACITY = 32  # columns that every program has room for, so that small games share one
_MAX_NEWTON_SIZE = 256  # strategies of the player who has fewer; the normal matrix of a step is that large
_PDHG_ITERATIONS = 4096  # an inexact game still gives valid weights


def capacities(num_features: int) -> list[int]:
    """Numbers of columns that games are padded to, ascending: few, so that few programs are compiled.

    An optimal mixture needs no more columns than there are features; the last has room for four times as many.
    """
    enough = 1 << (num_features - 1).bit_length()
    return sorted({max(_FIRST_CAPACITY, times * enough) for times in (0, 2, 4)})


def play(
    payoffs: Sequence[Float[np.ndarray, "K m"]],
    former: Sequence[tuple[Float[ArrayLike, "*K"], Float[np.ndarray, " m"]]],
    bounds: Sequence[float],
    tolerance: Float[ArrayLike, "*games"],
    share: float,
    width: int,
    *,
    on_host: bool = False,
) -> GameSolution:
    """Solves games, loosely where much is open.

    Args:
      payoffs: one [K, m] per game, m at most the largest of `capacities`; it may differ between games.
      former: (w [K], q [m]) per game, where to begin; zeros for nowhere.
      bounds: bounds on the values of the games over all policies.
      tolerance, share: a game is solved when its own gap is below its tolerance (one for all, or one per game), or
        below this share of what is open between its lower bound and `bounds`.
      width: games that are solved at a time, at least as many as there are: it decides which programs are compiled.
      on_host: one by one in NumPy; not where a normal matrix would be large.

    Returns:
      The solutions, in NumPy arrays with the games first; q is padded with zeros.
    """
    num_features = len(payoffs[0])
    most = max(payoff.shape[1] for payoff in payoffs)
    capacity = next(capacity for capacity in capacities(num_features) if most <= capacity)
    is_newton = min(num_features, capacity) <= _MAX_NEWTON_SIZE
    if on_host and is_newton:
        goals = np.broadcast_to(tolerance, len(payoffs))
        games = zip(payoffs, former, bounds, goals, strict=True)
        return _stacked([_play_on_host(*game, share) for game in games], capacity)
    dtype = payoffs[0].dtype
    stacked = np.zeros((width, num_features, capacity), dtype)
    start = np.zeros((width, num_features), dtype), np.zeros((width, capacity), dtype)
    is_column, bound = np.ones((width, capacity), bool), np.full(width, np.inf, dtype)
    for k, (payoff, (w, q)) in enumerate(zip(payoffs, former, strict=True)):
        count = payoff.shape[1]
        stacked[k, :, :count], is_column[k] = payoff, np.arange(capacity) < count
        start[0][k], start[1][k, :count], bound[k] = w, q, bounds[k]
    goal = np.ones(width, dtype)
    goal[: len(payoffs)] = tolerance
    solve = _by_interior_point if is_newton else _by_pdhg
    return jax.tree.map(np.asarray, solve(stacked, is_column, bound, start, goal, share))


def prepare(num_features: int, width: int, dtype: np.dtype) -> None:
    """Compiles the first program of `play`: a game without anything to win."""
    play([np.zeros((num_features, 1), dtype)], [(0.0, np.zeros(1))], [0.0], 1.0, 0.0, width)


def _play_on_host(payoff, former, bound, tolerance, share) -> GameSolution:
    everything = np.ones(payoff.shape[1], bool)
    return solve_game(payoff, everything, tolerance=tolerance, share=share, bound=bound, start=former)


def _stacked(games: list[GameSolution], capacity: int) -> GameSolution:
    """Solutions of games with different numbers of columns, as `play` returns them."""
    games = [game.replace(q=np.pad(game.q, (0, capacity - len(game.q)))) for game in games]
    return jax.tree.map(lambda *leaves: np.stack(leaves), *games)


@host_jit
def _by_interior_point(payoff, is_column, bound, start, tolerance, share) -> GameSolution:
    def solve(payoff, is_column, bound, start, tolerance):
        return solve_game(payoff, is_column, tolerance=tolerance, share=share, bound=bound, start=start)

    return jax.vmap(solve)(payoff, is_column, bound, start, tolerance)


@host_jit
def _by_pdhg(payoff, is_column, bound, start, tolerance, share) -> GameSolution:
    """For many strategies on both sides."""
    del bound, share
    scale = jnp.maximum(jnp.abs(payoff).max(axis=(1, 2)), jnp.finfo(payoff.dtype).tiny)
    game = MatrixGame(payoff=payoff / scale[:, None, None], is_column=is_column.T)
    is_warm = start[0].sum(axis=1) > 0
    start = tuple(jnp.where(is_warm, old.T, new) for old, new in zip(start, game.start(), strict=True))
    state = pdhg.init(game, start)
    state = pdhg.solve(game, state, tolerance=tolerance / scale, max_iterations=_PDHG_ITERATIONS)
    return GameSolution(
        w=state.best_primal.T,
        q=state.best_dual.T,
        lower=state.lower * scale,
        upper=state.upper * scale,
        steps=state.steps,
    )
