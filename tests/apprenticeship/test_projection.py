"""Projection and max-margin: against the hull of all policies, and every claim by an independent road."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
import small_models

from jaxhom import MDP, Demonstrations, Status, gridworld, monte_carlo_feature_expectations, mwal, projection
from jaxhom.apprenticeship import exact
from jaxhom.solvers.nearest_point import nearest_mixture

METHODS = ["projection", "max_margin"]


def arrays_of(mdp):
    leaves = (mdp.transition, mdp.discount, mdp.initial, mdp.features)
    return tuple(np.asarray(leaf, np.float64) for leaf in leaves)


def random_model(seed, num_features=3, dtype=np.float64, **options):
    transition, discount, initial, features = oracles.random_mdp(np.random.default_rng(seed), 5, 3, K=num_features)
    options = {"discount": discount} | options
    return MDP.from_dense(transition.astype(dtype), initial=initial, features=features.astype(dtype), **options)


def assert_certified(learned, mdp, expectations, eps=1e-6):
    """Every claim of one lane, recomputed."""
    transition, discount, initial, features = arrays_of(mdp)
    policy, weights = (np.asarray(leaf, np.float64) for leaf in (learned.policy, learned.weights))
    np.testing.assert_allclose(policy.sum(axis=1), 1.0, rtol=0, atol=eps)
    assert (policy >= 0).all() and not policy[~np.asarray(mdp.allowed)].any()
    reached = oracles.feature_expectations(transition, discount, initial, features, policy)
    size = 1.0 + np.abs(reached).max()
    np.testing.assert_allclose(learned.expectations, reached, rtol=0, atol=eps * size)
    np.testing.assert_allclose(learned.objective, np.linalg.norm(expectations - reached), rtol=0, atol=eps * size)
    np.testing.assert_allclose(np.linalg.norm(weights), 1.0, rtol=0, atol=eps)
    proved = weights @ expectations - largest_value(mdp, weights)
    np.testing.assert_allclose(learned.bound, max(proved, 0.0), rtol=0, atol=eps * size)
    assert 0 <= learned.bound <= learned.objective
    greedy = np.asarray(learned.greedy_policy, np.float64)
    assert set(np.unique(greedy)) <= {0.0, 1.0} and (greedy.sum(axis=1) == 1).all()
    best = weights @ oracles.feature_expectations(transition, discount, initial, features, greedy)
    np.testing.assert_allclose(best, largest_value(mdp, weights), rtol=0, atol=eps * size)


def largest_value(mdp, weights):
    """max_pi w . V(pi); what is not allowed costs more than all the rest."""
    transition, discount, initial, features = arrays_of(mdp)
    reward = features @ weights
    penalty = 1e3 * (1.0 + np.abs(reward).max()) / (1.0 - discount)
    reward = np.where(np.asarray(mdp.allowed), reward, -penalty)
    return initial @ oracles.optimal_value(transition, discount, reward)[0]


@functools.cache
def hull(seed):
    return oracles.all_expectations(*arrays_of(random_model(seed)))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("kind", ["of a policy", "of a mixture", "out of reach", "far away", "of both signs"])
def test_the_distance_is_the_least_of_all_policies(seed, kind, method):
    mdp, points, rng = random_model(seed), hull(seed), np.random.default_rng(seed)
    expectations = {
        "of a policy": points[rng.integers(len(points))],
        "of a mixture": rng.dirichlet(np.ones(len(points))) @ points,
        "out of reach": points[7] + rng.uniform(-1, 1, size=3),
        "far away": points[7] + np.array([1e4, -1e4, 0.0]),
        "of both signs": np.array([-3.0, 5.0, 0.1]),
    }[kind]
    least = oracles.least_distance(points, expectations)
    learned = projection(mdp, expectations, method=method, tolerance=1e-3)
    assert_certified(learned, mdp, expectations)
    assert learned.bound - 1e-7 <= least <= learned.objective + 1e-7
    is_closed = bool(learned.objective - learned.bound <= 1e-3)
    assert learned.status == (Status.SOLVED if is_closed else Status.ITERATION_LIMIT)
    # Moving towards one policy at a time zigzags where the expectations are out of reach.
    assert is_closed or (method == "projection" and least > 0 and learned.objective - least <= 0.02)


def test_the_margin_method_ends_at_the_optimum():
    """To the digits that rounding leaves, where moving towards one policy at a time needs very many rounds."""
    mdp, points = random_model(4, num_features=4), oracles.all_expectations(*arrays_of(random_model(4, 4)))
    expectations = points.mean(axis=0) + np.array([2.0, -1.0, 0.5, 0.3])
    learned = projection(mdp, expectations, method="max_margin", tolerance=1e-9)
    assert learned.status == Status.SOLVED and learned.iterations <= 20
    np.testing.assert_allclose(learned.objective, oracles.least_distance(points, expectations), rtol=0, atol=1e-8)
    slow = projection(mdp, expectations, method="projection", tolerance=1e-9, max_iterations=30)
    assert slow.status == Status.ITERATION_LIMIT and slow.iterations == 30
    assert_certified(slow, mdp, expectations)


@pytest.mark.parametrize("method", METHODS)
def test_two_states_in_closed_form(method):
    """Stay or go, from the first state, with a discount of one half: V is on the line x + y/2 = 2.

    Distance of (2, 2) from it: 1 / sqrt(1.25).
    """
    mdp = MDP.from_dense(
        [[[1.0, 0.0], [0.0, 1.0]], [[0.0, 1.0], [0.0, 1.0]]], discount=0.5, initial=[1, 0], features=[[1, 0], [0, 2]]
    )
    learned = projection(mdp, [2.0, 2.0], method=method, tolerance=1e-7)
    np.testing.assert_allclose([learned.objective, learned.bound], 1 / np.sqrt(1.25), rtol=0, atol=1e-7)
    np.testing.assert_allclose(learned.weights, np.array([2.0, 1.0]) / np.sqrt(5), rtol=0, atol=1e-7)
    np.testing.assert_allclose(learned.expectations, [1.2, 1.6], rtol=0, atol=1e-6)


@pytest.mark.parametrize("method", METHODS)
def test_one_feature(method):
    mdp = random_model(5, num_features=1)
    points = oracles.all_expectations(*arrays_of(mdp))
    for target, distance in ((points.max() + 2.0, 2.0), (points.min() - 1.0, 1.0), (points.mean(), 0.0)):
        learned = projection(mdp, [target], method=method, tolerance=1e-6)
        np.testing.assert_allclose([learned.objective, learned.bound], distance, rtol=0, atol=2e-6)
        assert learned.status == Status.SOLVED


def test_expectations_of_the_first_policy():
    """Nothing is to be done, and any reward explains it."""
    mdp = MDP.from_dense([[[1.0]]], discount=0.5, features=[[1.0]])
    learned = projection(mdp, [2.0])
    assert (learned.bound, learned.iterations) == (0, 0) and 0 <= learned.objective <= 1e-12
    assert learned.weights.tolist() == [0] and learned.status == Status.SOLVED


@pytest.mark.parametrize("method", METHODS)
def test_the_expert_of_a_gridworld(method):
    mdp = gridworld(6, num_regions=9, discount=0.95).mdp
    transition, discount, initial, features = arrays_of(mdp)
    weights = np.array([0, 0.3, 0, 0, -0.5, 0, 0, 0, 0.9])
    action_value = oracles.optimal_value(transition, discount, features @ weights)[1]
    expert = oracles.feature_expectations(transition, discount, initial, features, np.eye(4)[action_value.argmax(1)])
    learned = projection(mdp, expert, method=method)
    assert_certified(learned, mdp, expert)
    assert learned.status == Status.SOLVED
    # |w| times the distance bounds the loss for any reward
    loss = weights @ (expert - np.asarray(learned.expectations))
    assert abs(loss) <= np.linalg.norm(weights) * learned.objective + 1e-9


@pytest.mark.parametrize("method", METHODS)
def test_missing_actions_and_absorbing_states(method, rng):
    small = small_models.case("absorbing")
    allowed = np.ones((6, 2), bool)
    allowed[0, 1] = allowed[4, 0] = False
    mdp = MDP.from_dense(
        small.transition, discount=0.9, initial=small.initial, features=small.features, allowed=allowed
    )
    for expectations in rng.uniform(-5, 5, size=(3, 3)):
        learned = projection(mdp, expectations, method=method, tolerance=2e-2)
        assert_certified(learned, mdp, expectations)
        assert learned.status == Status.SOLVED


@pytest.mark.parametrize("method", METHODS)
def test_a_batch_is_its_lanes(method, rng):
    mdp = random_model(6)
    expectations, tolerance = rng.uniform(3, 7, size=(3, 3)), np.array([1e-2, 1e-3, 1e-1])
    batch = projection(mdp, expectations, method=method, tolerance=tolerance)
    assert batch.policy.shape == (3, 5, 3) and batch.bound.shape == (3,)
    for k in range(3):
        lane = projection(mdp, expectations[k], method=method, tolerance=tolerance[k])
        jax.tree.map(lambda one, all_, k=k: np.testing.assert_array_equal(one, all_[k]), lane, batch)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("discount", [0.9, 0.99999])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_bounds_hold_in_every_type_up_to_long_horizons(dtype, discount, method, rng):
    mdp = random_model(7, dtype=dtype, discount=discount)
    points = oracles.all_expectations(*arrays_of(mdp))
    expectations = points[5] + 0.1 / (1 - discount) * rng.uniform(-1, 1, size=3)
    learned = projection(mdp, expectations, method=method)
    assert learned.policy.dtype == learned.objective.dtype == learned.weights.dtype == dtype
    least = oracles.least_distance(points, expectations)
    digits = (1e-9 if dtype == np.float64 else 1e-6) / (1 - discount)
    assert learned.bound <= least + digits and learned.objective >= least - digits
    assert learned.objective - learned.bound <= 1e-3 / (1 - discount)


def test_features_of_very_different_scales():
    """The distance is in the features' units: the large one counts for all."""
    transition, discount, initial, features = oracles.random_mdp(np.random.default_rng(8), 5, 3, K=2)
    features = features * np.array([1e6, 1.0])
    mdp = MDP.from_dense(transition, discount=discount, initial=initial, features=features)
    points = oracles.all_expectations(transition, discount, initial, features)
    expectations = points[3] + np.array([0.0, 2.0])
    learned = projection(mdp, expectations, method="max_margin", tolerance=1e-3)
    least = oracles.least_distance(points, expectations)
    assert learned.bound - 1e-4 <= least <= learned.objective + 1e-4
    assert_certified(learned, mdp, expectations)


