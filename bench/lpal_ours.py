"""LPAL by this library, timed: run in a process of its own by `bench.limits`, like the peers in `bench.lpal_peers`."""

import statistics
import time

import numpy as np

from bench.lpal_peers import Answer

_REPEATS = 3
_SHARE_OF_REPEATS = 0.1  # of the time limit, that a call may take to be repeated more than once


def solve(
    name: str, method: str | None, expectations: np.ndarray, limit: float, batch: bool
) -> tuple[Answer, list[int]]:
    """Answers of `jaxhom.lpal` for lanes [B, K] of a named instance, one by one or all together, and its iterations.

    Each call is made once to compile and then timed, unless the first took more than half the limit.
    """
    import jax

    jax.config.update("jax_enable_x64", True)
    import jaxhom
    from bench.lpal_instances import INSTANCES

    start = time.perf_counter()
    mdp = jax.block_until_ready(INSTANCES[name].build())
    build = time.perf_counter() - start
    options = {} if method is None else {"method": method}

    def call(part):
        return jax.block_until_ready(jaxhom.lpal(mdp, part, **options))

    x, w, seconds, statuses, iterations, compile_s = [], [], [], [], [], []
    begin = time.perf_counter()
    for part in [expectations] if batch else expectations:
        found, first, again = timed(lambda part=part: call(part), limit)
        many = 1 if part.ndim == 1 else len(part)
        x += list(np.asarray(found.occupancy).reshape(many, mdp.num_states, mdp.num_actions))
        w += list(np.asarray(found.weights).reshape(many, -1))
        iterations += np.atleast_1d(found.iterations).tolist()
        statuses += [jaxhom.Status(int(status)).name for status in np.atleast_1d(found.status)]
        seconds += [again / many] * many
        compile_s.append(max(first - again, 0.0))
        if 2.0 * (time.perf_counter() - begin) > limit:
            break
    return Answer(x, w, seconds, statuses, build, compile_s[0]), iterations


def timed(call, limit: float):
    """(result, seconds of the first call, median of the next; both the first's if there is no time for another)."""
    import jax

    start = time.perf_counter()
    result = jax.block_until_ready(call())
    first = time.perf_counter() - start
    if first > limit:
        return result, first, first
    seconds = []
    for _ in range(_REPEATS):
        start = time.perf_counter()
        result = jax.block_until_ready(call())
        seconds.append(time.perf_counter() - start)
        if seconds[-1] > _SHARE_OF_REPEATS * limit:
            break
    return result, first, statistics.median(seconds)
