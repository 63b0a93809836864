"""Sweeps over one model: loops that compile once, batches of models under vmap."""

import collections
import contextlib

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
import small_models

from jaxhom import MDP, feature_expectations, lpal, occupancy, optimal_policy, policy_value

DISCOUNTS = (0.5, 0.8, 0.9, 0.95, 0.98)


@contextlib.contextmanager
def compilations():
    """Counts, by function, what JAX traces or compiles inside."""
    counts = collections.Counter()

    def count(event, duration, **details):
        if event in ("/jax/core/compile/jaxpr_trace_duration", "/jax/core/compile/backend_compile_duration"):
            counts[details.get("fun_name")] += 1

    jax.monitoring.register_event_duration_secs_listener(count)
    try:
        yield counts
    finally:
        jax.monitoring.unregister_event_duration_listener(count)


def test_compilations_are_counted():
    double = jax.jit(lambda x: 2 * x)
    with compilations() as counts:
        double(np.ones(3))
    assert counts
    with compilations() as counts:
        double(np.zeros(3))
    assert not counts
    with compilations() as counts:
        double(np.ones(4))
    assert counts


def small_model():
    """Six states, six features, and expectations of eight lanes per unit of 1 / (1 - discount)."""
    rng = np.random.default_rng(6)
    transition, discount, initial, features = oracles.random_mdp(rng, 6, 2, K=6)
    mdp = MDP.from_dense(transition, discount=discount, initial=initial, features=features)
    per_step = 0.1 * oracles.feature_expectations(
        transition, discount, initial, features, small_models.random_policy(rng, 6, 2)
    )
    return mdp, per_step * rng.uniform(0.8, 1.2, size=(8, 6))


@pytest.mark.parametrize("method", ["columns", "interior_point"])
def test_lpal_over_discounts_and_initial_distributions_compiles_once(method, rng):
    mdp, per_step = small_model()
    lpal(mdp, per_step / (1 - 0.9), method=method)
    initials = rng.dirichlet(np.ones(6), size=5)
    with compilations() as counts:
        by_discount = [
            lpal(mdp.replace(discount=discount), per_step / (1 - discount), method=method) for discount in DISCOUNTS
        ]
        by_initial = [lpal(mdp.replace(initial=initial), per_step / (1 - 0.9), method=method) for initial in initials]
    assert not counts, counts
    cases = [(discount, mdp.initial) for discount in DISCOUNTS] + [(0.9, initial) for initial in initials]
    transition, features = np.asarray(mdp.transition), np.asarray(mdp.features)
    for (discount, initial), solution in zip(cases, by_discount + by_initial, strict=True):
        for lane, expected in enumerate(per_step[:2] / (1 - discount)):
            best = oracles.lpal(transition, discount, np.asarray(initial), features, expected)[0]
            low, high = float(solution.margin[lane]), float(solution.margin_bound[lane])
            assert low - 1e-8 <= best <= high + 1e-8
            assert high - low <= 1e-5 / (1 - discount)


def test_planning_and_occupancies_over_discounts_compile_once(rng):
    mdp, _ = small_model()
    reward, policy = rng.normal(size=(6, 2)), small_models.random_policy(rng, 6, 2)

    def all_of(mdp):
        return (
            occupancy(mdp, policy),
            feature_expectations(mdp, policy),
            policy_value(mdp, policy, reward),
            optimal_policy(mdp, reward),
        )

    all_of(mdp)
    with compilations() as counts:
        for discount in DISCOUNTS:
            all_of(mdp.replace(discount=discount))
    assert not counts, counts


@pytest.mark.parametrize("name", ["dense", "sparse"])
def test_batches_of_models_agree_with_numpy(name, rng):
    """Models that differ in discount, initial distribution and probabilities, stacked leaf by leaf."""
    case = small_models.case(name)
    models = []
    for discount in (0.3, 0.9, 0.97):
        weights = rng.uniform(0.5, 1.5, size=case.mdp.probability.shape) * np.asarray(case.mdp.probability)
        probability = weights / weights.sum(axis=-1, keepdims=True)
        initial = rng.dirichlet(np.ones(case.shape[0]))
        models.append(case.mdp.replace(discount=discount, initial=initial, probability=probability))
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *models)
    policy, reward = small_models.random_policy(rng, *case.shape), rng.normal(size=case.shape)

    @jax.jit
    @jax.vmap
    def all_of(mdp):
        plan = optimal_policy(mdp, reward)
        return {
            "occupancy": occupancy(mdp, policy),
            "expectations": feature_expectations(mdp, policy),
            "policy_value": policy_value(mdp, policy, reward),
            "value": plan.value,
            "policy": plan.policy,
        }

    found = all_of(stacked)
    for i, mdp in enumerate(models):
        transition, discount = small_models.dense_transition(mdp), float(mdp.discount)
        arrays = transition, discount, np.asarray(mdp.initial)
        value, action_value = oracles.optimal_value(transition, discount, reward)
        expected = {
            "occupancy": oracles.occupancy(*arrays, policy),
            "expectations": oracles.feature_expectations(*arrays, case.features, policy),
            "policy_value": oracles.policy_value(transition, discount, policy, reward),
            "value": value,
            "policy": np.eye(case.shape[1])[action_value.argmax(axis=1)],
        }
        for key, lanes in found.items():
            np.testing.assert_allclose(lanes[i], expected[key], rtol=0, atol=1e-7, err_msg=key)