def test_a_tolerance_that_rounding_does_not_allow():
    mdp = random_model(0, dtype=np.float32)
    learned = projection(mdp, [3.0, 3.0, 3.0], method="max_margin", tolerance=1e-12)
    assert learned.status == Status.STALLED
    assert learned.bound <= learned.objective


@pytest.mark.parametrize("learner", [projection, mwal])
def test_models_that_are_too_wide_for_lu(learner, monkeypatch):
    """They are planned for and evaluated by programs, and say the same."""
    mdp = random_model(6)
    by_lu = learner(mdp, [5.0, 4.0, 6.0], tolerance=0.05)
    monkeypatch.setattr(exact.Exact, "is_direct", False)
    by_program = learner(mdp, [5.0, 4.0, 6.0], tolerance=0.05)
    assert by_lu.status == by_program.status == Status.SOLVED
    np.testing.assert_allclose(by_program.objective, by_lu.objective, rtol=0, atol=0.05)
    np.testing.assert_allclose(by_program.bound, by_lu.bound, rtol=0, atol=0.05)


def test_nearest_mixtures(rng):
    """Against non-negative least squares, in few and many dimensions, with points that are there twice."""
    for count, dimension in ((1, 2), (5, 2), (30, 3), (10, 12), (60, 20)):
        points = rng.normal(size=(count, dimension)) + rng.uniform(0, 2, size=dimension)
        points = np.concatenate([points, points[:2]])
        shares = nearest_mixture(points, np.eye(len(points))[0])
        assert shares.min() >= 0
        np.testing.assert_allclose(shares.sum(), 1.0, rtol=0, atol=1e-12)
        least = oracles.least_distance(points, np.zeros(dimension))
        np.testing.assert_allclose(np.linalg.norm(shares @ points), least, rtol=0, atol=1e-7)


