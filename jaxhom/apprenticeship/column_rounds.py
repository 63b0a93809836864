"""One round of LPAL on columns for some lanes: best responses to their queries, then the games over their columns.

The work of a half round is cut into programs of a fixed width, which run beside each other on the cores. Nothing that a
program reads depends on another of the same half, so the answer does not depend on which is first.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom.apprenticeship.column_games import capacities, play, prepare
from jaxhom.apprenticeship.column_lane import SLACK, Lane
from jaxhom.apprenticeship.column_responses import (
    LOOSE_GAME,
    LOOSE_PLANNING,
    evaluate,
    evaluate_on_host,
    respond,
    respond_on_host,
    with_compact_features,
)
from jaxhom.apprenticeship.exact import NEAR_ONE, Exact
from jaxhom.apprenticeship.policy_pool import PolicyPool
from jaxhom.apprenticeship.request import Request
from jaxhom.apprenticeship.solution import RARE_STATES, Found, LPALMethod
from jaxhom.models.mdp import MDP, uniform_policy
from jaxhom.planning.occupancy import policy_from_occupancy
from jaxhom.solvers.game_interior_point import GameSolution
from jaxhom.status import Status

if TYPE_CHECKING:
    from jaxtyping import Float

_PULLS = (0.3, 0.7)  # shares of the best bound's weights in a query; the second where a core would be idle
_FEW_FEATURES, _FEW_PULLS = 8, (0.0, 0.5)  # up to here the weights do not jump
_FROM_POOL = 8  # policies of other lanes that join a game at a time: 16 lanes of bumps24 (bench/results/speed_lpal.csv)
# take 342 iterations, 381 if none may join
_prepared: set[str] = set()  # kinds of models whose programs are there, or under way
_WORTHWHILE = 0.1  # share of the open gap by which they have to be better


class Rounds:
    """What the lanes of a request share.

    Args:
      request: the lanes.
      exact: the model on the host, if best responses are found there (`exact_where_better`).
      limit: columns of a lane.
      width: lanes of one program.
      workers: programs at a time, run by `run`: a `map` over threads.
    """

    def __init__(self, request: Request, exact: Exact | None, limit: int, width: int, workers: int, run: Callable):
        mdp, self._request, self._limit = request.model.mdp, request, limit
        self._width, self._workers, self._run = width, workers, run
        self._mdp, self._pool = request.model.once(with_compact_features), PolicyPool(mdp)
        self._room = capacities(mdp.num_features)[-1]
        self._pulls = _FEW_PULLS if mdp.num_features <= _FEW_FEATURES else _PULLS
        self._error = 0.25 * SLACK * float(request.tolerance.min())
        self._exact = exact

    def programs(self) -> list[Callable[[], object]]:
        """Calls that compile what the first round is going to run, where that is done in programs; once."""
        shapes = [leaf.shape for leaf in jax.tree.leaves(self._mdp)]
        kind = str((self._mdp.dtype, shapes, jax.tree.structure(self._mdp), self._width))
        if self._exact is not None or kind in _prepared:
            return []
        _prepared.add(kind)
        num_features, dtype = self._mdp.num_features, np.dtype(self._mdp.dtype)
        some = np.full((self._width, num_features), 1.0 / num_features, dtype)
        value, enough = np.zeros((self._width, self._mdp.num_states), dtype), np.full(self._width, np.inf, dtype)
        return [
            lambda: respond(self._mdp, some, some, value, enough, self._error),
            lambda: prepare(num_features, self._width, self._pool.expected.dtype),
        ]

    def lanes(self) -> list[Lane]:
        """One for each problem; with a first column where there is a policy to begin with."""
        lanes = [self._lane(number) for number in range(len(self._request.lanes))]
        if self._request.policy is not None:
            self.add_policies(lanes, self._request.policy)
        return lanes

    def _lane(self, number: int) -> Lane:
        asked = self._request
        expectations = asked.expectations[number]
        uniform = np.full(len(expectations), 1.0 / len(expectations))
        weights = uniform if asked.weights is None else asked.weights[number]
        value = np.zeros(self._mdp.num_states) if asked.value is None else np.nan_to_num(asked.value[number])
        return Lane(expectations, float(asked.tolerance[number]), value, weights)

    def add_policies(self, lanes: list[Lane], x: Float[np.ndarray, "C S A"]) -> None:
        """A column for each lane: the policy, which may be stochastic, of an occupancy up to scale (eq. 5)."""
        for chunk, (policies, *evaluated) in self._in_chunks(self._evaluate, list(zip(lanes, x, strict=True))):
            for (lane, _), policy, mu, expected in zip(chunk, policies, *evaluated, strict=False):
                if np.isfinite(expected).all():
                    lane.add([self._pool.add(mu, policy, expected)], self._room)

    def _evaluate(self, chunk: list[tuple[Lane, Float[np.ndarray, "S A"]]]) -> tuple[np.ndarray, ...]:
        """Policies [L, S, A], their state occupancies [L, S] and feature expectations [L, K]."""
        x = np.stack([x for _, x in chunk])
        policies = policy_from_occupancy(self._mdp, x, np.broadcast_to(np.asarray(uniform_policy(self._mdp)), x.shape))
        if self._exact is not None:
            parts = [evaluate_on_host(self._exact, policy, self._error) for policy in policies]
            return policies, *map(np.stack, zip(*parts, strict=True))
        policies = policies[np.minimum(np.arange(self._width), len(policies) - 1)]
        return policies, *map(np.asarray, evaluate(self._mdp, policies, self._error))

    # ---------------------------------------------------------------------------------------------- best responses

    def respond_to(self, lanes: list[Lane]) -> None:
        """Best responses of every lane to its query: columns, and upper bounds. Cores left over ask once more."""
        per_lane = max(1, min(len(self._pulls), self._workers // len(lanes)))
        is_first = lanes[0].row_probabilities is None
        pulls = self._pulls[: 1 if is_first else per_lane]
        asked = [
            (lane, pull)
            for number, pull in enumerate(pulls)
            for lane in lanes
            if number == 0 or (lane.guess is None and lane.made + number < self._limit)
        ]
        for lane in lanes:
            lane.idle += 1
        same: dict[bytes, list[tuple[Lane, float]]] = {}
        for lane, pull in asked:  # what several lanes ask is answered once: at first all have the same weights
            same.setdefault(lane.query(pull).tobytes(), []).append((lane, pull))
        groups = iter(same.values())
        for chunk, answers in self._in_chunks(self._respond, [group[0] for group in same.values()]):
            for k, (lane, _) in enumerate(chunk):
                others = [other for other, _ in next(groups)[1:]]
                self._take(lane, {name: array[k] for name, array in answers.items()}, others)

    def _respond(self, asked: list[tuple[Lane, float]]) -> dict[str, np.ndarray]:
        goals = [lane.tolerance for lane, _ in asked]
        open_ = [lane.gap if np.isfinite(lane.gap) else 0.0 for lane, _ in asked]
        accuracy = np.maximum(goals, LOOSE_PLANNING * np.array(open_))
        if self._exact is not None:
            parts = [
                respond_on_host(self._exact, lane.expectations, lane.query(pull), lane.value, goal, self._error)
                for (lane, pull), goal in zip(asked, accuracy, strict=True)
            ]
            return jax.tree.map(lambda *leaves: np.stack(leaves), *parts)
        # Lanes that do not exist repeat the first; asked for nothing, they stop at once.
        padded = asked + [asked[0]] * (self._width - len(asked))
        accuracy = np.append(accuracy, np.full(len(padded) - len(asked), np.inf))
        given = ([lane.expectations for lane, _ in padded], [lane.query(pull) for lane, pull in padded])
        arrays = (*given, [lane.value for lane, _ in padded], accuracy)
        arrays = (np.asarray(array, self._mdp.dtype) for array in arrays)
        return jax.tree.map(np.asarray, respond(self._mdp, *arrays, self._error))

    def _take(self, lane: Lane, answer: dict[str, np.ndarray], others: list[Lane]) -> None:
        """The answer to a lane's query; to others that asked the same, it costs nothing."""
        lane.made += 1
        column = None
        if np.isfinite(answer["expected"]).all():
            column = self._pool.add(answer["occupancy"], answer["actions"], answer["expected"])
        if np.isfinite(answer["margin_bound"]) and np.isfinite(answer["value"]).all():
            most = answer["margin_bound"] + answer["weights"] @ lane.expectations
            self._pool.add_cut(answer["weights"], most, answer["actions"], answer["value"])
        for one in (lane, *others):
            one.has_asked, one.guess = one.has_asked or one.guess is None, None
            if column is not None:
                one.add([column], self._room)
            if np.isfinite(answer["value"]).all():
                one.value = answer["value"]
        lane.take_bound(answer)

    # ------------------------------------------------------------------------------------------------------- games

    def play_games(self, lanes: list[Lane]) -> None:
        """The game over every lane's columns: a lower bound, its mixture, and weights for the next query.

        Policies that other lanes have met join where they are better than what the game has; then it is played again.
        Bounds that they have proved count for all.
        """
        for lane in lanes:
            if cut := self._pool.best_cut(lane.expectations):
                lane.take_bound(cut)
        self._play([lane for lane in lanes if lane.columns.size])
        self._play([lane for lane in lanes if self._join_from_pool(lane)])
        for lane in lanes:
            lane.gaps.append(lane.gap)

    def welcome(self, lanes: list[Lane]) -> None:
        """Lanes that have not begun, and have nothing to begin with, learn what is in the pool."""
        new = [lane for lane in lanes if not (lane.gaps or lane.columns.size or lane.guess is not None)]
        if self._request.weights is None and len(self._pool.expected):
            for lane in new:
                worth = (self._pool.expected - lane.expectations).min(axis=1)
                lane.add(np.argsort(worth)[-_FROM_POOL:], self._room)
            self.play_games(new)

    def _join_from_pool(self, lane: Lane) -> bool:
        """Adds the policies that are worth most at the query; False if none is worth much more than the lane's own."""
        if not lane.columns.size:
            return False
        worth = (self._pool.expected - lane.expectations) @ lane.query(self._pulls[0])
        limit = worth[lane.columns].max() + _WORTHWHILE * max(lane.gap, 0.0)
        best = np.argsort(worth)[-_FROM_POOL:]
        best = best[worth[best] > limit]
        lane.add(best, self._room)
        return best.size > 0

    def _play(self, lanes: list[Lane]) -> None:
        for chunk, games in self._in_chunks(self._solve_games, lanes):
            for k, lane in enumerate(chunk):
                lane.take_game(games.w[k], games.q[k], games.lower[k])

    def _solve_games(self, lanes: list[Lane]) -> GameSolution:
        payoffs = [(self._pool.expected[lane.columns] - lane.expectations).T for lane in lanes]
        former = [
            (0.0 if lane.row_probabilities is None else lane.row_probabilities, lane.probabilities) for lane in lanes
        ]
        bounds = [lane.bound for lane in lanes]
        goals = [0.25 * lane.tolerance for lane in lanes]
        return play(payoffs, former, bounds, goals, LOOSE_GAME, self._width, on_host=self._exact is not None)

    # ---------------------------------------------------------------------------------------------------------------

    def _in_chunks(self, work: Callable, items: list) -> zip:
        """(items, what `work` makes of them), so many items at a time as a program is wide."""
        chunks = [items[first : first + self._width] for first in range(0, len(items), self._width)]
        return zip(chunks, self._run(work, chunks), strict=True)

    def found(self, lanes: list[Lane], offered_by: LPALMethod) -> Found:
        """What all lanes end with. A lane whose programs all failed has nothing: its policy is anybody's guess."""
        shape = self._mdp.num_states, self._mdp.num_actions
        x = [np.zeros(shape) if lane.mixture is None else self._pool.mixture(*lane.mixture) for lane in lanes]
        nothing = np.full(shape[0], np.nan)
        counts = np.array([lane.made for lane in lanes])
        return Found(
            x=np.stack(x),
            weights=np.stack([lane.weights for lane in lanes]),
            value=np.stack([nothing if lane.best_value is None else lane.best_value for lane in lanes]),
            iterations=counts,
            gap=np.array([lane.gap for lane in lanes]),
            decided_by=np.array([LPALMethod.COLUMNS if lane.has_asked else offered_by for lane in lanes]),
            stopped=np.where(counts >= self._limit, Status.ITERATION_LIMIT, Status.STALLED),
            negligible=RARE_STATES,
        )


def exact_where_better(request: Request) -> Exact | None:
    """The model on the host, where best responses by linear solves are right, or the first of them sooner there."""
    return request.model.once(_exact_where_rough) or _exact_if_small(request)


def _exact_where_rough(mdp: MDP) -> Exact | None:
    """The model on the host, where its type or iterations have no digits left near this discount."""
    is_rough = mdp.dtype != jnp.float64 or float(mdp.discount) > NEAR_ONE
    exact = Exact(mdp) if is_rough else None
    return exact if exact and exact.is_direct else None


def _exact_if_small(request: Request) -> Exact | None:
    """The model on the host, where lanes are so few and small that programs would take longer to compile."""
    exact = request.model.once(Exact)
    return exact if exact.model.plans_sooner(len(request.lanes)) else None
