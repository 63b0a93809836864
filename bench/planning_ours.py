"""Planning, occupancies and values by this library, timed; run in a process of its own by `bench.limits`."""

import time

import numpy as np

from bench.lpal_ours import timed
from bench.planning_peers import Results


def solve(name: str, work: str, rewards, policies, tolerance: float, limit: float, batch: bool) -> Results:
    """Lanes [B, S, A] of rewards, or policies with rewards, one by one or all together."""
    import jax

    jax.config.update("jax_enable_x64", True)
    import jax.numpy as jnp

    import jaxhom
    from bench.planning_instances import build

    start = time.perf_counter()
    mdp = jax.block_until_ready(build(name))
    build_s = time.perf_counter() - start
    rewards = jnp.asarray(rewards)
    policies = None if policies is None else jnp.asarray(policies)

    def call(part):
        if work == "planning":
            return jaxhom.optimal_policy(mdp, rewards[part], tolerance=tolerance)
        if work == "occupancy":
            return jaxhom.occupancy(mdp, policies[part])
        return jaxhom.policy_value(mdp, policies[part], rewards[part])

    found, seconds, iterations, compile_s = [], [], [], []
    begin = time.perf_counter()
    for part in [slice(None)] if batch else range(len(rewards)):
        result, first, again = timed(lambda part=part: call(part), limit)
        many = len(rewards) if batch else 1
        if work == "planning":
            iterations += np.atleast_1d(result.iterations).tolist()
            result = result.policy.argmax(axis=-1)
        array = np.asarray(result)
        found += list(array if batch else array[None])
        seconds += [again / many] * many
        compile_s.append(max(first - again, 0.0))
        if 2.0 * (time.perf_counter() - begin) > limit:
            break
    return Results(found, seconds, build_s, compile_s[0], iterations)
