"""Models of one shape share their programs: after two random maps a third one compiles nothing, step by step.

A program is counted when XLA is asked for it, whether it is compiled then or found in a folder.
"""

import functools
from types import SimpleNamespace

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium.envs.toy_text.frozen_lake import generate_random_map

import jaxhom
import jaxhom.interop

programs = 0  # since the start


def _count(event, *_, **__):
    global programs
    programs += "backend_compile" in event


jax.monitoring.register_event_duration_secs_listener(_count)


@functools.cache
def lake(size, seed):
    """A random map, and what the steps take beside its model."""
    desc, states = generate_random_map(size=size, seed=seed), size**2
    columns = np.eye(states)[:, :: states // 16]
    env = gymnasium.make("FrozenLake-v1", desc=desc)
    model = jaxhom.interop.from_gymnasium(env, discount=0.95, features=columns)
    rng = np.random.default_rng(seed)
    policies = rng.dirichlet(np.ones(4), (8, states))
    walks = jaxhom.sample_demonstrations(jax.random.key(seed), model.mdp, policies[0], 6, 20)
    return SimpleNamespace(
        mdp=model.mdp,
        near=model.mdp.replace(discount=np.asarray(0.9)),
        reward=model.reward,
        rewards=rng.uniform(size=(8, states, 4)),
        policy=policies[0],
        policies=policies,
        walks=walks,
        vhat=0.9 * jaxhom.feature_expectations(model.mdp, policies[1]),
        key=jax.random.key(seed),
        cells=np.stack(np.divmod(np.arange(states), size), axis=1),
        states=np.arange(0, states, 3),
    )


STEPS = {
    "plan": lambda m: jaxhom.optimal_policy(m.mdp, m.reward),
    "plans": lambda m: jaxhom.optimal_policy(m.mdp, m.rewards),
    "plan, discount 0.9": lambda m: jaxhom.optimal_policy(m.near, m.reward),
    "plans, discount 0.9": lambda m: jaxhom.optimal_policy(m.near, m.rewards),
    "occupancy": lambda m: jaxhom.occupancy(m.mdp, m.policy),
    "occupancies": lambda m: jaxhom.occupancy(m.mdp, m.policies),
    "expectations": lambda m: jaxhom.feature_expectations(m.mdp, m.policies),
    "values": lambda m: jaxhom.policy_value(m.mdp, m.policies, m.rewards),
    "draws": lambda m: jaxhom.sample_demonstrations(m.key, m.mdp, m.policy, 6, 20),
    "empirical": lambda m: jaxhom.empirical_policy(m.mdp, m.walks),
    "monte carlo": lambda m: jaxhom.monte_carlo_feature_expectations(m.mdp, m.walks),
    "algorithm 1": lambda m: jaxhom.soft_local_homomorphism(m.mdp, m.walks, threshold=0.1),
    "neighbours": lambda m: jaxhom.nearest_neighbors(m.mdp, m.walks),
    "neighbours in space": lambda m: jaxhom.nearest_neighbors(m.mdp, m.walks, metric="euclidean", coordinates=m.cells),
    "uniform": lambda m: jaxhom.uniform_elsewhere(m.mdp, m.walks),
    "global map": lambda m: jaxhom.soft_homomorphism(m.mdp, m.walks, tolerance=3e-2),
    "lpal": lambda m: jaxhom.lpal(m.mdp, m.vhat),
    "lpal, columns": lambda m: jaxhom.lpal(m.mdp, m.vhat, method="columns"),
    "lpal, interior point": lambda m: jaxhom.lpal(m.mdp, m.vhat, method="interior_point"),
    "similarity": lambda m: jaxhom.local_similarity(m.mdp, m.states, m.states[::-1]),
    "trials": lambda m: jaxhom.evaluate_exactly(m.mdp, m.policy, m.reward, 10),
    "drawn trials": lambda m: jaxhom.evaluate_by_sampling(m.key, m.mdp, m.policy, m.reward, 10, num_trials=20),
    "agreement": lambda m: jaxhom.agreement(m.mdp, m.policy, m.policies[1]),
}


def compiled_for_the_third(step, size):
    """Programs that a third map asks for; the first ones may differ in what a step does in turn."""
    for seed in range(2):
        step(lake(size, seed))
    third = lake(size, 2)
    before = programs
    jax.block_until_ready(jax.tree.leaves(step(third)))
    return programs - before


@pytest.mark.parametrize("size", [8, 16])
@pytest.mark.parametrize("name", STEPS)
def test_a_third_map_compiles_nothing(name, size):
    assert compiled_for_the_third(STEPS[name], size) == 0


def test_the_count_sees_programs():
    before = programs
    jax.jit(lambda x: 3 * x)(np.ones(17))
    assert programs > before


def path(mdp, key, reward, policy):
    """A program whose argument is the model."""
    plan = jaxhom.optimal_policy(mdp, reward)
    walks = jaxhom.sample_demonstrations(key, mdp, plan.policy, 3, 5)
    vhat = jaxhom.monte_carlo_feature_expectations(mdp, walks)
    value = jaxhom.policy_value(mdp, policy, reward)
    gradient = jax.grad(lambda policy: jaxhom.feature_expectations(mdp, policy).sum())(policy)
    return vhat, value, gradient


@pytest.mark.parametrize("size", [8, 16])
def test_models_as_arguments(size):
    program = jax.jit(path)
    assert compiled_for_the_third(lambda m: program(m.mdp, m.key, m.reward, m.policy), size) == 0


def test_lpal_of_models_as_arguments():
    program = jax.jit(lambda mdp, vhat, policy: jaxhom.lpal(mdp, vhat, initial_policy=policy).policy)
    assert compiled_for_the_third(lambda m: program(m.mdp, m.vhat, m.policy), 8) == 0


def test_stacks_of_as_many():
    program = jax.jit(jax.vmap(lambda mdp, reward: jaxhom.optimal_policy(mdp, reward).value))

    def run(first):
        lakes = [lake(8, first + k) for k in range(2)]
        program(jaxhom.stack_models([m.mdp for m in lakes]), np.stack([m.reward for m in lakes]))

    lake(8, 2), run(0)
    before = programs
    run(1)
    assert programs == before
