"""Many problems through a fixed number of lanes: finished lanes leave, waiting problems take their place.

Under one `while_loop` a batch runs until its slowest lane stops. Here the loop ends when a quarter of the lanes are
done, and the host takes their answers out and fills them from the queue. The batch keeps one width, so one program is
compiled; a narrow batch (64 lanes fill the vector units of a CPU) wastes little on the last, slow lanes.

With several devices each gets its own share of the lanes: the lane axis of every array is sharded over them.
"""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom.pdhg import engine

_STOP_FRACTION = 0.25


def solve_many(
    problem: engine.Problem,
    *,
    tolerance: float,
    threshold: np.ndarray | None = None,
    max_iterations: int = 100_000,
    lanes: int = 64,
    devices: Sequence[jax.Device] | None = None,
    progress: Callable[[int], object] = lambda count: None,
) -> engine.PDHGState:
    """Solves every lane of `problem`, a few hundred at a time.

    Args:
      problem: arrays on the host or the device, P problems on the last axis of every leaf.
      tolerance: gap to reach.
      threshold: None, or [P]: see `engine.is_settled`.
      max_iterations: per problem.
      lanes: width of the batch on each device.
      devices: over which the batch is sharded; all of JAX's default backend if None.
      progress: called with the number of problems that just finished.

    Returns:
      The final state of every problem, [P] last, in NumPy arrays: bounds, best points and steps.
    """
    problem = jax.tree.map(np.asarray, problem)
    total = jax.tree.leaves(problem)[0].shape[-1]
    limits = None if threshold is None else np.broadcast_to(threshold, (total,))
    devices = jax.devices() if devices is None else devices
    lanes *= len(devices)
    results = None
    state, busy, owner = None, np.zeros(0, int), np.zeros(0, int)
    waiting = 0
    while waiting < total or busy.size:
        fresh = np.arange(waiting, min(total, waiting + lanes - busy.size))
        waiting += fresh.size
        source = np.full(lanes, -1)
        source[: busy.size] = busy
        owner = np.resize(np.append(owner[busy], fresh), lanes)  # surplus lanes repeat the first
        used = busy.size + fresh.size
        batch = _shard(jax.tree.map(lambda leaf, owner=owner: leaf[..., owner], problem), devices)
        limit = None if limits is None else limits[owner]
        state = _resume(batch, state, source)
        state, done = _run(batch, state, limit, used, tolerance, max_iterations)
        done = np.asarray(done)[:used]
        busy, finished = np.flatnonzero(~done), np.flatnonzero(done)
        results = _store(results, state, finished, owner[finished], total)
        progress(finished.size)
    return results


def _shard(batch: engine.Problem, devices: Sequence[jax.Device]) -> engine.Problem:
    """Puts the lanes, the last axis of every leaf, on the devices in equal shares."""
    mesh = jax.sharding.Mesh(np.asarray(devices), ("lanes",))

    def put(leaf):
        spec = jax.sharding.PartitionSpec(*(None,) * (leaf.ndim - 1), "lanes")
        return jax.device_put(leaf, jax.sharding.NamedSharding(mesh, spec))

    return jax.tree.map(put, batch)


@jax.jit
def _resume(problem, state, source) -> engine.PDHGState:
    """Lanes of a former state where `source` names one, fresh ones where it is -1."""
    fresh = engine.init(problem)
    if state is None:
        return fresh
    return jax.tree.map(lambda old, new: jnp.where(source >= 0, old[..., source], new), state, fresh)


@jax.jit
def _run(problem, state, threshold, used, tolerance, max_iterations):
    """Steps until a quarter of the `used` lanes are done; returns which."""

    def is_done(state):
        settled = engine.is_settled(state, tolerance, threshold)
        return settled | (state.steps >= max_iterations)

    def keep_going(state):
        done = is_done(state) & (jnp.arange(state.steps.size) < used)
        return done.sum() < _STOP_FRACTION * used

    state = jax.lax.while_loop(keep_going, lambda s: engine.step(problem, s), state)
    return state, is_done(state)


def _store(results, state, finished, target, total):
    """Writes the finished lanes of `state` to their places in `results`."""
    host = jax.tree.map(lambda leaf: np.asarray(leaf)[..., finished], state)
    if results is None:
        results = jax.tree.map(lambda leaf: np.zeros((*leaf.shape[:-1], total), leaf.dtype), host)
    for whole, part in zip(jax.tree.leaves(results), jax.tree.leaves(host), strict=True):
        whole[..., target] = part
    return results
