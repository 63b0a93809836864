"""LPAL on columns: the zero-sum game between features and the policies met so far.

v* is the value of a game with one row per feature and one column V(pi) - Vhat per policy. Only the columns that
matter are made: solve the game over the present ones for row weights w and column probabilities q, add the best
response to w, and repeat. The mixture sum_j q_j x_j of occupancies is the occupancy of a policy, so the game's lower
bound is that policy's margin; planning for any w gives the upper bound.

What decides how many columns it takes is w. At a vertex of the game's solutions it jumps from round to round. Two
things keep it in the middle: the games are solved by an interior-point method that stops while the game's own gap is
half of the open one, and the response is asked for between these weights and those of the best bound so far (in-out
separation, Ben-Ameur and Neto 2007). Games too large for that are played by PDHG.

Many expectations share the model: some lanes are under way at a time in each of a few threads, and a lane that is
done makes room for one that waits.
"""

import dataclasses
import itertools
import os
import threading
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from jaxhom.game_interior_point import GameSolution, solve_game
from jaxhom.lpal.certificate import LPALSolution, UpperBound, bound_by_planning, certify
from jaxhom.lpal.policy_pool import PolicyPool
from jaxhom.mdp import MDP
from jaxhom.occupancy import rough_state_occupancy
from jaxhom.pdhg import Status, engine
from jaxhom.pdhg.matrix_game import MatrixGame

_FIRST_CAPACITY = 32
_MAX_NEWTON_SIZE = 256  # strategies of the player who has fewer; the normal matrix of a step is that large
_PDHG_ITERATIONS = 4096  # per column: an inexact game still gives valid weights
_LOOSE_GAME = 0.5  # share of the open gap that the game may leave
_STABILISATION = 0.3  # share of the best bound's weights in a query
_LOOSE_PLANNING = 0.1  # share of the open gap that planning may add to the bound
_SLACK = 0.02  # share of the tolerance that is left to columns that are not quite exact
_PATIENCE = 20  # rounds without any progress, after which rounding has won
_YOUNG = 8  # newest columns, never dropped
_MAX_REPLAYS = 4  # games per round
_PER_REPLAY = 4  # policies taken from the pool at a time
_WORTHWHILE = 0.1  # share of the open gap by which they have to be better
_NARROW_STATES = 1024  # models up to this size are solved in wider batches
_LANES, _NARROW_LANES = 8, 32


def solve_by_columns(
    mdp: MDP,
    expectations: jax.Array,
    initial_policy: jax.Array | None,
    tolerance: float,
    *,
    initial_weights: jax.Array | None = None,
    max_iterations: int = 500,
    progress: bool = False,
) -> LPALSolution:
    """`lpal` on a batch: expectations [B, K], initial_policy [B, S, A] or None, initial_weights [B, K] or None."""
    total = len(expectations)
    workers = min(_num_workers(), total)
    width = min(-(-total // workers), _NARROW_LANES if mdp.num_states <= _NARROW_STATES else _LANES)
    with tqdm(disable=not progress, desc="LPAL", unit="column") as bar:
        queue = _Queue(mdp, expectations, initial_policy, initial_weights, bar)
        compact = _with_compact_features(mdp)
        _in_threads(workers, lambda _: _drain(queue, compact, width, tolerance, max_iterations), range(workers))

    def finish(first: int) -> LPALSolution:
        members = np.minimum(np.arange(first, first + width), total - 1)  # as many each time: one program
        lanes = [queue.done[number] for number in members]
        bound = UpperBound(
            margin_bound=jnp.asarray([lane.bound for lane in lanes], mdp.dtype),
            weights=jnp.asarray([lane.weights for lane in lanes], mdp.dtype),
            policy=queue.pool.one_hot(np.stack([lane.actions for lane in lanes])),
        )
        x = np.stack([queue.pool.mixture(*lane.mixture) for lane in lanes])
        counts, stopped = (np.array([getattr(lane, name) for lane in lanes]) for name in ("made", "stopped"))
        return certify(mdp, expectations[members], x, bound, tolerance, counts, stopped=stopped)

    parts = _in_threads(workers, finish, range(0, total, width))
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[:total], *parts)


def _num_workers() -> int:
    """Batches under way at a time: one per core of a CPU, because XLA runs small programs on one core each."""
    if jax.default_backend() != "cpu":
        return 1
    return min(8, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)


def _in_threads(workers: int, function, items) -> list:
    """Results of `function` on every item; an exception in one thread reaches the caller."""
    if workers == 1:
        return [function(item) for item in items]
    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(function, items))


