"""Another method for slow lanes of LPAL on columns, in a thread of its own while the other lanes go on with columns.

The thread is for batches: in one of 16 lanes of `grid48` (bench/results/speed_lpal.csv) the other method has five. Its
steps are many small calls that leave a core to spare, which columns can use; what that gains has not been measured.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

from jaxhom.apprenticeship.column_lane import Lane
from jaxhom.apprenticeship.interior_point import Point

_STEPS = 50  # of a lane at most: 5 to 40 are usual, and the lane goes on with columns afterwards


class Help(NamedTuple):
    """Another method, and how much is left to it.

    Attributes:
      solve: takes expectations [K], a tolerance and `max_iterations`.
      share: it takes every `share`-th slow lane; the others go on with columns.
    """

    solve: Callable[..., Point]
    share: int = 1


class Helper:
    """Gives slow lanes to another method, and gives them back together when no other lane is left.

    Otherwise the threads' speed would decide which lane learns from which.

    Args:
      find: called once a lane is slow, says what help there is, if any. None for no help at all.
      limit: iterations of a lane.
      waits: the other lanes stand still meanwhile.
    """

    def __init__(self, find: Callable[[], Help | None] | None, limit: int, waits: bool):
        self._find, self._limit, self._waits, self._thread = find, limit, waits, ThreadPoolExecutor(1)
        self.lanes: list[tuple[Lane, Future]] = []
        self._num_slow = 0

    def __enter__(self) -> Helper:
        return self

    def __exit__(self, *_) -> None:
        self._thread.shutdown(wait=False, cancel_futures=True)  # when interrupted, what waits is not begun

    def take_from(self, lanes: list[Lane]) -> list[Lane]:
        """Begins with its share of the lanes that have become slow, and returns the others."""
        slow = [lane for lane in lanes if lane.is_slow()]
        help_ = self._find() if self._find and slow else None
        taken = []
        for lane in slow:
            lane.was_slow = True
            if help_ and self._num_slow % help_.share == 0:
                steps = min(_STEPS, self._limit - lane.made)
                point = self._thread.submit(help_.solve, lane.expectations, lane.tolerance, max_iterations=steps)
                taken.append((lane, point))
                if self._waits:
                    point.result()
            self._num_slow += 1
        self.lanes += taken
        gone = {lane for lane, _ in taken}
        return [lane for lane in lanes if lane not in gone]

    def give_back(self) -> Iterator[tuple[Lane, Point]]:
        """The lanes, and what the method has found for each."""
        lanes, self.lanes = self.lanes, []
        for lane, point in lanes:
            yield lane, point.result()
