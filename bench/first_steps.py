"""One step of the README's way in a fresh process, by this library or by a peer: what whoever calls it first waits for.

    python -m bench.first_steps STEP METHOD

prints the seconds of the first call and of the second one as JSON. What a step is given is made beforehand, by means
that compile nothing. `bench.first_speed` starts these processes.
"""

import functools
import json
import sys
import time
from collections.abc import Callable
from typing import Any

SIZE, REGIONS = 16, 64  # section VI.A
LAKE = 8


def main(step: str, method: str) -> dict[str, float]:
    """Seconds of the first and of the second call."""
    if step not in STEPS:
        return {"first_s": _import_seconds()}
    call = STEPS[step][method]()
    return {"first_s": _seconds(call), "seconds": _seconds(call)}


def _seconds(call: Callable[[], Any]) -> float:
    begun = time.perf_counter()
    found = call()
    if "jax" in sys.modules:
        sys.modules["jax"].block_until_ready(found)
    return time.perf_counter() - begun


def _import_seconds() -> float:
    """Beyond what JAX takes itself."""
    import jax  # noqa: F401

    begun = time.perf_counter()
    import jaxhom  # noqa: F401

    return time.perf_counter() - begun


# ------------------------------------------------------------------------------------------------- what steps are given


def _library():
    import jax

    jax.config.update("jax_enable_x64", True)
    import jaxhom
    from jaxhom import programs

    programs.keep_programs()
    return jaxhom


def _given(size: int = SIZE, regions: int = REGIONS):
    """A model, a reward [S, A], a policy [S, A] and walks of it, drawn by NumPy."""
    import numpy as np

    jaxhom, rng = _library(), np.random.default_rng(0)
    mdp = jaxhom.gridworld(size, num_regions=regions).mdp
    weights = np.where(rng.random(regions) < 0.1, rng.random(regions), 0.0)
    weights[-1] = 0.5
    reward = np.asarray(mdp.features) @ weights
    policy = 0.9 * np.asarray(jaxhom.optimal_policy(mdp, reward).policy) + 0.1 / mdp.num_actions
    walks = [_walk(rng, mdp, policy, 50) for _ in range(10)]
    return jaxhom, mdp, reward, policy, jaxhom.Demonstrations.from_trajectories(walks)


def _walk(rng, mdp, policy, steps: int) -> tuple[list[int], list[int]]:
    import numpy as np

    next_state, probability = np.asarray(mdp.next_state), np.asarray(mdp.probability)
    state, states, actions = int(rng.choice(mdp.num_states, p=np.asarray(mdp.initial))), [], []
    for _ in range(steps):
        action = int(rng.choice(mdp.num_actions, p=policy[state]))
        states.append(state)
        actions.append(action)
        state = int(rng.choice(next_state[state, action], p=probability[state, action]))
    return states, actions


# ----------------------------------------------------------------------------------------------------------------- ours


def _planning():
    jaxhom, mdp, reward, *_ = _given()
    return lambda: jaxhom.optimal_policy(mdp, reward)


def _sampling():
    import jax

    jaxhom, mdp, _, policy, _ = _given()
    return lambda: jaxhom.sample_demonstrations(jax.random.key(1), mdp, policy, 10, 50)


def _algorithm1():
    jaxhom, mdp, _, _, walks = _given()
    return lambda: jaxhom.soft_local_homomorphism(mdp, walks)


def _expectations():
    jaxhom, mdp, _, policy, _ = _given()
    return lambda: jaxhom.feature_expectations(mdp, policy)


def _lpal():
    jaxhom, mdp, _, policy, _ = _given()
    expectations = jaxhom.feature_expectations(mdp, policy)
    return lambda: jaxhom.lpal(mdp, expectations, initial_policy=policy)


def _two_pairs():
    jaxhom, mdp, *_ = _given()
    return lambda: jaxhom.local_similarity(mdp, [0, 17], [1, 34])


def _evaluation():
    jaxhom, mdp, reward, policy, _ = _given()
    return lambda: jaxhom.policy_value(mdp, policy, reward) @ mdp.initial


def _global(size: int, regions: int):
    jaxhom, mdp, _, _, walks = _given(size, regions)
    return lambda: jaxhom.soft_homomorphism(mdp, walks)


