"""Derivatives of optimal values against differences of exact policy iteration."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
import small_models

from jaxhom import optimal_policy

STEP = 1e-5


def values(mdp, parameters):
    """Value and action value [.., S, A + 1] as a function of what they depend on."""
    parameters = dict(parameters)
    reward = parameters.pop("reward")
    found = optimal_policy(mdp.replace(**parameters), reward)
    return jnp.concatenate([found.value[..., None], found.action_value], axis=-1)


def oracle(case, parameters):
    transition = np.zeros((*case.shape, case.shape[0]))
    s, a = np.ogrid[: case.shape[0], : case.shape[1]]
    np.add.at(transition, (s[..., None], a[..., None], np.asarray(case.mdp.next_state)), parameters["probability"])
    value, action_value = oracles.optimal_value(transition, float(parameters["discount"]), parameters["reward"])
    return np.concatenate([value[:, None], action_value], axis=1)


def parameters_of(case, rng):
    """The arrays that values depend on, and a random direction in each."""
    probability = np.asarray(case.mdp.probability)
    parameters = {
        "reward": rng.normal(size=case.shape),
        "probability": probability,
        "discount": np.asarray(case.discount),
    }
    directions = {key: rng.normal(size=value.shape) for key, value in parameters.items()}
    directions["probability"] = directions["probability"] * (probability > 0)
    return parameters, directions


def differences(case, parameters, directions, key):
    ends = ({**parameters, key: parameters[key] + sign * STEP * directions[key]} for sign in (1, -1))
    high, low = (oracle(case, end) for end in ends)
    return (high - low) / (2 * STEP)


@pytest.mark.parametrize("name", ["dense", "sparse"])
def test_gradients_against_differences(name, rng):
    """Of value and action value together, by reverse mode under jit."""
    case = small_models.case(name)
    parameters, directions = parameters_of(case, rng)
    weight = rng.normal(size=(case.shape[0], case.shape[1] + 1))

    @jax.jit
    def gradients(parameters):
        return jax.grad(lambda parameters: jnp.vdot(weight, values(case.mdp, parameters)))(parameters)

    gradient = gradients(parameters)
    for key, direction in directions.items():
        expected = np.vdot(weight, differences(case, parameters, directions, key))
        scale = np.linalg.norm(gradient[key]) * np.linalg.norm(direction)
        assert abs(np.vdot(gradient[key], direction) - expected) <= 1e-6 * scale, key


def test_forward_mode_and_a_batch_of_rewards(rng):
    """Each lane along a direction of its own; the policy is a constant."""
    case = small_models.case("dense")
    rewards, directions = rng.normal(size=(2, 3, *case.shape))
    plan = functools.partial(optimal_policy, case.mdp)
    change = jax.jit(lambda *pair: jax.jvp(plan, pair[:1], pair[1:])[1])(rewards, directions)
    parameters, _ = parameters_of(case, rng)
    for lane in range(3):
        here = {**parameters, "reward": rewards[lane]}
        expected = differences(case, here, {"reward": directions[lane]}, "reward")
        np.testing.assert_allclose(change.value[lane], expected[:, 0], rtol=0, atol=1e-6)
        np.testing.assert_allclose(change.action_value[lane], expected[:, 1:], rtol=0, atol=1e-6)
    np.testing.assert_array_equal(change.policy, 0.0)


def test_vmap_and_second_derivatives(rng):
    """In the discount, of which values are rational functions between the kinks."""
    case = small_models.case("dense")
    parameters, _ = parameters_of(case, rng)
    discounts = np.array([0.3, case.discount])

    def total(discount):
        return values(case.mdp, {**parameters, "discount": discount}).sum()

    first = jax.jit(jax.vmap(jax.grad(total)))(discounts)
    second = jax.jit(jax.grad(jax.grad(total)))(discounts[1])
    step = 1e-4
    at = [
        [oracle(case, {**parameters, "discount": discount + move}).sum() for move in (-step, 0.0, step)]
        for discount in discounts
    ]
    np.testing.assert_allclose(first, [(high - low) / (2 * step) for low, _, high in at], rtol=1e-5)
    low, middle, high = at[1]
    np.testing.assert_allclose(second, (high - 2 * middle + low) / step**2, rtol=1e-4)


def test_a_subgradient_at_ties(rng):
    """All actions alike: V* is convex in the reward and nowhere below what the gradient says."""
    case = small_models.case("dense")
    transition = np.repeat(case.transition[:, :1], case.shape[1], axis=1)
    mdp, reward = case.mdp.replace(probability=transition), np.ones(case.shape)
    value, gradient = jax.value_and_grad(lambda reward: optimal_policy(mdp, reward).value @ case.initial)(reward)
    for _ in range(10):
        other = rng.normal(size=case.shape)
        best = oracles.optimal_value(transition, case.discount, other)[0] @ case.initial
        assert best >= value + np.vdot(gradient, other - reward) - 1e-8