def refused(**changes):
    arguments = {"mdp": random_model(0), "expectations": np.ones(3)} | changes
    return projection(arguments.pop("mdp"), arguments.pop("expectations"), **arguments)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"expectations": np.ones(2)}, r"expectations must have shape \(3,\) or \(B, 3\), got \(2,\)"),
        ({"expectations": np.array([[1, 2, 3], [1, np.nan, 3]])}, r"expectations\[1, 1\]"),
        ({"expectations": np.array([1, 2, np.inf])}, r"expectations\[2\]"),
        ({"expectations": np.array([1, 1e305, 0])}, r"expectations\[1\] is too large"),
        ({"method": "projections"}, r"method must be one of \('projection', 'max_margin'\), got 'projections'"),
        ({"method": ["projection"]}, "method must be one of"),
        ({"tolerance": 0.0}, "tolerance must be positive"),
        ({"tolerance": np.ones(3)}, r"tolerance must have shape \(\), got \(3,\)"),
        ({"max_iterations": 0}, "max_iterations must be at least 1, got 0"),
        ({"max_iterations": 1.5}, "max_iterations must be a whole number"),
        ({"mdp": MDP.from_dense([[[1.0]]], discount=0.5)}, "the model has no features"),
        ({"mdp": "grid"}, "mdp"),
    ],
)
def test_what_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        refused(**changes)