def _track():
    """Racetrack (a), and 10 walks of its best policy, which is found on the host."""
    import numpy as np

    from jaxhom.planning import policy_iteration
    from jaxhom.planning.host_chains import host_model

    jaxhom, rng = _library(), np.random.default_rng(0)
    track = jaxhom.racetrack("a")
    reward = np.asarray(track.mdp.features) @ np.asarray(track.weights)
    plan = policy_iteration.iterate(host_model(track.mdp), reward, reward.argmax(axis=1), np.finfo(float).eps)
    walks = [_walk(rng, track.mdp, np.eye(track.mdp.num_actions)[plan.actions], 20) for _ in range(10)]
    return jaxhom, track.mdp, jaxhom.Demonstrations.from_trajectories(walks)


def _weights_of_grid():
    jaxhom, mdp, _, _, walks = _given()
    return lambda: jaxhom.max_causal_entropy(mdp, walks)


def _weights_of_track():
    jaxhom, mdp, walks = _track()
    return lambda: jaxhom.max_causal_entropy(mdp, walks)


def _learner(name: str, **options):
    jaxhom, mdp, _, policy, _ = _given()
    expectations = jaxhom.feature_expectations(mdp, policy)
    return lambda: getattr(jaxhom, name)(mdp, 0.99 * expectations, **options)


def _loss_on_grid():
    jaxhom, mdp, _, policy, walks = _given()
    return lambda: jaxhom.loss_bound(mdp, walks, policy)


def _loss_on_track():
    jaxhom, mdp, walks = _track()
    general = jaxhom.uniform_elsewhere(mdp, walks)
    return lambda: jaxhom.loss_bound(mdp, walks, general.policy)


def _robust():
    jaxhom, mdp, *_, walks = _given()
    return lambda: jaxhom.robust_policy(mdp, walks)


def _questions():
    jaxhom, mdp, _, policy, walks = _given()
    return lambda: jaxhom.query_states(mdp, walks, policy, 20)


def _whole():
    """From nothing to the learned policy's value, with everything that a script would do on the way."""
    jaxhom = _library()
    import jax

    def call():
        mdp = jaxhom.gridworld(SIZE, num_regions=REGIONS).mdp
        reward = mdp.features @ jaxhom.sample_weights(jax.random.key(0), REGIONS)
        expert = jaxhom.optimal_policy(mdp, reward)
        walks = jaxhom.sample_demonstrations(jax.random.key(1), mdp, expert.policy, 10, 50)
        general = jaxhom.soft_local_homomorphism(mdp, walks)
        expectations = jaxhom.feature_expectations(mdp, general.policy)
        learned = jaxhom.lpal(mdp, expectations, initial_policy=general.policy)
        again = jaxhom.lpal(mdp, 0.99 * expectations)
        pairs = jaxhom.local_similarity(mdp, [0, 17], [1, 34])
        value = jaxhom.policy_value(mdp, learned.policy, reward) @ mdp.initial
        return again, pairs, value, jaxhom.soft_homomorphism(mdp, walks)

    return call


def _second_map():
    """All steps on another map of the same size, after the first one."""
    import jax
    import numpy as np

    jaxhom = _library()

    def steps(seed: int):
        free = np.random.default_rng(seed).random((LAKE, LAKE)) < 0.8
        free[0, 0] = free[-1, -1] = True
        mdp = _slippery(jaxhom, free)
        reward = np.zeros((LAKE**2, 4))
        reward[-1] = 1.0
        expert = jaxhom.optimal_policy(mdp, reward)
        walks = jaxhom.sample_demonstrations(jax.random.key(seed), mdp, expert.policy, 4, 20)
        general = jaxhom.soft_local_homomorphism(mdp, walks)
        expectations = jaxhom.feature_expectations(mdp, general.policy)
        learned = jaxhom.lpal(mdp, expectations, initial_policy=general.policy)
        pairs = jaxhom.local_similarity(mdp, [0, 9], [1, 18])
        trial = jaxhom.evaluate_exactly(mdp, learned.policy, reward, 50)
        return learned, pairs, trial, jaxhom.monte_carlo_feature_expectations(mdp, walks)

    jax.block_until_ready(steps(0))
    seeds = iter((1, 2))
    return lambda: steps(next(seeds))


