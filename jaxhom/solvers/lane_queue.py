"""Many problems through a fixed number of lanes: finished lanes leave, waiting problems take their place.

A *lane* is one problem of a batch: one index of the last axis of every array. Under one `while_loop` a batch runs until
its slowest lane stops. Here the loop ends when a quarter of the lanes are done, and the host takes their answers out
and fills them from the queue. The batch keeps one width, so one program is compiled; a narrow batch (64 lanes fill the
vector units of a CPU) wastes little on the last, slow lanes.

On a CPU that JAX sees as one device, a batch per core is under way at a time, each driven by a thread: XLA runs the
small programs of one batch on one core. With several devices each gets its own share of the lanes: the lane axis of
every array is sharded over them.
"""

import functools
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom.programs import host_jit

_STOP_FRACTION = 0.25  # of the lanes: fewer and the host is asked more often, more and lanes wait
_MAX_WORKERS = 8  # threads: more wait for Python


class Solver(NamedTuple):
    """An iterative method for a batch of problems whose arrays, like the state's, have their lanes on the last axis.

    Attributes:
      init: problem -> state.
      step: problem, state -> state.
      is_finished: state, tolerance, threshold, max_iterations -> bool [lanes]: settled (`is_settled`), or at an end.
      jit: how the steps are compiled; `jax.jit`, or `host_jit` where that runs as fast.
    """

    init: Callable[[Any], Any]
    step: Callable[[Any, Any], Any]
    is_finished: Callable[..., jax.Array]
    jit: Callable = jax.jit