def _with_compact_features(mdp: MDP) -> MDP:
    """The model with features [S, 1, K] where they do not depend on the action: a quarter of the numbers, with four."""
    features = np.asarray(mdp.features)
    depends = (features != features[:, :1]).any()
    return mdp if depends else mdp.replace(features=jnp.asarray(features[:, :1]))


@dataclasses.dataclass(eq=False)
class _Lane:
    """One problem under way.

    Attributes:
      number: its place in the batch. expectations: [K].
      query: [K], weights to ask a response for. value: [S], the optimal values of the last ones.
      bound, weights, actions: the best bound so far, the weights that prove it, and their optimal actions [S].
      columns: numbers of policies of the pool. probabilities, row_probabilities: q and w of the last game, 0 where a
        column is new. made: policies added by this lane.
      lower, mixture: the best lower bound so far, and the policies and probabilities that prove it.
      idle: rounds without progress. stopped: the status, should the gap stay open.
    """

    number: int
    expectations: np.ndarray
    query: np.ndarray
    value: np.ndarray
    bound: float = np.inf
    weights: np.ndarray | None = None
    actions: np.ndarray | None = None
    columns: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, int))
    probabilities: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0))
    row_probabilities: np.ndarray | float = 0.0
    made: int = 0
    lower: float = -np.inf
    mixture: tuple[np.ndarray, np.ndarray] | None = None
    idle: int = 0
    stopped: int = Status.STALLED

    @property
    def gap(self) -> float:
        """What is left between the bounds."""
        return self.bound - self.lower

    def add(self, *numbers: int) -> None:
        """New columns."""
        self.columns = np.append(self.columns, np.asarray(numbers, int))
        self.probabilities = np.append(self.probabilities, np.zeros(len(numbers)))

    def keep(self, count: int) -> None:
        """Leaves to the pool all but the newest columns and those that the last game used most."""
        rank = self.probabilities.copy()
        rank[-_YOUNG:] = np.inf
        kept = np.sort(np.argsort(-rank, kind="stable")[:count])
        self.columns, self.probabilities = self.columns[kept], self.probabilities[kept]


class _Queue:
    """The problems that wait and those that are done; used by several threads."""

    def __init__(self, mdp: MDP, expectations, initial_policy, initial_weights, bar):
        self.mdp, self.expectations, self.pool = mdp, np.asarray(expectations), PolicyPool(mdp)
        self.policies = None if initial_policy is None else np.asarray(initial_policy)
        self.weights = None if initial_weights is None else np.asarray(initial_weights)
        self.done: dict[int, _Lane] = {}
        self.is_closed = False
        self._waiting = iter(range(len(self.expectations)))
        self._lock, self._bar = threading.Lock(), bar

    def take(self, count: int) -> list[_Lane]:
        """At most `count` problems that nobody has taken yet."""
        with self._lock:
            numbers = [] if self.is_closed else list(itertools.islice(self._waiting, count))
        return [self._start(number) for number in numbers]

    def store(self, lane: _Lane) -> None:
        """Takes a lane that is done."""
        lane.value = lane.value[:0]
        with self._lock:
            self.done[lane.number] = lane

    def report(self, lanes: list[_Lane]) -> None:
        """Columns that have just been made."""
        with self._lock:
            self._bar.set_postfix(gap=f"{max(lane.gap for lane in lanes):.2e}", done=len(self.done), refresh=False)
            self._bar.update(len(lanes))

    def _start(self, number: int) -> _Lane:
        expectations = self.expectations[number]
        uniform = np.full_like(expectations, 1.0 / len(expectations))
        query = uniform if self.weights is None else self.weights[number]
        lane = _Lane(number, expectations, query, np.zeros(self.mdp.num_states, expectations.dtype))
        if self.policies is not None:
            policy = self.policies[number]
            lane.add(self.pool.add(policy=policy, **jax.tree.map(np.asarray, _evaluate(self.mdp, policy))))
        return lane


