"""Derivatives of LPAL's margin against finite differences of HiGHS's optimum, and inequalities where it has kinks."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
import small_models

from jaxhom import MDP, feature_expectations, lpal
from jaxhom.apprenticeship import lpal as lpal_module

PARAMETERS = ("probability", "initial", "features", "discount", "expectations")
STEP = 1e-5
TOLERANCE = 1e-9  # weights are as exact as the gap is small


class Instance(NamedTuple):
    """A model with its arrays, expectations around what policies reach, and the method that solves it."""

    mdp: MDP
    arrays: dict
    method: str


@functools.cache
def instance(name):
    """The dense one has the shapes of other LPAL tests, whose compiled functions it shares."""
    rng = np.random.default_rng(6)
    if name == "dense":
        method, lanes = "columns", 8
        transition, discount, initial, features = oracles.random_mdp(rng, 6, 2, K=6)
        mdp = MDP.from_dense(transition, discount=discount, initial=initial, features=features)
    else:
        method, lanes = "interior_point", 2
        case = small_models.case(name)
        mdp, (transition, discount, initial, features) = case.mdp, case.arrays
    policy = small_models.random_policy(rng, *features.shape[:2])
    exact = oracles.feature_expectations(transition, discount, initial, features, policy)
    expectations = exact * rng.uniform(0.9, 1.1, size=(lanes, len(exact)))
    arrays = (transition, initial, features, np.asarray(discount), expectations)
    return Instance(mdp, dict(zip(PARAMETERS, arrays, strict=True)), method)


def optima(arrays):
    """v* of the first two lanes by HiGHS."""
    model = [arrays[name] for name in ("probability", "discount", "initial", "features")]
    return np.array([oracles.lpal(*model, expected)[0] for expected in arrays["expectations"][:2]])


def moved(here, name, direction, step):
    """The oracle's arrays, `step` further along a direction in one of them."""
    if name == "probability":
        dense = np.zeros(here.arrays[name].shape)
        s, a, _ = np.indices(direction.shape)
        np.add.at(dense, (s, a, np.asarray(here.mdp.next_state)), direction)
        direction = dense
    return {**here.arrays, name: here.arrays[name] + step * direction}


def differences(here, name, direction):
    """Directional derivative of v* [2]; differences from either side agree, so there is no kink."""
    low, here_, high = (optima(moved(here, name, direction, step)) for step in (-STEP, 0.0, STEP))
    np.testing.assert_allclose((high - here_) / STEP, (here_ - low) / STEP, rtol=1e-2, atol=1e-3)
    return (high - low) / (2 * STEP)


def jax_parameters(here):
    model = {name: getattr(here.mdp, name) for name in PARAMETERS[:-1]}
    return {**model, "expectations": jnp.asarray(here.arrays["expectations"])}


def margins(here, parameters, field="margin"):
    """A field of the solution as a function of everything that it can be differentiated by."""
    parameters = dict(parameters)
    expectations = parameters.pop("expectations")
    options = {"tolerance": TOLERANCE, "method": here.method}
    return getattr(lpal(here.mdp.replace(**parameters), expectations, **options), field)


def random_directions(here, rng):
    parameters = jax_parameters(here)
    directions = {name: rng.normal(size=value.shape) for name, value in parameters.items()}
    directions["probability"] *= np.asarray(here.mdp.probability) > 0  # elsewhere is padding
    return directions


@pytest.mark.parametrize("name", ["dense", "sparse"])
def test_reverse_and_forward_mode_against_finite_differences(name, rng):
    """Of two lanes of a batch, along a random direction in each parameter."""
    here = instance(name)
    parameters, directions = jax_parameters(here), random_directions(here, rng)
    both, pull = jax.vjp(functools.partial(margins, here), parameters)
    lanes = [pull(jnp.eye(len(both))[i])[0] for i in range(2)]
    for key, direction in directions.items():
        expected = differences(here, key, direction)
        by_reverse = np.array([np.vdot(gradient[key], direction) for gradient in lanes])
        scale = np.linalg.norm(lanes[0][key]) * np.linalg.norm(direction)
        np.testing.assert_allclose(by_reverse, expected, rtol=0, atol=1e-5 * scale, err_msg=key)
        assert np.all(expected != 0), key
    for field in ("margin", "margin_bound"):
        by_forward = jax.jvp(functools.partial(margins, here, field=field), (parameters,), (directions,))[1]
        total = [sum(np.vdot(gradient[key], directions[key]) for key in directions) for gradient in lanes]
        np.testing.assert_allclose(by_forward[:2], total, rtol=1e-9)