def test_traced_arrays_are_refused_and_constants_are_not():
    mdp = random_model(0)
    with pytest.raises(ValueError, match="outside jit, vmap and grad"):
        jax.vmap(lambda expectations: projection(mdp, expectations).objective)(jnp.ones((2, 3)))
    inside = jax.jit(lambda: projection(mdp, [1.0, 2.0, 3.0], method="max_margin").objective)()
    assert inside == projection(mdp, [1.0, 2.0, 3.0], method="max_margin").objective


def test_from_demonstrations():
    mdp = gridworld(4, num_regions=4).mdp
    walks = Demonstrations.from_trajectories([([0, 1, 2, 3], [3, 3, 3, 1]), ([0, 4, 8], [1, 1, 1])])
    expectations = np.asarray(monte_carlo_feature_expectations(mdp, walks))
    learned = projection(mdp, expectations, method="max_margin")
    assert_certified(learned, mdp, expectations)
    assert learned.status == Status.SOLVED and learned.bound > 10  # sums of few steps are far from what policies have


@pytest.mark.parametrize("size", [1e-200, 1e200])
def test_squares_that_no_number_holds(size):
    mdp = gridworld(3, num_regions=9, discount=0.9).mdp
    one = projection(mdp, np.zeros(9))
    other = projection(mdp.replace(features=size * np.asarray(mdp.features)), np.zeros(9))
    np.testing.assert_allclose(other.objective, size * one.objective, rtol=1e-6)
    assert 0 < other.bound <= other.objective and other.status == Status.SOLVED