def _drain(queue: _Queue, mdp: MDP, width: int, tolerance: float, max_iterations: int) -> None:
    """Solves problems of the queue, `width` at a time, until none is left."""
    lanes: list[_Lane] = []
    try:
        while lanes := lanes + queue.take(width - len(lanes)):
            _respond_to(lanes, mdp, queue.pool, width, tolerance)
            _play_games(lanes, queue.pool, width, tolerance)
            queue.report(lanes)
            for lane in lanes:
                if lane.made >= max_iterations:
                    lane.stopped = Status.ITERATION_LIMIT
                if lane.gap <= (1.0 - _SLACK) * tolerance or lane.made >= max_iterations or lane.idle >= _PATIENCE:
                    queue.store(lane)
            lanes = [lane for lane in lanes if lane.number not in queue.done]
    except BaseException:
        queue.is_closed = True
        raise


def _respond_to(lanes: list[_Lane], mdp: MDP, pool: PolicyPool, width: int, tolerance: float) -> None:
    """The best response of every lane to its query: a column, and a bound."""
    # Lanes that do not exist repeat the first; asked for nothing, they stop at once.
    members = lanes + [lanes[0]] * (width - len(lanes))
    accuracy = np.full(width, np.inf)
    for k, lane in enumerate(lanes):
        accuracy[k] = max(_LOOSE_PLANNING * lane.gap, tolerance) if np.isfinite(lane.gap) else tolerance
    stacked = (np.stack([getattr(lane, name) for lane in members]) for name in ("expectations", "query", "value"))
    answer = _respond(mdp, *stacked, accuracy, 0.25 * _SLACK * tolerance)
    weights, value, bound, actions, mu, expected = map(np.asarray, answer)
    for k, lane in enumerate(lanes):
        lane.value = value[k]
        lane.add(pool.add(mu[:, k], actions[k], expected[k]))
        lane.made += 1
        lane.idle += 1
        if bound[k] < lane.bound:
            lane.bound, lane.weights, lane.actions, lane.idle = bound[k], weights[k], actions[k], 0


def _play_games(lanes: list[_Lane], pool: PolicyPool, width: int, tolerance: float) -> None:
    """The game over every lane's columns: a lower bound, its mixture, and the next query.

    Policies that other lanes have met join where they are better than what the game has; then it is played again.
    """
    open_lanes = lanes
    for _ in range(_MAX_REPLAYS):
        _play_once(open_lanes, pool, width, tolerance)
        open_lanes = [lane for lane in lanes if _take_from_pool(lane, pool)]
        if not open_lanes:
            break
    else:
        _play_once(open_lanes, pool, width, tolerance)


def _take_from_pool(lane: _Lane, pool: PolicyPool) -> bool:
    """Adds the policies that are worth most at the query; False if none is worth much more than the lane's own."""
    worth = (pool.expected - lane.expectations) @ lane.query
    limit = worth[lane.columns].max() + _WORTHWHILE * max(lane.gap, 0.0)
    best = np.argsort(worth)[-_PER_REPLAY:]
    best = best[worth[best] > limit]
    lane.add(*best)
    return best.size > 0


def _play_once(lanes: list[_Lane], pool: PolicyPool, width: int, tolerance: float) -> None:
    capacity = _capacity(lanes)
    num_features = len(lanes[0].expectations)
    payoff = np.zeros((width, num_features, capacity), lanes[0].expectations.dtype)
    is_column = np.ones((width, capacity), bool)
    bound = np.full(width, np.inf)
    former = np.zeros((width, num_features)), np.zeros((width, capacity))
    for k, lane in enumerate(lanes):
        count = len(lane.columns)
        payoff[k, :, :count] = (pool.expected[lane.columns] - lane.expectations).T
        is_column[k] = np.arange(capacity) < count
        bound[k] = lane.bound
        former[0][k], former[1][k, :count] = lane.row_probabilities, lane.probabilities
    play = _play if min(num_features, capacity) <= _MAX_NEWTON_SIZE else _play_by_pdhg
    games = jax.tree.map(np.asarray, play(payoff, is_column, bound, former, 0.25 * tolerance))
    for k, lane in enumerate(lanes):
        lane.probabilities = games.q[k, : len(lane.columns)]
        if games.lower[k] > lane.lower:
            lane.lower, lane.mixture, lane.idle = games.lower[k], (lane.columns, lane.probabilities), 0
        lane.row_probabilities = games.w[k]
        lane.query = _STABILISATION * lane.weights + (1.0 - _STABILISATION) * games.w[k]


