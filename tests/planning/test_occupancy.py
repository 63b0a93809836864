"""Occupancies, feature expectations and values against NumPy; derivatives against complex steps.

The oracles are rational functions of their arguments, so f(x + ih d).imag / h is their derivative
along d to rounding: a finite difference without cancellation.
"""

import functools
import time

import chex
import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
import small_models

from jaxhom import MDP, gridworld
from jaxhom.planning import chain_solver
from jaxhom.planning import occupancy as occupancy_module
from jaxhom.planning.host_chains import HostChain, HostModel, host_model
from jaxhom.planning.occupancy import (
    feature_expectations,
    has_occupancy,
    occupancy,
    policy_from_occupancy,
    policy_value,
)

SOLVERS = ["dense", "sparse", "restart", "dense_krylov"]


def expected_results(case, policy, reward):
    """Occupancy, feature expectations and values by NumPy."""
    return (
        oracles.occupancy(*case.arrays[:3], policy),
        oracles.feature_expectations(*case.arrays, policy),
        oracles.policy_value(case.transition, case.discount, policy, reward),
    )


def results(mdp, policy, reward):
    return (
        occupancy(mdp, policy),
        feature_expectations(mdp, policy),
        policy_value(mdp, policy, reward),
    )


def two_solves(mdp, policy, reward):
    """`results` without a second solve for the features: under `jit` it would be compiled too."""
    return occupancy(mdp, policy), policy_value(mdp, policy, reward)


def assert_close_by_scale(actual, expected, tolerance):
    """Largest difference below `tolerance` times the largest expected number."""
    assert np.shape(actual) == np.shape(expected)
    assert np.max(np.abs(actual - expected)) <= tolerance * np.max(np.abs(expected))


# -------------------------------------------------------------------------------------- the numbers


def test_models_reach_both_solvers():
    small = [chain_solver.is_solved_by_lu(small_models.case(name).mdp) for name in SOLVERS]
    assert small == [True, True, False, False]


BOTH_WAYS = pytest.mark.parametrize("transform", [lambda f: f, jax.jit], ids=["concrete", "jit"])


@BOTH_WAYS
def test_against_numpy(case, transform, rng):
    policy = small_models.random_policy(rng, *case.shape)
    reward = rng.normal(size=case.shape)
    x, value = transform(two_solves)(case.mdp, policy, reward)
    actual = (x, feature_expectations(case.mdp, policy), value)
    for got, want in zip(actual, expected_results(case, policy, reward), strict=True):
        assert_close_by_scale(np.asarray(got), want, 1e-10)
    np.testing.assert_allclose(np.sum(x), 1 / (1 - case.discount), rtol=1e-10)


def test_deterministic_policies(case, rng):
    actions = rng.integers(case.shape[1], size=case.shape[0])
    policy = np.eye(case.shape[1])[actions]
    x = np.asarray(occupancy(case.mdp, policy))
    assert_close_by_scale(x, oracles.occupancy(*case.arrays[:3], policy), 1e-10)
    assert np.all(x >= 0) and np.all(x[policy == 0] == 0)


def test_unreachable_states_have_no_occupancy_and_absorbing_ones_the_rest():
    case = small_models.case("absorbing")
    policy = np.eye(2)[[0, 0, 0, 0, 0, 0]]
    state_occupancy = np.asarray(occupancy(case.mdp, policy)).sum(axis=1)
    g = case.discount
    absorbed = (0.5 * g**2 + 0.25 * g) / (1 - g)
    pair = 0.25 / (1 - g**2)
    expected = [0.5, 0.5 * g + 0.25, absorbed, 0.0, pair, g * pair]
    np.testing.assert_allclose(state_occupancy, expected, rtol=1e-13, atol=0)


@pytest.mark.parametrize("name", ["sparse", "restart", "dense_krylov"])
@pytest.mark.parametrize("discount", [0.01, 0.999])
def test_extreme_discounts(name, discount, rng):
    case = small_models.case(name)._replace(discount=discount)
    mdp = case.mdp.replace(discount=np.asarray(discount))
    policy = small_models.random_policy(rng, *case.shape)
    reward = rng.normal(size=case.shape)
    expected = expected_results(case, policy, reward)[::2]
    for got, want in zip(jax.jit(two_solves)(mdp, policy, reward), expected, strict=True):
        assert_close_by_scale(np.asarray(got), want, 1e-9)


