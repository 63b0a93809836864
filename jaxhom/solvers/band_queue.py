"""Many linear programs through compiled steps of a few lanes: finished lanes leave, waiting ones take their place.

As `lane_queue`, with the lanes first. On a CPU, a program with few lanes runs on one core; one is under way on each.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING

import jax
import numpy as np

from jaxhom.programs import host_jit
from jaxhom.solvers.band_interior_point import Iterate, Lanes, Point, begin, run
from jaxhom.solvers.band_system import BandSystem
from jaxhom.solvers.lane_queue import num_cores, work_on

if TYPE_CHECKING:
    from jaxtyping import Float

_SHARE = 0.25  # of the lanes that end a program
_MOST_ENTRIES = 2**27  # of the factors of a program: 1 GB
_WIDTH = 1  # lanes of a program on a CPU: on grid16 4 or 8 took twice as long per lane and step


def solve_lanes(
    system: BandSystem,
    initial: Float[np.ndarray, " n"],
    lanes: Lanes,
    points: Point,
    progress: Callable[[int], object] = lambda count: None,
) -> Iterate:
    """The last iterates of all lanes, in NumPy.

    Args:
      system: of the model. initial: [n], in its order.
      lanes: what is asked, [B] first, in NumPy. points: where they begin.
      progress: called with the number of lanes that just finished.
    """
    queue = _Queue(lanes, points, progress)
    on_cpu = jax.default_backend() == "cpu"
    workers = min(num_cores() if on_cpu else 1, queue.total)
    width = _width(system, queue.total, workers, on_cpu)
    work_on(queue, functools.partial(_drain, queue, system, initial, width), workers)
    return queue.results


def _width(system: BandSystem, total: int, workers: int, on_cpu: bool) -> int:
    """Lanes of a program: 1 or 2, 4, 8, ..., so that few are compiled."""
    count, size, num_features = system.border.shape
    entries = count * size * (3 * size + 2 * num_features)
    most = max(1, min(_WIDTH if on_cpu else 64, _MOST_ENTRIES // entries))
    wanted = min(most, -(-total // workers))
    return 1 << (wanted.bit_length() - 1)


class _Queue:
    """Lanes that wait and answers that are there; used by several threads."""

    def __init__(self, lanes: Lanes, points: Point, progress: Callable[[int], object]):
        self.problem, self.total = (lanes, points), len(points.f)
        self._progress, self._waiting, self._lock = progress, 0, threading.Lock()
        self._answers: list = []

    def take(self, count: int) -> np.ndarray:
        """At most `count` lanes that nobody has taken yet."""
        with self._lock:
            first, self._waiting = self._waiting, min(self.total, self._waiting + count)
            return np.arange(first, self._waiting)

    def close(self) -> None:
        """Nobody takes another lane."""
        with self._lock:
            self._waiting = self.total

    def store(self, state: Iterate, numbers: np.ndarray) -> None:
        """Keeps what lanes have come to."""
        if numbers.size:
            with self._lock:
                self._answers.append((numbers, state))
                self._progress(numbers.size)

    @property
    def results(self) -> Iterate:
        """In the order of the lanes."""
        order = np.argsort(np.concatenate([numbers for numbers, _ in self._answers]))
        return jax.tree.map(lambda *parts: np.concatenate(parts)[order], *[state for _, state in self._answers])


def _drain(queue: _Queue, system: BandSystem, initial, width: int) -> None:
    """Solves lanes of the queue until none is left."""
    state, owner = None, np.zeros(0, int)
    while True:
        fresh = queue.take(width - owner.size)
        busy, used = owner.size, owner.size + fresh.size
        if not used:
            return
        owner = np.append(owner, fresh)
        lanes, points = _taken(queue.problem, np.resize(owner, width))  # surplus lanes repeat the first
        if fresh.size or state is None:
            new = _begin(system, initial, lanes, points)
            state = new if not busy else jax.tree.map(lambda old, new, at=busy: _joined(old, new, at), state, new)
        state, done = _run(system, initial, lanes, state, used)
        done, state = np.asarray(done)[:used], jax.tree.map(np.asarray, state)
        queue.store(_taken(state, np.flatnonzero(done)), owner[done])
        order = np.resize(np.append(np.flatnonzero(~done), np.flatnonzero(done)), width)
        owner, state = owner[~done], _taken(state, order)


def _taken(tree, numbers: np.ndarray):
    """Some lanes of every leaf."""
    return jax.tree.map(lambda leaf: leaf[numbers], tree)


def _joined(old, new, busy: int):
    return np.concatenate([old[:busy], np.asarray(new)[busy:]])


_begin = host_jit(begin)


@host_jit
def _run(system: BandSystem, initial, lanes: Lanes, state: Iterate, used):
    return run(system, initial, lanes, state, used, _SHARE)
