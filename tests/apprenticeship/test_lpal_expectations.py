"""LPAL for expectations that no policy can reach, that contradict one another or have the wrong sign."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
import small_models

from jaxhom import MDP, Status, lpal
from jaxhom.apprenticeship.presolve import Reach, reduce_expectations

METHODS = ["columns", "interior_point"]
S, A, K = 6, 2, 6
RNG = np.random.default_rng(6)
TRANSITION, DISCOUNT, INITIAL, RANDOM = oracles.random_mdp(RNG, S, A, K=K)

MODELS = {
    "dense": (TRANSITION, DISCOUNT, INITIAL),
    "absorbing states": small_models.case("absorbing").arrays[:3],
    "every state absorbs": (np.repeat(np.eye(S)[:, None], A, axis=1), DISCOUNT, INITIAL),
    "far-sighted": (TRANSITION, 0.999, INITIAL),
}
FEATURES = {
    "random": RANDOM,
    "of both signs": RNG.normal(size=(S, A, K)),
    "negative": -RANDOM,
    "constant": np.ones((S, A, K)),
    "all zero": np.zeros((S, A, K)),
    "one zero": RANDOM * (np.arange(K) != 1),
    "one huge": RANDOM * np.where(np.arange(K) == 2, 1e6, 1.0),
    "duplicates": RANDOM[..., [0, 0, 0, 1, 1, 1]],
    "one per state": np.repeat(np.eye(S)[:, None], A, axis=1),
}
EXPECTATIONS = {
    "far too much": np.full(K, 1e6),
    "far too little": np.full(K, -1e6),
    "zeros": np.zeros(K),
    "of both signs": np.array([1e6, -1e6, 1.0, -1.0, 0.0, 5.0]),
    "one far too much": np.where(np.arange(K) == 3, 1e9, 0.0),
    "one far too little": np.where(np.arange(K) == 3, -1e9, 0.0),
    "contradictory": RNG.uniform(-10, 10, size=K),
    "equal": np.full(K, 5.0),
}
CASES = [("dense", name) for name in FEATURES] + [
    ("absorbing states", "of both signs"),
    ("absorbing states", "one per state"),
    ("every state absorbs", "one per state"),
    ("far-sighted", "random"),
    ("far-sighted", "of both signs"),
]


@functools.cache
def optimum(model, name, expectations):
    """v* by HiGHS, whose tolerances are absolute: it gets the program in units of the features."""
    transition, discount, initial = MODELS[model]
    size = np.abs(FEATURES[name]).max() or 1.0
    scaled = EXPECTATIONS[expectations] / size
    return size * oracles.lpal(transition, discount, initial, FEATURES[name] / size, scaled)[0]


def assert_certified(solution, model, features, expectations, optima, status=Status.SOLVED):
    """Every lane against its optimum, and what proves its bounds against planning and a linear solve."""
    transition, discount, initial = model
    assert np.all(solution.status == status)
    for leaf in jax.tree.leaves(solution):
        assert np.isfinite(leaf).all()
    np.testing.assert_allclose(solution.policy.sum(axis=-1), 1.0, rtol=0, atol=1e-9)
    np.testing.assert_allclose(solution.weights.sum(axis=-1), 1.0, rtol=0, atol=1e-9)
    assert np.min(solution.policy) >= 0 and np.min(solution.weights) >= 0
    size = np.abs(features).max() or 1.0
    for lane, (expected, best) in enumerate(zip(expectations, optima, strict=True)):
        rounding = 1e-9 * (np.abs(expected).max() + size / (1 - discount))
        low, high = float(solution.margin[lane]), float(solution.margin_bound[lane])
        policy, weights = np.asarray(solution.policy[lane]), np.asarray(solution.weights[lane])
        assert low <= best + rounding and best <= high + rounding
        margin = oracles.margin(transition, discount, initial, features, expected, policy)
        np.testing.assert_allclose(low, margin, rtol=0, atol=rounding)
        value, _ = oracles.optimal_value(transition, discount, features @ weights)
        assert value @ initial - weights @ expected <= high + rounding
        if status == Status.SOLVED:
            assert high - low <= 1e-5 / (1 - discount) * size


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("model", "name"), CASES)
def test_expectations_out_of_reach(model, name, method):
    transition, discount, initial = MODELS[model]
    mdp = MDP.from_dense(transition, discount=discount, initial=initial, features=FEATURES[name])
    expectations = np.stack(list(EXPECTATIONS.values()))
    solution = lpal(mdp, expectations, method=method)
    optima = [optimum(model, name, key) for key in EXPECTATIONS]
    assert_certified(solution, MODELS[model], FEATURES[name], expectations, optima)


@pytest.mark.parametrize("method", METHODS)
def test_a_tolerance_below_the_rounding_of_the_expectations_stalls(method):
    """The features are 1e-8, and so is their tolerance; 1e6 has no such digits."""
    mdp = MDP.from_dense(TRANSITION, discount=DISCOUNT, initial=INITIAL, features=1e-8 * RANDOM)
    expectations = np.tile(EXPECTATIONS["far too much"], (8, 1))
    solution = lpal(mdp, expectations, method=method)
    reached = 1e-8 * (optimum("dense", "random", "zeros"))
    assert np.all(np.abs(solution.margin - (reached - 1e6)) <= 1e-7)
    assert_certified(solution, MODELS["dense"], 1e-8 * RANDOM, expectations, [-1e6] * 8, Status.STALLED)
    assert np.all(solution.margin_bound - solution.margin <= 1e-8)


@pytest.mark.parametrize(
    ("states", "actions", "features", "method"),
    [(1, 1, 1, "interior_point"), (2, 1, 3, "interior_point"), (2, 1, 3, "columns")],
)
def test_the_smallest_models(states, actions, features, method, rng):
    arrays = oracles.random_mdp(rng, states, actions, K=features)
    transition, discount, initial, phi = arrays
    mdp = MDP.from_dense(transition, discount=discount, initial=initial, features=phi)
    expectations = np.stack([np.full(features, size) for size in (1e6, -1e6, 0.0, 3.0)])
    expectations[:2, 0] = -1.0
    solution = lpal(mdp, expectations, method=method)
    optima = [oracles.lpal(*arrays, expected)[0] for expected in expectations]
    assert_certified(solution, (transition, discount, initial), phi, expectations, optima)


def test_float32():
    """Bounds hold for the rounded model although its margins have no digits behind the point."""
    model = [np.float32(array) for array in (TRANSITION, INITIAL, RANDOM)]
    mdp = MDP.from_dense(model[0], discount=DISCOUNT, initial=model[1], features=model[2])
    expectations = np.stack(list(EXPECTATIONS.values())).astype(np.float32)
    solution = lpal(mdp, expectations, method="interior_point", tolerance=1e-2)
    arrays = [np.asarray(leaf, np.float64) for leaf in (mdp.transition, mdp.discount, mdp.initial, mdp.features)]
    gap = np.asarray(solution.margin_bound - solution.margin)
    for lane, expected in enumerate(expectations.astype(float)):
        best = oracles.lpal(*arrays, expected)[0]
        assert solution.margin_bound[lane] >= best
        np.testing.assert_allclose(solution.margin[lane], best, rtol=2e-7, atol=1e-2)
        assert gap[lane] <= 1e-2 + 1e-6 * np.abs(expected).max()
    np.testing.assert_array_equal(solution.status, np.where(gap <= 1e-2, Status.SOLVED, Status.STALLED))


# ------------------------------------------------------------------------------------ the reduction


def random_expectations(rng):
    """Thirty lanes of numbers of any size and sign."""
    sizes = 10.0 ** rng.uniform(-3, 9, size=(30, K))
    return rng.choice([-1, 1], size=(30, 1)) * sizes * rng.choice([-1, 1], size=(30, K), p=[0.2, 0.8])


@pytest.mark.parametrize("name", FEATURES)
def test_reduction_changes_no_margin(name, rng):
    """That of any policy is the reduced one plus the shift, and the reduced numbers are as large as the features."""
    features = FEATURES[name]
    mdp = MDP.from_dense(TRANSITION, discount=DISCOUNT, initial=INITIAL, features=features)
    expectations = random_expectations(rng)
    reduction = reduce_expectations(Reach.of(mdp), expectations)
    for policy in small_models.random_policy(rng, 20, S, A):
        reached = oracles.feature_expectations(TRANSITION, DISCOUNT, INITIAL, features, policy)
        given = (reached - expectations).min(axis=1)
        reduced = (reached - reduction.expectations).min(axis=1) + reduction.shift
        np.testing.assert_allclose(reduced, given, rtol=1e-14, atol=1e-14 * np.abs(expectations).max())
        excess = np.take_along_axis(reached - expectations, reduction.scarcest[:, None], axis=1)
        assert np.all(excess <= np.where(reduction.is_idle, reached - expectations, np.inf))
    assert np.abs(reduction.expectations).max() <= 3 * np.abs(features).max() / (1 - DISCOUNT)


def test_expectations_within_reach_stay_as_they_are(rng):
    mdp = MDP.from_dense(TRANSITION, discount=DISCOUNT, initial=INITIAL, features=RANDOM)
    policies = small_models.random_policy(rng, 20, S, A)
    reached = [oracles.feature_expectations(TRANSITION, DISCOUNT, INITIAL, RANDOM, policy) for policy in policies]
    reduction = reduce_expectations(Reach.of(mdp), np.stack(reached))
    np.testing.assert_array_equal(reduction.expectations, reached)
    assert not reduction.shift.any() and not reduction.is_idle.any()


def test_reduction_knows_that_rounded_rows_do_not_sum_to_one(rng):
    """At a discount of 0.999 rows that sum to 1 - 9e-5 leave a tenth less time, and so less of every feature."""
    transition = np.float32(TRANSITION) * np.float32(1 - 9e-5)
    features = np.broadcast_to(np.arange(K) > 0, (S, A, K)).astype(float)
    mdp = MDP.from_dense(TRANSITION, discount=0.999, initial=INITIAL, features=features)
    mdp = mdp._exchange({"probability": jnp.asarray(transition)})  # constructors would bring the sums to 1
    policy = small_models.random_policy(rng, S, A)
    reached = oracles.feature_expectations(transition.astype(float), 0.999, INITIAL, features, policy)
    expectations = 950.0 * (np.arange(K) > 0)  # out of reach, but not of 1 / (1 - discount)
    reduction = reduce_expectations(Reach.of(mdp), expectations[None])
    margin = (reached - expectations).min()
    assert margin < -10
    np.testing.assert_allclose((reached - reduction.expectations).min() + reduction.shift, margin, rtol=1e-4)


def test_gradients_of_expectations_out_of_reach():
    """Of features that are never the smallest it is zero, of the others minus the weights."""
    mdp = MDP.from_dense(TRANSITION, discount=DISCOUNT, initial=INITIAL, features=RANDOM)
    expectations = np.stack(list(EXPECTATIONS.values()))
    gradient = jax.grad(lambda e: lpal(mdp, e).margin.sum())(jnp.asarray(expectations))
    solution = lpal(mdp, expectations)
    np.testing.assert_allclose(gradient, -solution.weights, rtol=0, atol=1e-15)
    names = list(EXPECTATIONS)
    np.testing.assert_array_equal(gradient[names.index("one far too much")], -1.0 * (np.arange(K) == 3))
    assert gradient[names.index("one far too little"), 3] == 0.0