@BOTH_WAYS
def test_a_ring_that_hardly_mixes(transform, rng):
    case = small_models.slow_ring()
    policy, reward = np.full(case.shape, [0.6, 0.4]), rng.normal(size=case.shape)
    expected = expected_results(case, policy, reward)[::2]
    for got, want in zip(transform(two_solves)(case.mdp, policy, reward), expected, strict=True):
        assert_close_by_scale(np.asarray(got), want, 1e-9)


def corridor(num_states, discount, dtype=np.float64):
    """Cells in a row, to the left and to the right, slipping the other way with probability 0.1."""
    cell = np.arange(num_states)
    ways = np.stack([np.maximum(cell - 1, 0), np.minimum(cell + 1, num_states - 1)], axis=-1)
    next_state = np.stack([ways, ways[:, ::-1]], axis=1)
    probability = np.broadcast_to(np.array([0.9, 0.1], dtype), next_state.shape)
    return MDP.from_successors(next_state, probability, discount=discount)


@BOTH_WAYS
@pytest.mark.parametrize("discount", [0.999, 0.99999])
def test_float32_says_what_float64_would(transform, discount, rng):
    """The oracle is NumPy in float64 on the numbers that float32 holds, rows brought to 1."""
    mdp = corridor(100, discount, np.float32)
    policy = small_models.random_policy(rng, 100, 2).astype(np.float32)
    reward = rng.uniform(size=(100, 2)).astype(np.float32)
    x, value = transform(two_solves)(mdp, policy, reward)
    transition = np.asarray(mdp.transition, float)
    exact = transition / transition.sum(axis=-1, keepdims=True), float(mdp.discount)
    exact_policy = policy.astype(float) / policy.sum(axis=1, keepdims=True, dtype=float)
    assert x.dtype == value.dtype == np.float32
    assert_close_by_scale(np.asarray(x), oracles.occupancy(*exact, np.asarray(mdp.initial, float), exact_policy), 1e-4)
    assert_close_by_scale(np.asarray(value), oracles.policy_value(*exact, exact_policy, reward), 1e-4)
    np.testing.assert_allclose(float(x.sum()), 1 / (1 - float(mdp.discount)), rtol=1e-4)


def test_large_float32_models_are_right_or_nan_under_jit(rng):
    mdp = corridor(2000, 0.99999, np.float32)
    policy = small_models.random_policy(rng, 2000, 2).astype(np.float32)
    assert np.isnan(jax.jit(occupancy)(mdp, policy)).all()
    np.testing.assert_allclose(float(occupancy(mdp, policy).sum()), 1 / (1 - float(mdp.discount)), rtol=1e-5)


@pytest.mark.parametrize("discount", [0.9999, 0.999999, 1 - 1e-9])
def test_long_corridors_take_no_longer_where_the_discount_is_near_one(discount, rng):
    """SciPy's LU takes a few milliseconds; sweeps would take minutes."""
    mdp = corridor(1000, discount)
    policy = small_models.random_policy(rng, 1000, 2)
    begin = time.perf_counter()
    x = np.asarray(occupancy(mdp, policy))
    assert time.perf_counter() - begin < 20.0
    transition = np.einsum("sa,saz->sz", policy, np.asarray(mdp.transition))
    missing = x.sum(axis=1) - discount * transition.T @ x.sum(axis=1) - np.asarray(mdp.initial)
    assert np.abs(missing).max() <= 1e-14 * x.sum()
    np.testing.assert_allclose(x.sum(), 1 / (1 - discount), rtol=1e-6)


@pytest.mark.parametrize("name", ["dense", "restart"])
def test_zero_reward_has_zero_value(name, rng):
    case = small_models.case(name)
    policy = small_models.random_policy(rng, *case.shape)
    np.testing.assert_array_equal(policy_value(case.mdp, policy, np.zeros(case.shape)), 0)


