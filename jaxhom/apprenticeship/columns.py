"""LPAL on columns: the zero-sum game between features and the policies met so far.

v* is the value of a game with one row per feature and one column V(pi) - Vhat per policy. Only the columns that
matter are made: solve the game over the present ones for row weights w and column probabilities q, add the best
response to w, and repeat. The mixture sum_j q_j x_j of occupancies is the occupancy of a policy, so the game's lower
bound is that policy's margin; planning for any w gives the upper bound.

What decides how many columns it takes is w. At a vertex of the game's solutions it jumps from round to round. Two
things keep it in the middle: the games are solved by an interior-point method that stops while the game's own gap is
half of the open one, and the response is asked for between these weights and those of the best bound so far (in-out
separation, Ben-Ameur and Neto 2007).

Many expectations share the model, and so the policies: what one lane has met, any other may use. The work of a round
is spread over the cores; a few lanes are under way at a time, so that later ones find many policies made. Rounds are
in step, so that the answer does not depend on which thread is first.
"""

import dataclasses
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from jaxhom.apprenticeship.certificate import NEAR_ONE, Found, LPALSolution
from jaxhom.apprenticeship.column_games import capacities, play
from jaxhom.apprenticeship.exact import Exact
from jaxhom.apprenticeship.policy_pool import PolicyPool
from jaxhom.apprenticeship.responses import evaluate, evaluate_on_host, respond, respond_on_host, with_compact_features
from jaxhom.models.mdp import MDP, uniform_policy
from jaxhom.planning.chain_solver import is_solved_by_lu
from jaxhom.planning.occupancy import policy_from_occupancy
from jaxhom.solvers.lane_queue import num_cores
from jaxhom.status import Status

DEFAULT_COLUMNS = 500
_PULLS = (0.3, 0.7)  # shares of the best bound's weights in a query; the second where a core would be idle
_FEW_FEATURES, _FEW_PULLS = 8, (0.0, 0.5)  # up to here the weights do not jump
_LOOSE_GAME = 0.5  # share of the open gap that the game may leave
_LOOSE_PLANNING = 0.1  # share of the open gap that planning may add to the bound
_SLACK = 0.02  # share of the tolerance that is left to columns that are not quite exact
_NO_OCCUPANCY = 1e-14  # share of all time that counts as none: mixtures are exact, and many rare states add up
_PATIENCE = 40  # rounds without any progress, after which rounding has won
_ROUNDS, _SOME_ROUNDS = 6, 3  # a lane whose bound has not moved by then is at rest if its gap has not for so many
_MANY_ROUNDS, _MORE_ROUNDS = 12, 5  # likewise, wherever the bound is
_LITTLE = 0.9  # a gap that is still larger than this share has not moved
_NEARLY = 30.0  # tolerances within which columns close the gap by themselves
_YOUNG = 8  # newest columns, never dropped
_FROM_POOL = 8  # policies of other lanes that join a game at a time
_WORTHWHILE = 0.1  # share of the open gap by which they have to be better
_LANES_AT_A_TIME = 4  # per core
_NUMBERS_AT_A_TIME = 1024  # states times lanes of one program: small models are solved in wider batches
_MAX_WIDTH = 32
_HELPERS_STEPS = 50  # at most