def solve_many(
    solver: Solver,
    problem,
    *,
    tolerance: float,
    threshold: np.ndarray | None = None,
    max_iterations: int = 100_000,
    lanes: int = 64,
    devices: Sequence[jax.Device] | None = None,
    keep: Sequence[str] | None = None,
    progress: Callable[[int], object] = lambda count: None,
) -> dict[str, np.ndarray]:
    """Solves every lane of `problem`, a few hundred at a time.

    Args:
      solver: the method.
      problem: arrays on the host or the device, P problems on the last axis of every leaf.
      tolerance: gap to reach.
      threshold: None, or scalar or [P]: what the method may decide instead of reaching the gap.
      max_iterations: per problem.
      lanes: width of the batch on each device.
      devices: over which the batch is sharded; all that this process has of JAX's default backend if None.
      keep: names of the state's fields to return; all if None.
      progress: called with the number of problems that just finished.

    Returns:
      Fields of the final state of every problem, [P] last, in NumPy arrays.
    """
    queue = _Queue(problem, threshold, keep)
    devices = jax.local_devices() if devices is None else devices
    lanes *= len(devices)
    workers = min(_num_workers(devices), max(1, queue.total // lanes))
    lock = threading.Lock()

    def report(count: int) -> None:
        with lock:
            progress(count)

    def work() -> None:
        _drain(queue, solver, lanes, devices, tolerance, max_iterations, report)

    work_on(queue, work, workers)
    return queue.results


def work_on(queue: Any, work: Callable[[], None], workers: int) -> None:
    """Has threads work on a queue, or this one if it is one; if any fails, the queue closes, so that all end soon."""

    def until_one_fails() -> None:
        try:
            work()
        except BaseException:
            queue.close()
            raise

    if workers == 1:
        work()
        return
    with ThreadPoolExecutor(workers) as pool:
        try:
            for future in [pool.submit(until_one_fails) for _ in range(workers)]:
                future.result()
        except BaseException:  # what interrupts this thread interrupts nobody else
            queue.close()
            raise


def _num_workers(devices: Sequence[jax.Device]) -> int:
    """Batches under way at a time: as many as there are cores, on a CPU that is one device."""
    if len(devices) > 1 or devices[0].platform != "cpu":
        return 1
    return num_cores()


def num_cores() -> int:
    """Programs to have under way at a time on a CPU: one per core, because XLA runs small ones on one core each."""
    return min(_MAX_WORKERS, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)


def map_on_cores(function: Callable[[Any], Any], items: Sequence) -> list:
    """`function` of every item, on all cores: for work of the host in which Python waits for compiled code."""
    workers = min(num_cores(), len(items))
    if workers <= 1:
        return [function(item) for item in items]
    with ThreadPoolExecutor(workers) as threads:
        return list(threads.map(function, items))


def is_settled(lower, upper, tolerance, threshold=np.nan):
    """bool [P]: bounds [P] are as close as `tolerance`, or decide `value <= threshold` up to it; NumPy or JAX.

    Where both bounds of a decision hold, the upper one decides. A threshold of NaN decides nothing.
    """
    return (upper - lower <= tolerance) | (lower > threshold) | (upper <= threshold + tolerance)


def run_lanes(solver: Solver, problem, state, *, tolerance, threshold=np.nan, max_iterations, share=1.0, used=None):
    """Steps until `share` of the lanes are finished; those that are stay as they are, whatever runs beside them.

    Args:
      solver: the method.
      problem: its arrays, lanes last.
      state: from `solver.init` or a former call.
      tolerance, threshold: scalars or [lanes], as in `is_settled`.
      max_iterations: per lane.
      share: of the lanes, that ends the loop.
      used: how many of the lanes count, from the first on; all if None.

    Returns:
      The state, and bool [lanes]: which are finished.
    """

    def is_finished(state):
        return solver.is_finished(state, tolerance, threshold, max_iterations)

    def keep_going(state):
        done = is_finished(state)
        counted = done.size if used is None else used
        return (done & (jnp.arange(done.size) < counted)).sum() < share * counted

    def advance(state):
        done = is_finished(state)
        return jax.tree.map(lambda old, new: jnp.where(done, old, new), state, solver.step(problem, state))

    state = jax.lax.while_loop(keep_going, advance, state)
    return state, is_finished(state)


class _Queue:
    """The problems that wait and the answers that are there; used by several threads."""

    def __init__(self, problem, threshold, keep: Sequence[str] | None):
        self.problem = jax.tree.map(np.asarray, problem)
        self.total = jax.tree.leaves(self.problem)[0].shape[-1]
        # NaN decides nothing: with a threshold and without, it is one program.
        self.limits = np.broadcast_to(np.nan if threshold is None else threshold, (self.total,))
        self.results: dict[str, np.ndarray] = {}
        self._keep = keep
        self._waiting = 0
        self._lock = threading.Lock()

    def take(self, count: int) -> np.ndarray:
        """At most `count` problems that nobody has taken yet."""
        with self._lock:
            first, self._waiting = self._waiting, min(self.total, self._waiting + count)
            return np.arange(first, self._waiting)

    def close(self) -> None:
        """No more problems for anybody."""
        with self._lock:
            self._waiting = self.total

    def store(self, state, finished: np.ndarray, problems: np.ndarray) -> None:
        """Writes the finished lanes of `state` to their problems' places in `results`."""
        host = {name: np.asarray(getattr(state, name))[..., finished] for name in self._keep or state.keys()}
        with self._lock:
            for name, part in host.items():
                if name not in self.results:
                    self.results[name] = np.zeros((*part.shape[:-1], self.total), part.dtype)
                self.results[name][..., problems] = part


def _drain(queue: _Queue, solver: Solver, lanes: int, devices, tolerance, max_iterations, progress) -> None:
    """Solves problems of the queue until none is left."""
    state, busy, owner = None, np.zeros(0, int), np.zeros(0, int)
    while True:
        fresh = queue.take(lanes - busy.size)
        used = busy.size + fresh.size
        if not used:
            return
        source = np.full(lanes, -1)
        source[: busy.size] = busy
        owner = np.resize(np.append(owner[busy], fresh), lanes)  # surplus lanes repeat the first
        batch = _shard(jax.tree.map(lambda leaf, owner=owner: leaf[..., owner], queue.problem), devices)
        fresh_state = _init(solver, batch)
        state = fresh_state if state is None else _merge(state, fresh_state, source)
        state, done = _program(solver)(batch, state, queue.limits[owner], used, tolerance, max_iterations)
        done = np.asarray(done)[:used]
        busy, finished = np.flatnonzero(~done), np.flatnonzero(done)
        queue.store(state, finished, owner[finished])
        progress(finished.size)


def _shard(batch, devices: Sequence[jax.Device]):
    """Puts the lanes, the last axis of every leaf, on the devices in equal shares."""
    mesh = jax.sharding.Mesh(np.asarray(devices), ("lanes",))

    def put(leaf):
        spec = jax.sharding.PartitionSpec(*(None,) * (leaf.ndim - 1), "lanes")
        return jax.device_put(leaf, jax.sharding.NamedSharding(mesh, spec))

    return jax.tree.map(put, batch)


@functools.partial(host_jit, static_argnums=0)
def _init(solver: Solver, problem):
    return solver.init(problem)


@host_jit
def _merge(state, fresh, source):
    """Lanes of a former state where `source` names one, fresh ones where it is -1."""
    return jax.tree.map(lambda old, new: jnp.where(source >= 0, old[..., source], new), state, fresh)


@functools.cache
def _program(solver: Solver) -> Callable:
    """`run_lanes` of a solver until a share of the lanes is done, compiled."""

    def run(problem, state, threshold, used, tolerance, max_iterations):
        limits = {"tolerance": tolerance, "threshold": threshold, "max_iterations": max_iterations}
        return run_lanes(solver, problem, state, **limits, share=_STOP_FRACTION, used=used)

    return solver.jit(run)