@pytest.mark.parametrize("name", ["dense", "restart"])
def test_float32_models_are_solved_in_float32_whatever_the_policy(name, rng):
    case = small_models.in_float32(small_models.case(name))
    policy = small_models.random_policy(rng, *case.shape)
    reward = rng.uniform(size=case.shape)
    expected = expected_results(case, policy.astype(np.float32).astype(float), reward)
    for got, want in zip(two_solves(case.mdp, policy, reward), expected[::2], strict=True):
        assert got.dtype == jnp.float32
        assert_close_by_scale(np.asarray(got), want, 4e-6 / (1 - case.discount))


@pytest.mark.parametrize("name", ["dense", "restart"])
def test_integers_and_lists_are_policies(name):
    case = small_models.case(name)
    one_hot = np.eye(case.shape[1], dtype=int)[np.zeros(case.shape[0], int)]
    expected = occupancy(case.mdp, one_hot.astype(float))
    chex.assert_trees_all_equal(occupancy(case.mdp, one_hot), expected)
    chex.assert_trees_all_equal(occupancy(case.mdp, one_hot.tolist()), expected)


@pytest.mark.parametrize("name", ["dense", "restart"])
def test_a_policy_with_nan_gives_nan_in_its_lane_alone(name, rng):
    case = small_models.case(name)
    policies = small_models.random_policy(rng, 3, *case.shape)
    expected = oracles.occupancy(*case.arrays[:3], policies[1])
    policies[0, 2, 0] = np.nan
    x = np.asarray(jax.jit(occupancy)(case.mdp, policies))  # concrete, it would be refused
    assert np.isnan(x[0]).all()
    assert_close_by_scale(x[1], expected, 1e-10)


# ---------------------------------------------------------------------------- batch, jit and vmap


@pytest.mark.parametrize("name", ["dense", "restart"])
def test_batches_agree_with_single_policies(name, rng):
    case = small_models.case(name)
    policies = small_models.random_policy(rng, 3, *case.shape)
    rewards = rng.normal(size=(3, *case.shape))
    batched = results(case.mdp, policies, rewards)
    chex.assert_shape(batched, [(3, *case.shape), (3, 2), (3, case.shape[0])])
    singles = [results(case.mdp, p, r) for p, r in zip(policies, rewards, strict=True)]
    stacked = jax.tree.map(lambda *lanes: jnp.stack(lanes), *singles)
    chex.assert_trees_all_close(batched, stacked, rtol=1e-10, atol=1e-11)


def test_one_reward_serves_a_batch_of_policies(rng):
    case = small_models.case("restart")
    policies, reward = small_models.random_policy(rng, 3, *case.shape), rng.normal(size=case.shape)
    values = policy_value(case.mdp, policies, reward)
    for policy, value in zip(policies, values, strict=True):
        expected = oracles.policy_value(case.transition, case.discount, policy, reward)
        assert_close_by_scale(np.asarray(value), expected, 1e-10)


@pytest.mark.parametrize("name", ["dense", "restart"])
def test_vmap_over_discounts_and_policies_under_jit(name, rng):
    case = small_models.case(name)
    policies = small_models.random_policy(rng, 3, *case.shape)
    reward = rng.normal(size=case.shape)
    discounts = np.array([0.1, 0.9, 0.99])

    @jax.jit
    @jax.vmap
    def lanes(discount, policy):
        model = case.mdp.replace(discount=discount)
        if name == "dense":
            return two_solves(model, policy, reward)
        return (occupancy(model, policy),)  # one solve is enough to wait for

    found = lanes(discounts, policies)
    for i, (discount, policy) in enumerate(zip(discounts, policies, strict=True)):
        expected = expected_results(case._replace(discount=discount), policy, reward)
        for got, want in zip(found, expected[::2], strict=False):
            assert_close_by_scale(np.asarray(got[i]), want, 1e-10)


def test_one_trace_serves_all_models_and_policies_of_one_shape(rng):
    chex.clear_trace_counter()
    case = small_models.case("dense")
    solve = jax.jit(chex.assert_max_traces(feature_expectations, n=1))
    for discount in (0.5, 0.9):
        mdp = case.mdp.replace(discount=np.asarray(discount))
        solve(mdp, small_models.random_policy(rng, *case.shape))


# ----------------------------------------------------------------------------------- derivatives

STEP = 1e-30


