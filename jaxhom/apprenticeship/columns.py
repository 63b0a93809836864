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
`column_lane` is the state of one lane, `column_rounds` one round of some of them, `column_helper` another method for
lanes that do not get on. Here is the loop: a few lanes are under way at a time, so that later ones find many policies
made, and their rounds are in step, so that the answer does not depend on which thread is first.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import jax
from tqdm import tqdm

from jaxhom.apprenticeship.column_helper import Help, Helper
from jaxhom.apprenticeship.column_lane import Lane
from jaxhom.apprenticeship.column_rounds import Rounds
from jaxhom.apprenticeship.request import Request
from jaxhom.apprenticeship.solution import Found
from jaxhom.models.mdp import MDP
from jaxhom.planning.chain_solver import is_solved_by_lu
from jaxhom.solvers.lane_queue import num_cores

DEFAULT_COLUMNS = 500
_LANES_AT_A_TIME = 4  # programs of them under way per core, so that later ones find policies in the pool: 16 lanes of
# bumps24 (bench/results/speed_lpal.csv) take 342 iterations, 354 all at once
_NUMBERS_AT_A_TIME = 1024  # states times lanes of one program: small models are solved in wider batches
_MAX_WIDTH = 32  # a wider program waits longer for its slowest lane


def solve_by_columns(request: Request, find_help: Callable[[], Help | None] | None = None) -> Found:
    """The batch by columns; where `find_help` finds another method, that takes its share of the slow lanes."""
    limit, total = request.limit or DEFAULT_COLUMNS, len(request.lanes)
    workers, width = _workers_and_width(request.model.mdp, total)
    bar = tqdm(disable=not request.progress, desc="LPAL", unit="column")
    with ThreadPoolExecutor(workers) as threads, Helper(find_help, limit, waits=workers == 1) as helper, bar:
        rounds = Rounds(request, limit, width, workers, threads.map)
        lanes = [rounds.lane(number) for number in range(total)]
        waiting, busy = list(reversed(lanes)), []
        while waiting or busy or helper.lanes:
            if not (waiting or busy):
                for lane, point in helper.give_back():
                    rounds.resume(lane, point)
                    busy.append(lane)
                    bar.update()
            while waiting and len(busy) < _LANES_AT_A_TIME * workers * width:
                busy.append(waiting.pop())
            rounds.respond_to(busy)
            rounds.play_games(busy)
            _show(bar, busy, len(busy) + len(waiting) + len(helper.lanes))
            busy = helper.take_from([lane for lane in busy if not lane.is_done(limit)])
        return rounds.found(lanes)


def _workers_and_width(mdp: MDP, total: int) -> tuple[int, int]:
    """Programs at a time, and lanes of each."""
    on_cpu = jax.default_backend() == "cpu"
    # Two programs that both call LAPACK can wait for each other for ever (see `jaxhom.solvers.inverse_factor`).
    workers = num_cores() if on_cpu and not is_solved_by_lu(mdp) else 1
    is_wide = mdp.is_dense or not on_cpu  # dense products read the same large matrix for any number of lanes
    width = _MAX_WIDTH if is_wide else min(max(1, _NUMBERS_AT_A_TIME // mdp.num_states), _MAX_WIDTH)
    return workers, min(width, -(-total // workers))


def _show(bar: tqdm, busy: list[Lane], left: int) -> None:
    bar.set_postfix(gap=f"{max(lane.gap for lane in busy):.2e}", lanes=left, refresh=False)
    bar.update(len(busy))