def solve_by_columns(
    mdp: MDP,
    expectations: np.ndarray,
    initial_policy: np.ndarray | None,
    tolerance: np.ndarray,
    certify: Callable[[Found], LPALSolution],
    *,
    initial_weights: np.ndarray | None = None,
    max_iterations: int | None = None,
    progress: bool = False,
    helper: Callable[[], tuple[Callable, int] | None] | None = None,
    spent: np.ndarray | None = None,
) -> LPALSolution:
    """`lpal` on a batch: expectations [B, K], initial_policy [B, S, A] or None, initial_weights [B, K] or None.

    `helper()`, called once a lane is at rest, is None or (solve, n): another method for every n-th of such lanes, that
    takes expectations [K], a tolerance and `max_iterations` and returns `interior_point.Point`, whose
    policy becomes a column and whose weights the next query. It runs beside the columns of the other lanes. `spent` [B]
    are iterations that count already.
    """
    limit = DEFAULT_COLUMNS if max_iterations is None else max_iterations
    total = len(expectations)
    on_cpu = jax.default_backend() == "cpu"
    # Two programs that both call LAPACK can wait for each other for ever (see `jaxhom.solvers.inverse_factor`).
    workers = num_cores() if on_cpu and not is_solved_by_lu(mdp) else 1
    is_wide = mdp.is_dense or not on_cpu  # dense products read the same large matrix for any number of lanes
    width = _MAX_WIDTH if is_wide else min(max(1, _NUMBERS_AT_A_TIME // mdp.num_states), _MAX_WIDTH)
    width = min(width, -(-total // workers))
    bar = tqdm(disable=not progress, desc="LPAL", unit="column")
    with ThreadPoolExecutor(workers) as threads, _Beside(helper, limit, waits=workers == 1) as beside, bar:
        solver = _Solver(mdp, tolerance, width, workers, threads.map, limit)
        lanes = [
            solver.start(number, given, initial_policy, initial_weights) for number, given in enumerate(expectations)
        ]
        for lane, made in zip(lanes, () if spent is None else spent, strict=False):
            lane.made = int(made)
        waiting, busy = list(reversed(lanes)), []
        while waiting or busy or beside.lanes:
            if not (waiting or busy):
                for lane, point in beside.give_back():
                    busy.append(solver.take_back(lane, point))
                    bar.update()
            while waiting and len(busy) < _LANES_AT_A_TIME * workers * width:
                busy.append(waiting.pop())
            solver.respond_to(busy)
            solver.play_games(busy)
            num_lanes = len(busy) + len(waiting) + len(beside.lanes)
            bar.set_postfix(gap=f"{max(lane.gap for lane in busy):.2e}", lanes=num_lanes, refresh=False)
            bar.update(len(busy))
            busy = [lane for lane in busy if not lane.is_done(limit)]
            busy = beside.take_share_of(busy)
        return certify(solver.found(lanes))


class _Beside:
    """Another method for lanes at rest, in a thread of its own while the other lanes go on with columns.

    Its lanes come back together, when no other lane is left: otherwise the threads' speed would decide which lane
    learns from which. With `waits`, the others stand still meanwhile.
    """

    def __init__(self, helper: Callable | None, limit: int, waits: bool):
        self._helper, self._limit, self._waits, self._thread = helper, limit, waits, ThreadPoolExecutor(1)
        self.lanes, self._num_rested = [], 0

    def __enter__(self) -> "_Beside":
        return self

    def __exit__(self, *_) -> None:
        self._thread.shutdown(wait=False, cancel_futures=True)  # when interrupted, what waits is not begun

    def take_share_of(self, busy: list["_Lane"]) -> list["_Lane"]:
        """Begins with its share of the lanes that have come to rest, and returns the others."""
        at_rest = [lane for lane in busy if lane.is_at_rest()]
        found = self._helper() if self._helper and at_rest else None
        solve, share = found or (None, 1)
        taken = []
        for lane in at_rest:
            lane.has_rested = True
            if solve and self._num_rested % share == 0:
                steps = min(_HELPERS_STEPS, self._limit - lane.made)
                point = self._thread.submit(solve, lane.expectations, lane.tolerance, max_iterations=steps)
                taken.append((lane, point))
                if self._waits:
                    point.result()
            self._num_rested += 1
        self.lanes += taken
        gone = {lane for lane, _ in taken}
        return [lane for lane in busy if lane not in gone]

    def give_back(self) -> Iterator[tuple["_Lane", Any]]:
        """The lanes, and what the method has found for each."""
        lanes, self.lanes = self.lanes, []
        for lane, point in lanes:
            yield lane, point.result()


@dataclasses.dataclass(eq=False)
class _Lane:
    """One problem.

    Attributes:
      expectations: [K]. tolerance: the gap to reach.
      value: [S], the optimal values of the last response.
      weights: [K], those of the best bound so far, or to begin with. bound: that bound. actions: [S], their optimal
        actions. best_value: [S], their optimal values.
      columns: numbers of policies of the pool. row_probabilities, probabilities: w and q of the last game; q is 0
        where a column is new.
      lower, mixture: the best lower bound so far, and the policies and probabilities that prove it.
      guess: [K] or None, the next query instead of a mixture.
      gaps: after each round. made: policies added by this lane. idle: rounds without progress.
      has_moved: the bound is better than that of the first query. has_rested: it was at rest once.
    """

    expectations: np.ndarray
    tolerance: float
    value: np.ndarray
    weights: np.ndarray
    bound: float = np.inf
    actions: np.ndarray | None = None
    best_value: np.ndarray | None = None
    columns: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, int))
    probabilities: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0))
    row_probabilities: np.ndarray | None = None
    lower: float = -np.inf
    mixture: tuple[np.ndarray, np.ndarray] | None = None
    guess: np.ndarray | None = None
    gaps: list[float] = dataclasses.field(default_factory=list)
    made: int = 0
    idle: int = 0
    has_moved: bool = False
    has_rested: bool = False

    @property
    def gap(self) -> float:
        """What is left between the bounds."""
        return self.bound - self.lower

    def is_done(self, max_iterations: int) -> bool:
        """Closed, out of columns, or stuck."""
        return self.gap <= (1.0 - _SLACK) * self.tolerance or self.made >= max_iterations or self.idle >= _PATIENCE

    def is_at_rest(self) -> bool:
        """Whether columns will have to be many: the gap stays open, and the first weights are still the best."""
        rounds, back = (_MANY_ROUNDS, _MORE_ROUNDS) if self.has_moved else (_ROUNDS, _SOME_ROUNDS)
        if self.has_rested or len(self.gaps) < rounds:
            return False
        return self.gap > max(_NEARLY * self.tolerance, _LITTLE * self.gaps[-1 - back])

    def query(self, pull: float) -> np.ndarray:
        """Weights [K] between those of the best bound and those of the last game."""
        if self.guess is not None:
            return self.guess
        if self.row_probabilities is None:
            return self.weights
        return pull * self.weights + (1.0 - pull) * self.row_probabilities

    def add(self, numbers, room: int) -> None:
        """New columns. If there is no room, the pool gets back those that the last game used least."""
        self.columns = np.append(self.columns, np.asarray(numbers, int))
        self.probabilities = np.append(self.probabilities, np.zeros(len(numbers)))
        if len(self.columns) > room:
            rank = self.probabilities.copy()
            rank[-_YOUNG:] = np.inf
            kept = np.sort(np.argsort(-rank, kind="stable")[: 3 * room // 4])
            self.columns, self.probabilities = self.columns[kept], self.probabilities[kept]


class _Solver:
    """What all lanes share.

    Args:
      mdp: the model.
      tolerance: [B], the gaps to reach.
      width: lanes of one program.
      workers: programs at a time, run by `run`: a `map` over threads.
      limit: columns of a lane.
    """

    def __init__(self, mdp: MDP, tolerance: np.ndarray, width: int, workers: int, run: Callable, limit: int):
        self.mdp, self.pool = with_compact_features(mdp), PolicyPool(mdp)
        self.tolerance, self.width, self.workers, self.run, self.limit = tolerance, width, workers, run, limit
        self.room = capacities(mdp.num_features)[-1]
        self.pulls = _FEW_PULLS if mdp.num_features <= _FEW_FEATURES else _PULLS
        self.error = 0.25 * _SLACK * float(tolerance.min())
        # Where the model's type, or iterations, have no digits left near this discount.
        is_rough = mdp.dtype != jnp.float64 or float(mdp.discount) > NEAR_ONE
        exact = Exact(mdp) if is_rough else None
        self.exact = exact if exact and exact.is_direct else None

    def start(self, number: int, expectations: np.ndarray, policies, weights) -> _Lane:
        """The lane of one problem; with a first column if there is a policy to begin with."""
        uniform = np.full(len(expectations), 1.0 / len(expectations))
        value = np.zeros(self.mdp.num_states)
        weights = uniform if weights is None else weights[number]
        lane = _Lane(expectations, float(self.tolerance[number]), value, weights)
        if policies is not None:
            self._add_policy(lane, policies[number])
        return lane

    def _add_policy(self, lane: _Lane, policy: np.ndarray) -> None:
        """A column of a policy [S, A]."""
        evaluated = (
            evaluate(self.mdp, policy) if self.exact is None else evaluate_on_host(self.exact, policy, self.error)
        )
        mu, expected = map(np.asarray, evaluated)
        if np.isfinite(expected).all():
            lane.add([self.pool.add(mu, np.asarray(policy), expected)], self.room)

    def respond_to(self, lanes: list[_Lane]) -> None:
        """Best responses of every lane to its query: columns, and bounds."""
        per_lane = max(1, min(len(self.pulls), self.workers // len(lanes)))
        is_first = lanes[0].row_probabilities is None
        pulls = self.pulls[: 1 if is_first else per_lane]
        asked = [
            (lane, pull)
            for number, pull in enumerate(pulls)
            for lane in lanes
            if number == 0 or (lane.guess is None and lane.made + number < self.limit)
        ]
        for lane in lanes:
            lane.idle += 1
        chunks = self._chunks(asked)
        for chunk, answers in zip(chunks, self.run(self._respond, chunks), strict=True):
            for k, (lane, _) in enumerate(chunk):
                self._take(lane, {name: array[k] for name, array in answers.items()})

    def take_back(self, lane: _Lane, point) -> _Lane:
        """The lane, with what another method has found: its policy as a column, its weights as the next query."""
        best = uniform_policy(self.mdp) if lane.actions is None else self.pool.one_hot(lane.actions)
        self._add_policy(lane, policy_from_occupancy(self.mdp, point.x, np.asarray(best)))
        lane.guess, lane.value, lane.made = point.weights, point.value, lane.made + point.steps
        return lane

    def _chunks(self, items: list) -> list[list]:
        return [items[first : first + self.width] for first in range(0, len(items), self.width)]

    def _respond(self, asked) -> dict[str, np.ndarray]:
        goals = [lane.tolerance for lane, _ in asked]
        open_ = [lane.gap if np.isfinite(lane.gap) else 0.0 for lane, _ in asked]
        accuracy = np.maximum(goals, _LOOSE_PLANNING * np.array(open_))
        if self.exact is not None:
            parts = [
                respond_on_host(self.exact, lane.expectations, lane.query(pull), lane.value, goal, self.error)
                for (lane, pull), goal in zip(asked, accuracy, strict=True)
            ]
            return jax.tree.map(lambda *leaves: np.stack(leaves), *parts)
        # Lanes that do not exist repeat the first; asked for nothing, they stop at once.
        padded = asked + [asked[0]] * (self.width - len(asked))
        accuracy = np.append(accuracy, np.full(len(padded) - len(asked), np.inf))
        given = ([lane.expectations for lane, _ in padded], [lane.query(pull) for lane, pull in padded])
        arrays = (*given, [lane.value for lane, _ in padded], accuracy)
        arrays = (np.asarray(array, self.mdp.dtype) for array in arrays)
        return jax.tree.map(np.asarray, respond(self.mdp, *arrays, self.error))

    def _take(self, lane: _Lane, answer: dict[str, np.ndarray]) -> None:
        lane.made += 1
        lane.guess = None
        if np.isfinite(answer["expected"]).all():
            number = self.pool.add(answer["occupancy"], answer["actions"], answer["expected"])
            lane.add([number], self.room)
        if np.isfinite(answer["value"]).all():
            lane.value = answer["value"]
        if answer["margin_bound"] < lane.bound:
            gain = lane.bound - answer["margin_bound"]
            lane.has_moved |= bool(_SLACK * lane.tolerance < gain < np.inf)
            lane.bound, lane.weights, lane.actions = answer["margin_bound"], answer["weights"], answer["actions"]
            lane.best_value = answer["value"]
            lane.idle = 0

    def play_games(self, lanes: list[_Lane]) -> None:
        """The game over every lane's columns: a lower bound, its mixture, and weights for the next query.

        Policies that other lanes have met join where they are better than what the game has; then it is played again.
        """
        self._play([lane for lane in lanes if lane.columns.size])
        joined = [lane for lane in lanes if self._join_from_pool(lane)]
        if joined:
            self._play(joined)
        for lane in lanes:
            lane.gaps.append(lane.gap)

    def _join_from_pool(self, lane: _Lane) -> bool:
        """Adds the policies that are worth most at the query; False if none is worth much more than the lane's own."""
        if not lane.columns.size:
            return False
        worth = (self.pool.expected - lane.expectations) @ lane.query(self.pulls[0])
        limit = worth[lane.columns].max() + _WORTHWHILE * max(lane.gap, 0.0)
        best = np.argsort(worth)[-_FROM_POOL:]
        best = best[worth[best] > limit]
        lane.add(best, self.room)
        return best.size > 0

    def _play(self, lanes: list[_Lane]) -> None:
        chunks = self._chunks(lanes)
        for chunk, games in zip(chunks, self.run(self._solve_games, chunks), strict=True):
            for k, lane in enumerate(chunk):
                lane.row_probabilities, lane.probabilities = games.w[k], games.q[k, : len(lane.columns)]
                if games.lower[k] > lane.lower:
                    lane.lower, lane.mixture, lane.idle = games.lower[k], (lane.columns, lane.probabilities), 0

    def _solve_games(self, lanes: list[_Lane]):
        payoffs = [(self.pool.expected[lane.columns] - lane.expectations).T for lane in lanes]
        former = [
            (0.0 if lane.row_probabilities is None else lane.row_probabilities, lane.probabilities) for lane in lanes
        ]
        bounds = [lane.bound for lane in lanes]
        goals = [0.25 * lane.tolerance for lane in lanes]
        return play(payoffs, former, bounds, goals, _LOOSE_GAME, self.width)

    def found(self, lanes: list[_Lane]) -> Found:
        """What all lanes end with. A lane whose programs all failed has nothing: its policy is anybody's guess."""
        shape = self.mdp.num_states, self.mdp.num_actions
        x = [np.zeros(shape) if lane.mixture is None else self.pool.mixture(*lane.mixture) for lane in lanes]
        nothing = np.full(len(lanes[0].value), np.nan)
        counts = np.array([lane.made for lane in lanes])
        return Found(
            x=np.stack(x),
            weights=np.stack([lane.weights for lane in lanes]),
            value=np.stack([nothing if lane.best_value is None else lane.best_value for lane in lanes]),
            iterations=counts,
            stopped=np.where(counts >= self.limit, Status.ITERATION_LIMIT, Status.STALLED),
            negligible=_NO_OCCUPANCY,
        )