def along(mdp, name, direction):
    """The oracle's form of a direction in one of the inputs."""
    if name != "probability":
        return direction
    dense = np.zeros((*mdp.probability.shape[:2], mdp.num_states))
    s, a = np.ogrid[: mdp.num_states, : mdp.num_actions]
    np.add.at(dense, (s[..., None], a[..., None], np.asarray(mdp.next_state)), direction)
    return dense


@functools.partial(jax.jit, static_argnums=0)
def gradients(function, mdp, inputs, weight):
    def weighted(inputs):
        inputs = dict(inputs)
        policy, reward = inputs.pop("policy"), inputs.pop("reward")
        model = mdp.replace(**inputs)
        extra = (reward,) if function is policy_value else ()
        return jnp.vdot(weight, function(model, policy, *extra))

    return jax.grad(weighted)(inputs)


def complex_step(case, function, inputs, weight, name, direction):
    """Derivative of <weight, oracle> along `direction` in the input `name`."""
    point = {**inputs, "probability": case.transition}
    point[name] = point[name] + 1j * STEP * along(case.mdp, name, direction)
    model = (point["probability"], point["discount"])
    if function is occupancy:
        result = oracles.occupancy(*model, point["initial"], point["policy"])
    elif function is feature_expectations:
        arguments = (point["initial"], point["features"], point["policy"])
        result = oracles.feature_expectations(*model, *arguments)
    else:
        result = oracles.policy_value(*model, point["policy"], point["reward"])
    return np.sum(weight * result.imag) / STEP


@pytest.mark.parametrize(
    ("function", "name"),
    [
        (feature_expectations, "dense"),
        (feature_expectations, "restart"),
        (policy_value, "sparse"),
        (policy_value, "dense_krylov"),
        (occupancy, "dense"),
    ],
)
def test_gradients_against_complex_steps(function, name, rng):
    """In the policy and in every array of the model, along random directions; by LU and by Krylov, in both layouts."""
    case = small_models.case(name)
    mdp = case.mdp
    inputs = {
        "policy": small_models.random_policy(rng, *case.shape),
        "reward": rng.normal(size=case.shape),
        "probability": np.asarray(mdp.probability),
        "initial": case.initial,
        "features": case.features,
        "discount": np.asarray(case.discount),
    }
    output = jax.eval_shape(function, mdp, *(inputs[n] for n in arguments_of(function)))
    weight = rng.normal(size=output.shape)
    gradient = gradients(function, mdp, inputs, weight)
    for key, value in inputs.items():
        direction = rng.normal(size=value.shape)
        if key == "probability":
            direction = direction * (value > 0)
        expected = complex_step(case, function, inputs, weight, key, direction)
        actual = np.vdot(gradient[key], direction)
        scale = max(np.linalg.norm(gradient[key]), 1e-300)
        assert abs(actual - expected) <= 1e-9 * scale * np.linalg.norm(direction), key
        if key not in ("reward", "features", "initial"):
            assert expected != 0, key


def arguments_of(function):
    return ("policy", "reward") if function is policy_value else ("policy",)


def test_forward_mode_on_a_batch_with_wide_rows(rng):
    """Each lane's derivative along a direction of its own, against complex steps."""
    case = small_models.case("restart")
    policies = small_models.random_policy(rng, 2, *case.shape)
    directions, weight = rng.normal(size=policies.shape), rng.normal(size=2)

    def weighted(policies):
        return feature_expectations(case.mdp, policies) @ weight

    push = jax.jit(lambda *pair: jax.jvp(weighted, pair[:1], pair[1:])[1])
    expected = [
        oracles.feature_expectations(*case.arrays, policy + 1j * STEP * direction).imag @ weight / STEP
        for policy, direction in zip(policies, directions, strict=True)
    ]
    np.testing.assert_allclose(push(policies, directions), expected, rtol=1e-9)


