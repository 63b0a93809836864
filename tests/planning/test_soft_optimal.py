"""Soft optimal policies against soft value iteration in NumPy, closed forms and finite differences."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
import small_models

import jaxhom
from jaxhom.models.mdp import MDP
from jaxhom.planning import soft_optimal

LIMITS = {"on the host": None, "in a program": jax.jit}


def way(kind, function):
    return jax.jit(function) if kind == "in a program" else function


@pytest.mark.parametrize("kind", LIMITS)
def test_against_sweeps(case, kind):
    reward = 3.0 * case.features[..., 0]
    plan = way(kind, lambda reward: jaxhom.soft_optimal_policy(case.mdp, reward, temperature=0.7))(reward)
    policy, value, action_value = oracles.soft_optimal(case.transition, case.discount, reward, 0.7)
    np.testing.assert_allclose(plan.value, value, rtol=1e-9)
    np.testing.assert_allclose(plan.action_value, action_value, rtol=1e-9)
    np.testing.assert_allclose(plan.policy, policy, atol=1e-8)
    assert plan.status == jaxhom.Status.SOLVED
    assert plan.residual <= 1e-9


def test_one_state_in_closed_form():
    """V = tau log sum exp(r / tau) / (1 - gamma)."""
    mdp = MDP.from_dense(np.ones((1, 3, 1)), discount=0.8)
    reward = np.array([[1.0, 2.0, -4.0]])
    plan = jaxhom.soft_optimal_policy(mdp, reward, temperature=0.5)
    np.testing.assert_allclose(plan.value, 0.5 * np.log(np.exp(reward / 0.5).sum()) / 0.2)
    np.testing.assert_allclose(plan.policy, np.exp(reward / 0.5) / np.exp(reward / 0.5).sum())


@pytest.mark.parametrize("kind", LIMITS)
def test_towards_no_temperature_it_is_the_optimum(kind):
    mdp = jaxhom.gridworld(4, num_regions=4).mdp
    reward = mdp.features @ jnp.array([0.1, 0.2, 0.3, 1.0])
    best = jaxhom.optimal_policy(mdp, reward)
    plan = way(kind, lambda reward: jaxhom.soft_optimal_policy(mdp, reward, temperature=1e-4))(reward)
    # All that entropy can add is log A per step.
    assert (plan.value >= best.value - 1e-9).all()
    assert (plan.value <= best.value + 1e-4 * np.log(4) / 0.01 + 1e-9).all()


@pytest.mark.parametrize("kind", LIMITS)
def test_values_far_apart_at_a_discount_near_1(kind):
    """Two recurrent classes: sweeps would take millions."""
    transition = np.eye(3)[np.array([[1, 2], [1, 1], [2, 2]])]
    mdp = MDP.from_dense(transition, discount=0.999999)
    reward = np.array([[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]])
    plan = way(kind, lambda reward: jaxhom.soft_optimal_policy(mdp, reward))(reward)
    exact = (np.array([1.0, 2.0]) + np.log(2)) / 1e-6
    np.testing.assert_allclose(plan.value[1:], exact, rtol=1e-9)
    np.testing.assert_allclose(plan.policy[0], [0, 1], atol=1e-9)
    assert plan.status == jaxhom.Status.SOLVED


@pytest.mark.parametrize("kind", LIMITS)
def test_missing_and_forbidden_actions(kind):
    rng = np.random.default_rng(0)
    transition, discount, _, features = oracles.random_mdp(rng, 6, 3)
    allowed = np.ones((6, 3), bool)
    allowed[[1, 4], [0, 2]] = False
    mdp = MDP.from_dense(transition, discount=discount, allowed=allowed)
    reward = np.array(features[..., 0])
    reward[2, 1] = -np.inf
    expected = oracles.soft_optimal(transition, discount, np.where(allowed, reward, -np.inf))
    plan = way(kind, lambda reward: jaxhom.soft_optimal_policy(mdp, reward))(reward)
    np.testing.assert_allclose(plan.policy, expected[0], atol=1e-9)
    assert (plan.policy[~allowed] == 0).all() and plan.policy[2, 1] == 0
    assert (plan.action_value[~allowed] == -np.inf).all()


@pytest.mark.parametrize("lanes", [2, 6])
def test_batches_are_lane_by_lane(lanes):
    """Few lanes on the host, many in a program."""
    case = small_models.case("sparse")
    rewards = np.random.default_rng(1).normal(size=(lanes, *case.shape))
    plans = jaxhom.soft_optimal_policy(case.mdp, rewards)
    mapped = jax.vmap(lambda reward: jaxhom.soft_optimal_policy(case.mdp, reward))(rewards)
    for lane, reward in enumerate(rewards):
        one = jaxhom.soft_optimal_policy(case.mdp, reward)
        for many in (plans, mapped):
            np.testing.assert_allclose(many.value[lane], one.value, rtol=1e-9)
            np.testing.assert_allclose(many.policy[lane], one.policy, atol=1e-9)


def test_float32():
    case = small_models.in_float32(small_models.case("sparse"))
    reward = case.features[..., 1]
    plan = jaxhom.soft_optimal_policy(case.mdp, reward)
    chex.assert_type([plan.policy, plan.value, plan.residual], jnp.float32)
    value = oracles.soft_optimal(case.transition, case.discount, reward)[1]
    assert np.abs(plan.value - value).max() <= plan.residual / (1 - case.discount) + 1e-6
    inside = jax.jit(lambda reward: jaxhom.soft_optimal_policy(case.mdp, reward))(reward)
    assert inside.status == jaxhom.Status.SOLVED
    assert np.abs(inside.value - value).max() <= inside.residual / (1 - case.discount)


def test_a_former_value_is_a_start():
    case = small_models.case("sparse")
    reward = case.features[..., 0]
    plan = jaxhom.soft_optimal_policy(case.mdp, reward)
    assert jaxhom.soft_optimal_policy(case.mdp, reward, initial_value=plan.value).iterations == 0
    limited = jaxhom.soft_optimal_policy(case.mdp, reward, max_iterations=1)
    assert limited.status == jaxhom.Status.ITERATION_LIMIT
    assert np.abs(limited.value - plan.value).max() <= limited.residual / (1 - case.discount)
    strict = jaxhom.soft_optimal_policy(case.mdp, reward, tolerance=1e-30)
    assert strict.status == jaxhom.Status.STALLED


def test_products_stand_in_for_factors(monkeypatch):
    """On graphs that fill up chains are solved by products, and by factors where those fail."""
    case = small_models.case("restart")
    reward = case.features[..., 0]
    plan = jaxhom.soft_optimal_policy(case.mdp, reward)
    monkeypatch.setattr(type(soft_optimal.host_model(case.mdp)), "is_soon_factorised", False)
    np.testing.assert_allclose(jaxhom.soft_optimal_policy(case.mdp, reward).value, plan.value, rtol=1e-9)
    monkeypatch.setattr("jaxhom.planning.host_chains._MAX_PRODUCTS", 1)
    np.testing.assert_allclose(jaxhom.soft_optimal_policy(case.mdp, reward).value, plan.value, rtol=1e-9)


def differences(function, x, step=1e-5):
    """The gradient by central differences."""
    x = np.asarray(x, float)
    flat = x.ravel()
    out = np.zeros(flat.size)
    for i in range(flat.size):
        high, low = flat.copy(), flat.copy()
        high[i], low[i] = high[i] + step, low[i] - step
        out[i] = (function(high.reshape(x.shape)) - function(low.reshape(x.shape))) / (2 * step)
    return out.reshape(x.shape)


def test_derivatives_of_values_and_policies():
    """In reward, temperature, discount and transitions; missing actions among them."""
    rng = np.random.default_rng(2)
    transition, discount, initial, features = oracles.random_mdp(rng, 4, 3)
    allowed = np.ones((4, 3), bool)
    allowed[1, 2] = False
    mdp = MDP.from_dense(transition, discount=discount, allowed=allowed)
    reward, probe = np.where(allowed, features[..., 0], 0.0), rng.normal(size=(4, 3))

    def number(reward, temperature, discount, tilt):
        changed = mdp.replace(probability=mdp.probability * (1 + tilt[..., None] * mdp.probability), discount=discount)
        plan = jaxhom.soft_optimal_policy(changed, reward, temperature=temperature)
        return (plan.policy * probe).sum() + plan.value @ initial

    def oracle(reward, temperature, discount, tilt):
        probability = np.where(allowed[..., None], transition, 0.0)
        tilted = probability * (1 + tilt[..., None] * probability)
        reward = np.where(allowed, reward, -np.inf)
        policy, value, _ = oracles.soft_optimal(tilted, discount, reward, temperature)
        return (policy * probe).sum() + value @ initial

    point = (reward, 0.6, discount, np.zeros((4, 3)))
    gradient = jax.grad(number, argnums=(0, 1, 2, 3))(*map(jnp.asarray, point))
    for index, found in enumerate(gradient):
        at = lambda x, index=index: oracle(*point[:index], x, *point[index + 1 :])  # noqa: E731
        np.testing.assert_allclose(found, differences(at, point[index]) * np.ones_like(found), atol=2e-6)


def test_second_derivatives():
    case = small_models.case("dense")

    def number(reward):
        return jaxhom.soft_optimal_policy(case.mdp, reward).value @ case.initial

    reward = jnp.asarray(case.features[..., 0])
    hessian = jax.jacfwd(jax.grad(number))(reward)
    column = (jax.grad(number)(reward.at[2, 1].add(1e-5)) - jax.grad(number)(reward.at[2, 1].add(-1e-5))) / 2e-5
    np.testing.assert_allclose(hessian[2, 1], column, atol=1e-8)
    np.testing.assert_allclose(hessian, hessian.transpose(2, 3, 0, 1), atol=1e-9)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"temperature": 0.0}, "temperature must be positive"),
        ({"temperature": [1.0, 2.0]}, "temperature must be a number"),
        ({"temperature": np.nan}, "temperature must be finite"),
        ({"tolerance": 0.0}, "tolerance must be positive"),
        ({"tolerance": [0.1, 0.1]}, "tolerance must be a number"),
        ({"max_iterations": 0}, "max_iterations must be at least 1"),
        ({"initial_value": np.zeros(3)}, "initial_value must have shape"),
        ({"initial_value": np.full(7, np.inf)}, r"initial_value\[0\] must be finite"),
    ],
)
def test_bad_options_are_refused(options, message):
    case = small_models.case("dense")
    with pytest.raises(ValueError, match=message):
        jaxhom.soft_optimal_policy(case.mdp, case.features[..., 0], **options)