def _capacity(lanes: list[_Lane]) -> int:
    """Room for columns: one of two sizes, so that few programs are compiled.

    An optimal mixture needs no more columns than there are features. A lane with more than twice as many leaves the
    less useful ones to the pool.
    """
    num_features = len(lanes[0].expectations)
    largest = max(_FIRST_CAPACITY, 1 << (2 * num_features - 1).bit_length())
    for lane in lanes:
        if len(lane.columns) > largest:
            lane.keep(max(largest // 2, num_features + _YOUNG))
    return _FIRST_CAPACITY if all(len(lane.columns) <= _FIRST_CAPACITY for lane in lanes) else largest


@jax.jit
def _play(payoff, is_column, bound, former, tolerance) -> GameSolution:
    """Solves games [L, K, C], from former strategies [L, K] and [L, C]; bounds [L] are on the values of the games over
    all policies."""

    def solve(payoff, is_column, bound, former):
        options = {"tolerance": tolerance, "share": _LOOSE_GAME, "bound": bound, "start": former}
        return solve_game(payoff, is_column, **options)

    former = jax.tree.map(lambda array: jnp.asarray(array, payoff.dtype), former)
    return jax.vmap(solve)(payoff, is_column, jnp.asarray(bound, payoff.dtype), former)


@jax.jit
def _play_by_pdhg(payoff, is_column, bound, former, tolerance) -> GameSolution:
    """`_play` for many strategies on both sides."""
    scale = jnp.maximum(jnp.abs(payoff).max(axis=(1, 2)), jnp.finfo(payoff.dtype).tiny)
    game = MatrixGame(payoff=payoff / scale[:, None, None], is_column=is_column.T)
    del bound
    is_warm = former[0].sum(axis=1) > 0
    start = (jnp.where(is_warm, old.T, new) for old, new in zip(former, game.start(), strict=True))
    state = engine.init(game, tuple(array.astype(payoff.dtype) for array in start))
    state = engine.solve(game, state, tolerance=tolerance / scale, max_iterations=_PDHG_ITERATIONS)
    return GameSolution(
        w=state.best_primal.T,
        q=state.best_dual.T,
        lower=state.lower * scale,
        upper=state.upper * scale,
        steps=state.steps,
    )


@jax.jit
def _respond(mdp, expectations, weights, value, accuracy, error):
    """The best responses to weights [L, K], and their bounds.

    `accuracy` [L] is a gap that planning may be a tenth of, `error` what an expected feature may be off by.
    """
    bound, plan = bound_by_planning(mdp, expectations, weights, value, accuracy)
    mu, expected = _expected_features(mdp, plan.policy, jnp.where(jnp.isfinite(accuracy), error, jnp.inf))
    return bound.weights, plan.value, bound.margin_bound, plan.policy.argmax(axis=-1), mu, expected


@jax.jit
def _evaluate(mdp, policy):
    """State occupancy [S] and feature expectations [K] of a policy [S, A]."""
    mu, expected = _expected_features(mdp, policy[None], 0.0)
    return {"occupancy": mu[:, 0], "expected": expected[0]}


def _expected_features(mdp, policy, error):
    """State occupancies [S, L] and feature expectations [L, K] of policies [L, S, A], up to `error` [L]."""
    largest = jnp.abs(mdp.features).max()
    residual = error * (1.0 - mdp.discount) / (jnp.sqrt(mdp.num_states) * jnp.where(largest > 0, largest, 1.0))
    mu = rough_state_occupancy(mdp, jnp.moveaxis(policy, 0, -1), residual)
    if mdp.features.shape[1] == 1:
        return mu, mu.T @ mdp.features[:, 0]
    return mu, jnp.einsum("sl,lsa,sak->lk", mu, policy, mdp.features)