@pytest.mark.parametrize("name", ["sparse", "dense_krylov"])
def test_second_derivatives_of_a_batch_along_a_line(name, rng):
    """Two policies and the model move at once; forward over reverse mode, and forward alone, in everything."""
    case = small_models.case(name)
    points = {
        "policy": small_models.random_policy(rng, 2, *case.shape),
        "probability": np.asarray(case.mdp.probability),
        "initial": case.initial,
        "features": case.features,
        "discount": np.asarray(case.discount),
    }
    directions = {key: 1e-2 * rng.normal(size=value.shape) for key, value in points.items()}
    directions["probability"] *= points["probability"] > 0
    weight = rng.normal(size=(2, 2))

    def weighted(inputs):
        inputs = dict(inputs)
        policy = inputs.pop("policy")
        return jnp.vdot(weight, feature_expectations(case.mdp.replace(**inputs), policy))

    def first(share):
        """The oracle's derivative at `share` of the directions."""
        moved = {
            key: (case.transition if key == "probability" else value)
            + (share + 1j * STEP) * along(case.mdp, key, directions[key])
            for key, value in points.items()
        }
        model = [moved[key] for key in ("probability", "discount", "initial", "features")]
        lanes = [oracles.feature_expectations(*model, policy).imag for policy in moved["policy"]]
        return np.vdot(weight, lanes) / STEP

    @jax.jit
    def derivatives(points):
        change, second = jax.jvp(jax.grad(weighted), (points,), (directions,))
        by_reverse, curvature = (sum(jnp.vdot(a[key], directions[key]) for key in directions) for a in (change, second))
        return by_reverse, jax.jvp(weighted, (points,), (directions,))[1], curvature

    by_reverse, by_forward, curvature = derivatives(points)
    np.testing.assert_allclose([by_reverse, by_forward], first(0.0), rtol=1e-9)
    np.testing.assert_allclose(curvature, (first(1e-4) - first(-1e-4)) / 2e-4, rtol=1e-5)


# ---------------------------------------------------------------------------------- what is refused


@pytest.mark.parametrize("shape", [(7,), (3, 7), (7, 2), (6, 3), (2, 7, 2), (1, 2, 7, 3)])
def test_policies_of_another_shape_are_refused(shape):
    mdp = small_models.case("dense").mdp
    message = rf"policy must have shape \(7, 3\) or \(B, 7, 3\), got \({', '.join(map(str, shape))}"
    for function in (occupancy, feature_expectations):
        with pytest.raises(ValueError, match=message):
            function(mdp, np.ones(shape))
    with pytest.raises(ValueError, match=message):
        policy_value(mdp, np.ones(shape), np.ones((7, 3)))


@pytest.mark.parametrize(
    ("policy_shape", "reward_shape"),
    [
        ((7, 3), (7,)),
        ((7, 3), (2, 7, 3)),
        ((2, 7, 3), (3, 7, 3)),
        ((1, 7, 3), (3, 7, 3)),
        ((3, 7, 3), (1, 7, 3)),
        ((2, 7, 3), (7, 2)),
    ],
)
def test_rewards_of_another_shape_are_refused(policy_shape, reward_shape):
    mdp = small_models.case("dense").mdp
    with pytest.raises(ValueError, match=r"reward must have shape \(7, 3\) or the policy's, got"):
        policy_value(mdp, np.ones(policy_shape) / 3, np.ones(reward_shape))


def test_wide_batches_are_solved_some_lanes_at_a_time(monkeypatch, rng):
    """Two lanes at a time, the last of five beside a copy of itself."""
    case = small_models.case("restart")
    monkeypatch.setattr(chain_solver, "_CACHED_NUMBERS", 2 * case.shape[0])
    policies, rewards = small_models.random_policy(rng, 5, *case.shape), rng.normal(size=(5, *case.shape))
    for solve in (occupancy_module._occupancy, occupancy_module._solve_values):
        solve.clear_cache()
    measures, values = jax.jit(two_solves)(case.mdp, policies, rewards)
    gradient = jax.grad(lambda policies: (occupancy(case.mdp, policies) * rewards).sum())(policies)
    directions = rng.normal(size=policies.shape)
    for i, policy in enumerate(policies):
        expected = oracles.occupancy(case.transition, case.discount, case.initial, policy)
        np.testing.assert_allclose(measures[i], expected, rtol=0, atol=1e-10)
        expected = oracles.policy_value(case.transition, case.discount, policy, rewards[i])
        np.testing.assert_allclose(values[i], expected, rtol=0, atol=1e-10)
        moved = oracles.occupancy(case.transition, case.discount, case.initial, policy + 1j * STEP * directions[i])
        slope = np.sum(rewards[i] * moved.imag) / STEP
        np.testing.assert_allclose(np.vdot(gradient[i], directions[i]), slope, rtol=1e-9)
    for solve in (occupancy_module._occupancy, occupancy_module._solve_values):
        solve.clear_cache()