def test_one_vector_of_expectations(rng):
    """The gradient is minus the weights, by either mode; and a whole model has a gradient."""
    here = instance("dense")
    expectations = jnp.asarray(here.arrays["expectations"][0])
    solve = functools.partial(lpal, tolerance=TOLERANCE)
    solution, direction = solve(here.mdp, expectations), rng.normal(size=6)

    def margin(mdp, expectations):
        return solve(mdp, expectations).margin

    value, (by_model, gradient) = jax.value_and_grad(margin, (0, 1), allow_int=True)(here.mdp, expectations)
    assert value == solution.margin
    np.testing.assert_allclose(gradient, -solution.weights, rtol=0, atol=1e-15)
    expected = np.einsum("sa,k->sak", solution.occupancy, solution.weights)
    np.testing.assert_allclose(by_model.features, expected, rtol=1e-12, atol=1e-15)
    change = jax.jvp(functools.partial(margin, here.mdp), (expectations,), (direction,))[1]
    np.testing.assert_allclose(change, -direction @ solution.weights, rtol=1e-12)


def test_the_bound_and_its_gradient_bound_the_margin_elsewhere(rng):
    """v* is concave in expectations and initial distribution. Here it has a kink: the features add up to 1, so equal
    weights prove that v* = 0, and so do those for which the policy that the expectations came from is the best.
    """
    here = instance("dense")
    transition, initial, _, discount, _ = here.arrays.values()
    features = np.broadcast_to(np.eye(6)[:, None], (6, 2, 6))
    _, action_value = oracles.optimal_value(transition, discount, features[..., 2])
    policy = np.eye(2)[action_value.argmax(axis=1)]
    exact = oracles.feature_expectations(transition, discount, initial, features, policy)
    mdp = here.mdp.replace(features=jnp.asarray(features))
    both = {"expectations": np.tile(exact, (8, 1)), "initial": initial}

    def bound(both):
        solution = lpal(mdp.replace(initial=both["initial"]), both["expectations"], tolerance=TOLERANCE)
        return solution.margin_bound[0]

    def best(expectations, initial):
        return oracles.lpal(transition, discount, initial, features, expectations)[0]

    value, gradient = jax.value_and_grad(bound)(both)
    step = 1e-3 * np.array([1, 0, -1, 0, 0, 0])
    assert abs(best(exact + step, initial) + best(exact - step, initial)) > 1e-4  # the kink
    for _ in range(10):
        other = {"expectations": both["expectations"] + rng.normal(size=(8, 6)), "initial": rng.dirichlet(np.ones(6))}
        linear = value + sum(np.vdot(gradient[key], other[key] - both[key]) for key in both)
        assert best(other["expectations"][0], other["initial"]) <= linear + 1e-8


def test_a_chain_through_policy_expectations_and_margin(rng):
    """From the logits of a policy, which is the first guess too, to the margin over it."""
    here = instance("dense")
    transition, initial, features, discount, _ = here.arrays.values()
    logits, direction = rng.normal(size=(6, 2)), rng.normal(size=(6, 2))
    factors = np.array([1.1, 0.9, 1.0, 1.0, 1.05, 0.95])

    def margin(logits):
        policy = jax.nn.softmax(logits, axis=-1)
        expectations = feature_expectations(here.mdp, policy) * factors
        batch = jnp.broadcast_to(expectations, (8, 6))
        return lpal(here.mdp, batch, initial_policy=policy, tolerance=TOLERANCE).margin[0]

    def oracle(logits):
        policy = np.exp(logits) / np.exp(logits).sum(axis=-1, keepdims=True)
        exact = oracles.feature_expectations(transition, discount, initial, features, policy)
        return oracles.lpal(transition, discount, initial, features, exact * factors)[0]

    gradient = jax.grad(margin)(logits)
    expected = (oracle(logits + STEP * direction) - oracle(logits - STEP * direction)) / (2 * STEP)
    np.testing.assert_allclose(np.vdot(gradient, direction), expected, rtol=1e-5)


def test_policy_occupancy_and_weights_are_constants():
    here = instance("dense")
    for field in ("policy", "occupancy", "weights"):
        gradient = jax.grad(lambda e, field=field: getattr(lpal(here.mdp, e), field).max())(np.ones((8, 6)))
        np.testing.assert_array_equal(gradient, 0.0)


@pytest.mark.parametrize("outer", [lambda f: jax.grad(f)(1.0), lambda f: jax.jvp(f, (1.0,), (1.0,))])
def test_second_derivatives_are_refused(outer):
    """Those with x, w and V held constant would be wrong."""
    here = instance("dense")
    batch = jnp.asarray(here.arrays["expectations"])

    def margin(scale):
        return lpal(here.mdp.replace(features=scale * here.mdp.features), batch).margin.sum()

    with pytest.raises(ValueError, match="first derivatives only"):
        outer(jax.grad(margin))


def test_without_differentiation_nothing_is_added(monkeypatch):
    def refuse(*_):
        raise AssertionError("derivatives were prepared")

    monkeypatch.setattr(lpal_module, "with_derivatives", refuse)
    here = instance("dense")
    lpal(here.mdp, here.arrays["expectations"])
    with pytest.raises(AssertionError, match="derivatives were prepared"):
        jax.grad(lambda e: lpal(here.mdp, e).margin.sum())(here.arrays["expectations"])