def _slippery(jaxhom, free):
    """A lake: a step goes the wanted way or to either side of it, a third each; holes absorb."""
    import numpy as np

    cells = np.stack(np.divmod(np.arange(LAKE**2), LAKE), axis=1)
    moves = np.array([(0, -1), (1, 0), (0, 1), (-1, 0)])
    landing = np.clip(cells[:, None] + moves, 0, LAKE - 1) @ [LAKE, 1]
    ways = (np.arange(4)[:, None] + [-1, 0, 1]) % 4
    next_state = np.where(free.ravel()[:, None, None], landing[:, ways], np.arange(LAKE**2)[:, None, None])
    features = np.stack([~free.ravel() * -1.0, np.arange(LAKE**2) == LAKE**2 - 1], axis=1)
    return jaxhom.MDP.from_successors(next_state, np.full(next_state.shape, 1 / 3), discount=0.95, features=features)


# ---------------------------------------------------------------------------------------------------------------- peers


def _quantecon():
    from bench.models import Model
    from bench.planning_peers import QuantEcon

    _, mdp, reward, *_ = _given()
    peer = QuantEcon("planning", "policy_iteration", Model.of(mdp), tolerance=1e-6)

    def call():
        peer.load([(reward, None)])
        return peer.solve(60.0)

    return call


def _lpal_peer():
    import numpy as np

    from bench.linear_programs import Lpal
    from bench.lp_peers import PEERS, Opened, Settings
    from bench.models import Model

    jaxhom, mdp, _, policy, _ = _given()
    expectations = np.asarray(jaxhom.feature_expectations(mdp, policy))
    model, settings = Model.of(mdp), Settings(1e-6, form="dual")
    PEERS["clarabel"]  # fails here where it is not installed

    def call():
        peer = Opened("clarabel", settings, functools.partial(Lpal, model, "dual", False), threads=1, limit=60.0)
        peer.load([expectations])
        return peer.solve(60.0)

    return call


def _global_peer(size: int, regions: int):
    import numpy as np

    from bench.linear_programs import Homomorphisms
    from bench.lp_peers import Highs, Settings
    from jaxhom.similarity.local_models import restricted_model

    _, mdp, _, _, walks = _given(size, regions)
    experts = np.unique(np.asarray(walks.states))
    pair = np.asarray(mdp.transition), restricted_model(mdp, experts)

    def call():
        peer = Highs("ipm", Settings(1e-5), threads=1)
        peer.load([Homomorphisms(*pair, anchored=False).given(pair)])
        return peer.solve(300.0)

    return call


STEPS: dict[str, dict[str, Callable[[], Callable[[], Any]]]] = {
    "planning": {"jaxhom": _planning, "quantecon": _quantecon},
    "sampling": {"jaxhom": _sampling},
    "Algorithm 1": {"jaxhom": _algorithm1},
    "expectations": {"jaxhom": _expectations},
    "LPAL": {"jaxhom": _lpal, "clarabel": _lpal_peer},
    "two pairs": {"jaxhom": _two_pairs},
    "evaluation": {"jaxhom": _evaluation},
    "LP (8), 36 states": {
        "jaxhom": functools.partial(_global, 6, 9),
        "highs_interior_point": functools.partial(_global_peer, 6, 9),
    },
    "LP (8), 256 states": {"jaxhom": functools.partial(_global, SIZE, REGIONS)},
    "max. causal entropy": {"jaxhom": _weights_of_grid},
    "max. causal entropy, racetrack (a)": {"jaxhom": _weights_of_track},
    "projection": {"jaxhom": functools.partial(_learner, "projection", max_iterations=100)},
    "MWAL, 100 rounds": {"jaxhom": functools.partial(_learner, "mwal", max_iterations=100)},
    "loss bound, 64 features": {"jaxhom": _loss_on_grid},
    "loss bound, racetrack (a)": {"jaxhom": _loss_on_track},
    "robust policy, 64 features": {"jaxhom": _robust},
    "20 queries": {"jaxhom": _questions},
    "the whole way": {"jaxhom": _whole},
    "a second 8x8 map": {"jaxhom": _second_map},
}

if __name__ == "__main__":
    print(json.dumps(main(*sys.argv[1:])))
