"""LPAL on columns: the zero-sum game between features and the policies met so far.

v* is the value of a game with one row per feature and one column V(pi) - Vhat per policy. Only the columns that
matter are made: solve the game over the present ones for row weights w and column probabilities q, add the best
response to w, and repeat. The mixture sum_j q_j x_j of occupancies is the occupancy of a policy, so the game's lower
bound is that policy's margin; planning for any w gives the upper bound.

What decides how many columns it takes is w. At a vertex of the game's solutions it jumps from round to round. Two
things keep it in the middle: the games are solved by an interior-point method that stops while the game's own gap is
half of the open one, and the response is asked for between these weights and those of the best bound so far (in-out
separation, Ben-Ameur and Neto 2007).

The lanes of a batch share the model, and so the policies: what one has met is in the pool, and any other may use it.
`column_lane` is the state of one lane, `column_rounds` one round of some of them. Here is the loop: a few lanes are
under way at a time, so that later ones find many policies made, and their rounds are in step, so that the answer does
not depend on which thread is first.
"""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import jax
import numpy as np
from tqdm import tqdm

from jaxhom.apprenticeship.column_lane import Lane
from jaxhom.apprenticeship.column_rounds import Rounds, exact_where_better
from jaxhom.apprenticeship.request import Request
from jaxhom.apprenticeship.solution import Found, LPALMethod
from jaxhom.models.mdp import MDP
from jaxhom.planning.chain_solver import is_solved_by_lu
from jaxhom.solvers.blas_threads import one_blas_thread
from jaxhom.solvers.lane_queue import num_cores

if TYPE_CHECKING:
    from jaxtyping import Bool, Int

DEFAULT_COLUMNS = 500
_LANES_AT_A_TIME = 4  # programs of them under way per core, so that later ones find policies in the pool: 16 lanes of
# bumps24 (bench/results/speed_lpal.csv) take 342 iterations, 354 all at once
_NUMBERS_AT_A_TIME = 1024  # states times lanes of one program: small models are solved in wider batches
_MAX_WIDTH = 32  # a wider program waits longer for its slowest lane


def solve_by_columns(request: Request, *, gives_up: bool = False) -> Found:
    """The batch by columns.

    Args:
      request: the lanes.
      gives_up: whether lanes that do not get on end: another method will take them.
    """
    with one_blas_thread(), Columns(request) as columns:  # all cores are in use
        columns.play(range(len(request.lanes)), gives_up=gives_up)
        return columns.found()


class Columns:
    """The lanes of a request and their games, in the middle of it: other methods may say where to go on.

    To be used in a `with` statement, which ends its threads.
    """

    def __init__(self, request: Request):
        self._limit, self._progress, total = request.limit or DEFAULT_COLUMNS, request.progress, len(request.lanes)
        exact = exact_where_better(request)
        workers, width = _workers_and_width(request.model.mdp, total, is_on_host=exact is not None)
        self._threads, self._most = ThreadPoolExecutor(workers), _LANES_AT_A_TIME * workers * width
        self._rounds = Rounds(request, exact, self._limit, width, workers, self._threads.map)
        for compile_ahead in self._rounds.programs():  # while the first policies are evaluated
            self._threads.submit(compile_ahead)
        self._lanes = self._rounds.lanes()

    def __enter__(self) -> Columns:
        return self

    def __exit__(self, *_) -> None:
        self._threads.shutdown(cancel_futures=True)

    def play(self, numbers: Iterable[int], *, rounds: int | None = None, gives_up: bool = False) -> None:
        """Rounds of some lanes, until each is closed, or has had so many, or (`gives_up`) does not get on."""
        lanes = [self._lanes[number] for number in numbers]
        last = {id(lane): np.inf if rounds is None else len(lane.gaps) + rounds for lane in lanes}

        def is_over(lane: Lane) -> bool:
            return lane.is_done(self._limit) or len(lane.gaps) >= last[id(lane)] or (gives_up and lane.is_slow())

        waiting, busy = lanes[::-1], []
        with tqdm(disable=not self._progress, desc="LPAL", unit="column") as bar:
            while waiting or busy:
                new = [waiting.pop() for _ in range(min(len(waiting), self._most - len(busy)))]
                self._rounds.welcome(new)
                busy += [lane for lane in new if not lane.is_done(self._limit)]
                if not busy:
                    continue
                self._rounds.respond_to(busy)
                self._rounds.play_games(busy)
                _show(bar, busy, len(busy) + len(waiting))
                busy = [lane for lane in busy if not is_over(lane)]

    def offer(self, numbers: Iterable[int], found: Found, is_policy: Bool[np.ndarray, " C"]) -> None:
        """What another method has found for some lanes: what to ask next, and columns where a policy is good enough."""
        lanes = [self._lanes[number] for number in numbers]
        for lane, weights, value in zip(lanes, found.weights, found.value, strict=True):
            if np.isfinite(value).all():  # iterations in float32 can overflow; then the lane goes on by itself
                lane.guess, lane.value = weights, value
        some = np.flatnonzero(is_policy)
        self._rounds.add_policies([lanes[k] for k in some], found.x[some])

    def spend(self, numbers: Iterable[int], iterations: int) -> None:
        """Counts another method's iterations."""
        for number in numbers:
            self._lanes[number].made += iterations

    def open(self) -> Int[np.ndarray, " C"]:
        """The lanes that are not closed and have iterations left."""
        return np.array([k for k, lane in enumerate(self._lanes) if not lane.is_done(self._limit)], int)

    def found(self, offered_by: LPALMethod = LPALMethod.COLUMNS) -> Found:
        """What all lanes end with. Those that had no query of their own are decided by whoever offered theirs."""
        return self._rounds.found(self._lanes, offered_by)


def _workers_and_width(mdp: MDP, total: int, *, is_on_host: bool) -> tuple[int, int]:
    """Programs at a time, and lanes of each."""
    if is_on_host:  # where Python takes turns: two threads take as long for two queries as one, and rounds need both
        return 1, 1
    on_cpu = jax.default_backend() == "cpu"
    # Two programs that both call LAPACK can wait for each other for ever (see `jaxhom.solvers.inverse_factor`).
    workers = num_cores() if on_cpu and not is_solved_by_lu(mdp) else 1
    is_wide = mdp.is_dense or not on_cpu  # dense products read the same large matrix for any number of lanes
    width = _MAX_WIDTH if is_wide else min(max(1, _NUMBERS_AT_A_TIME // mdp.num_states), _MAX_WIDTH)
    return workers, min(width, -(-total // workers))


def _show(bar: tqdm, busy: list[Lane], left: int) -> None:
    bar.set_postfix(gap=f"{max(lane.gap for lane in busy):.2e}", lanes=left, refresh=False)
    bar.update(len(busy))