# ------------------------------------------------------------------------- from occupancies to policies


@pytest.mark.parametrize("numpy", [np, jnp])
def test_policies_are_read_off_occupancies(numpy):
    """Eq. (5); negative entries are rounding, and where nothing happens the fallback rules."""
    mdp = MDP.from_dense(np.repeat(np.eye(4)[:, None], 2, axis=1), discount=0.9)
    x = numpy.asarray([[3.0, 1.0], [2.0, -1e-12], [0.0, 0.0], [1e-12, 0.0]])
    found = policy_from_occupancy(mdp, x, np.array([[0.0, 1.0]] * 4))
    np.testing.assert_array_equal(found, [[0.75, 0.25], [1.0, 0.0], [0.0, 1.0], [0.0, 1.0]])
    assert has_occupancy(mdp, x).tolist() == [True, True, False, False]
    np.testing.assert_array_equal(policy_from_occupancy(mdp, x[None], found, 1e-14)[0, 3], [1.0, 0.0])


def test_an_occupancy_has_the_policy_that_it_came_from(rng):
    case = small_models.case("restart")
    policy = small_models.random_policy(rng, *case.shape)
    x = occupancy(case.mdp, policy)
    expected = np.where(has_occupancy(case.mdp, x)[:, None], policy, 0.5)
    np.testing.assert_allclose(jax.jit(policy_from_occupancy)(case.mdp, x, 0.5), expected, rtol=0, atol=1e-9)


def test_no_features_have_no_expectations():
    mdp = small_models.case("restart").mdp.replace(features=np.zeros((100, 3, 0)))
    policies = np.full((2, 100, 3), 1 / 3)
    assert feature_expectations(mdp, policies[0]).shape == (0,)
    assert feature_expectations(mdp, policies).shape == (2, 0)


def test_sweeps_alone_solve_what_they_should(case, rng):
    """What large models end with, against factors."""
    policy = small_models.random_policy(rng, *case.shape)
    chain, reward = host_model(case.mdp).chain(policy), rng.normal(size=case.shape[0])
    if case.mdp.discount > 0.995:
        return
    np.testing.assert_allclose(chain.swept(reward, 1e-12, is_flow=False), chain.value(reward), rtol=1e-9, atol=1e-9)
    source = np.asarray(case.mdp.initial)
    np.testing.assert_allclose(chain.swept(source, 1e-12, is_flow=True), chain.state_occupancy(source), atol=1e-9)


def test_a_long_way_in_a_large_model(monkeypatch):
    """Krylov's steps break off where mass only moves on, and factors are out of reach: sweeps are right at any rate."""
    length = 3000
    step = np.minimum(np.arange(length) + 1, length - 1)
    start = np.arange(length) == 0
    mdp = MDP.from_successors(step[:, None, None], np.ones((length, 1, 1)), discount=0.99, initial=start)
    monkeypatch.setattr(HostModel, "is_solvable", False)
    monkeypatch.setattr(HostModel, "is_soon_factorised", False)
    mu = np.asarray(occupancy(mdp, np.ones((length, 1))))[:, 0]
    expected = 0.99 ** np.arange(length)
    expected[-1] /= 0.01
    np.testing.assert_allclose(mu, expected, rtol=0, atol=1e-8)


@pytest.mark.parametrize("lanes", [3, 40])
def test_the_host_gives_up_at_the_first_chain_that_mixes_slowly(monkeypatch, lanes):
    """And the device does what is left: one lane of vain products, not one each."""
    mdp = gridworld(8, discount=0.9).mdp
    policies = small_models.random_policy(np.random.default_rng(0), lanes, mdp.num_states, mdp.num_actions)
    expected, asked = occupancy(mdp, policies), []

    def in_vain(chain, right, is_flow, error):
        asked.append(1)
        return np.full_like(right, np.nan)

    monkeypatch.setattr(HostModel, "is_soon_factorised", property(lambda model: False))
    monkeypatch.setattr(HostChain, "_iterate", in_vain)
    np.testing.assert_allclose(occupancy(mdp, policies), expected, rtol=1e-8, atol=1e-12)
    assert len(asked) == 1
