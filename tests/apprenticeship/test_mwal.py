"""MWAL: against HiGHS and LPAL, with the regret that its weights promise, and every claim by an independent road."""

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
import small_models

from jaxhom import MDP, Status, gridworld, lpal, mwal
from jaxhom.solvers.hedge import AdaHedge, regret_bound


def arrays_of(mdp):
    leaves = (mdp.transition, mdp.discount, mdp.initial, mdp.features)
    return tuple(np.asarray(leaf, np.float64) for leaf in leaves)


def random_model(seed, num_features=4, dtype=np.float64, **options):
    transition, discount, initial, features = oracles.random_mdp(np.random.default_rng(seed), 6, 3, K=num_features)
    options = {"discount": discount} | options
    return MDP.from_dense(transition.astype(dtype), initial=initial, features=features.astype(dtype), **options)


def optimum(mdp, expectations, weights=None):
    """The best margin by HiGHS; that of one feature, w . phi, if weights are given. Bars what is not allowed."""
    transition, discount, initial, features = arrays_of(mdp)
    if weights is not None:
        features, expectations = (features @ weights)[..., None], [weights @ expectations]
    penalty = 1e3 * (1.0 + np.abs(features).max() + np.abs(expectations).max()) / (1.0 - discount)
    features = np.where(np.asarray(mdp.allowed)[..., None], features, -penalty)
    return oracles.lpal(transition, discount, initial, features, expectations)[0]


def assert_certified(learned, mdp, expectations, eps=1e-6):
    """Every claim of one lane, recomputed; returns v*."""
    policy, weights = (np.asarray(leaf, np.float64) for leaf in (learned.policy, learned.weights))
    np.testing.assert_allclose(policy.sum(axis=1), 1.0, rtol=0, atol=eps)
    assert (policy >= 0).all() and not policy[~np.asarray(mdp.allowed)].any()
    reached = oracles.feature_expectations(*arrays_of(mdp), policy)
    size = 1.0 + np.abs(reached).max()
    np.testing.assert_allclose(learned.expectations, reached, rtol=0, atol=eps * size)
    np.testing.assert_allclose(learned.objective, (reached - expectations).min(), rtol=0, atol=eps * size)
    np.testing.assert_allclose(weights.sum(), 1.0, rtol=0, atol=eps)
    assert weights.min() >= 0
    proved = optimum(mdp, expectations, weights)
    np.testing.assert_allclose(learned.bound, proved, rtol=0, atol=eps * size)
    greedy = oracles.feature_expectations(*arrays_of(mdp), np.asarray(learned.greedy_policy, np.float64))
    np.testing.assert_allclose(weights @ (greedy - expectations), proved, rtol=0, atol=eps * size)
    best = optimum(mdp, expectations)
    assert learned.objective - eps * size <= best <= learned.bound + eps * size
    return best


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("kind", ["of a policy", "perturbed", "far too much", "far too little", "of both signs"])
def test_the_margin_is_nearly_the_best(seed, kind):
    mdp, rng = random_model(seed), np.random.default_rng(seed)
    exact = oracles.feature_expectations(*arrays_of(mdp), rng.dirichlet(np.ones(3), size=6))
    expectations = {
        "of a policy": exact,
        "perturbed": exact * rng.uniform(0.8, 1.2, size=4),
        "far too much": exact + 1000.0,
        "far too little": exact - np.array([1000.0, 0.0, 3000.0, 2.0]),
        "of both signs": rng.uniform(-10, 10, size=4),
    }[kind]
    learned = mwal(mdp, expectations, tolerance=0.03, max_iterations=3000)
    best = assert_certified(learned, mdp, expectations)
    assert learned.status == Status.SOLVED
    assert best - learned.objective <= 0.03 + 1e-6
    exactly = lpal(mdp, expectations)
    assert learned.objective <= exactly.margin_bound and learned.bound >= exactly.margin


@pytest.mark.parametrize("rounds", [1, 2, 10, 100, 500])
@pytest.mark.parametrize("seed", [0, 3])
def test_the_gap_is_within_the_regret_bound(seed, rounds):
    """S is the most that V_i - Vhat_i of a policy can spread, at most 1 / (1 - discount) and what Vhat adds."""
    mdp, rng = random_model(seed), np.random.default_rng(seed)
    expectations = oracles.feature_expectations(*arrays_of(mdp), rng.dirichlet(np.ones(3), size=6)) + rng.normal(size=4)
    features = arrays_of(mdp)[3]
    low, high = (features.min(axis=(0, 1)) / 0.1, features.max(axis=(0, 1)) / 0.1)
    spread = (high - expectations).max() - (low - expectations).min()
    learned = mwal(mdp, expectations, tolerance=1e-9, max_iterations=rounds)
    assert learned.iterations == rounds
    assert learned.bound - learned.objective <= regret_bound(4, rounds, spread)
    assert_certified(learned, mdp, expectations)


@pytest.mark.parametrize("kind", ["random", "alternating", "constant", "one is better", "huge", "shifted"])
@pytest.mark.parametrize("rounds", [1, 7, 400])
def test_regret_of_the_weights(kind, rounds, rng):
    """Against losses that know nothing of the weights, and some that do."""
    hedge, mine, total, spread = AdaHedge(5), 0.0, np.zeros(5), 0.0
    for number in range(rounds):
        losses = {
            "random": rng.uniform(size=5),
            "alternating": np.eye(5)[number % 2],
            "constant": np.ones(5),
            "one is better": np.arange(5) * 0.01,
            "huge": 1e12 * rng.uniform(size=5),
            "shifted": -1e6 + hedge.weights(),
        }[kind]
        mine += hedge.weights() @ losses
        hedge.update(losses)
        total, spread = total + losses, max(spread, losses.max() - losses.min())
    assert (mine - total.min()) / rounds <= regret_bound(5, rounds, spread) + 1e-9
    np.testing.assert_allclose(hedge.weights().sum(), 1.0)


def test_two_states_in_closed_form():
    """Stay or go, from the first state: V is on the line x + y/2 = 2, and x = y = 4/3 has the largest margin."""
    mdp = MDP.from_dense(
        [[[1.0, 0.0], [0.0, 1.0]], [[0.0, 1.0], [0.0, 1.0]]], discount=0.5, initial=[1, 0], features=[[1, 0], [0, 2]]
    )
    learned = mwal(mdp, [0.0, 0.0], tolerance=2e-2)
    np.testing.assert_allclose([learned.objective, learned.bound], 4 / 3, rtol=0, atol=2e-2)
    assert learned.objective <= 4 / 3 <= learned.bound
    np.testing.assert_allclose(learned.weights, [2 / 3, 1 / 3], rtol=0, atol=2e-2)


def test_one_feature_takes_one_round():
    mdp = random_model(5, num_features=1)
    learned = mwal(mdp, [3.0], tolerance=1e-6)
    assert learned.iterations == 1 and learned.status == Status.SOLVED
    np.testing.assert_allclose([learned.objective, learned.bound], optimum(mdp, np.array([3.0])), rtol=0, atol=1e-6)


def test_a_gridworld():
    mdp, rng = gridworld(6, num_regions=9, discount=0.95).mdp, np.random.default_rng(2)
    expectations = oracles.feature_expectations(*arrays_of(mdp), rng.dirichlet(np.ones(4), size=36))
    expectations = expectations * rng.uniform(0.8, 1.2, size=9)
    learned = mwal(mdp, expectations)
    assert learned.status == Status.SOLVED
    assert_certified(learned, mdp, expectations)
    np.testing.assert_allclose(learned.bound - learned.objective, 0, rtol=0, atol=0.02)


def test_missing_actions_and_absorbing_states(rng):
    small = small_models.case("absorbing")
    allowed = np.ones((6, 2), bool)
    allowed[0, 1] = allowed[4, 0] = False
    mdp = MDP.from_dense(
        small.transition, discount=0.9, initial=small.initial, features=small.features, allowed=allowed
    )
    for expectations in rng.uniform(-5, 5, size=(3, 3)):
        learned = mwal(mdp, expectations, tolerance=0.05)
        assert_certified(learned, mdp, expectations)
        assert learned.status == Status.SOLVED


def test_a_batch_is_its_lanes(rng):
    mdp = random_model(6)
    expectations, tolerance = rng.uniform(3, 7, size=(3, 4)), np.array([1e-1, 5e-2, 1.0])
    batch = mwal(mdp, expectations, tolerance=tolerance)
    assert batch.policy.shape == (3, 6, 3) and batch.bound.shape == (3,)
    for k in range(3):
        lane = mwal(mdp, expectations[k], tolerance=tolerance[k])
        jax.tree.map(lambda one, all_, k=k: np.testing.assert_array_equal(one, all_[k]), lane, batch)


@pytest.mark.parametrize("discount", [0.9, 0.99999])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_bounds_hold_in_every_type_up_to_long_horizons(dtype, discount, rng):
    mdp = random_model(7, dtype=dtype, discount=discount)
    expectations = rng.uniform(0.3, 0.7, size=4) / (1 - discount)
    learned = mwal(mdp, expectations, max_iterations=200)
    assert learned.policy.dtype == learned.objective.dtype == learned.weights.dtype == dtype
    exactly = lpal(mdp, expectations)
    assert learned.objective <= exactly.margin_bound and learned.bound >= exactly.margin
    assert learned.bound - learned.objective <= 0.05 / (1 - discount)


def test_a_feature_that_is_never_the_smallest_has_no_say():
    """Its scale would drown the others."""
    transition, discount, initial, features = oracles.random_mdp(np.random.default_rng(8), 6, 3, K=3)
    features = features * np.array([1.0, 1.0, 1e6])
    mdp = MDP.from_dense(transition, discount=discount, initial=initial, features=features)
    learned = mwal(mdp, [5.0, 5.0, -1e7], tolerance=0.05)
    assert learned.status == Status.SOLVED and learned.weights[2] == 0
    assert_certified(learned, mdp, np.array([5.0, 5.0, -1e7]))


def test_limits_and_rounding():
    mdp = random_model(1)
    few = mwal(mdp, [5.0] * 4, max_iterations=3, tolerance=1e-6)
    assert few.status == Status.ITERATION_LIMIT and few.iterations == 3
    one = random_model(5, num_features=1, dtype=np.float32)
    assert mwal(one, [3.0], tolerance=1e-13, max_iterations=2).status != Status.SOLVED


def refused(**changes):
    arguments = {"mdp": random_model(0), "expectations": np.ones(4)} | changes
    return mwal(arguments.pop("mdp"), arguments.pop("expectations"), **arguments)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"expectations": np.ones(2)}, r"expectations must have shape \(4,\) or \(B, 4\), got \(2,\)"),
        ({"expectations": np.array([[1, 2, 3, 4], [1, np.nan, 3, 4]])}, r"expectations\[1, 1\]"),
        ({"expectations": np.array([1, 2, np.inf, 0])}, r"expectations\[2\]"),
        ({"tolerance": -1.0}, "tolerance must be positive"),
        ({"tolerance": np.ones(3)}, r"tolerance must have shape \(\), got \(3,\)"),
        ({"max_iterations": 0}, "max_iterations must be at least 1, got 0"),
        ({"mdp": MDP.from_dense([[[1.0]]], discount=0.5)}, "the model has no features"),
        ({"mdp": 3}, "mdp"),
    ],
)
def test_what_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        refused(**changes)


def test_traced_arrays_are_refused_and_constants_are_not():
    mdp = random_model(0)
    with pytest.raises(ValueError, match="outside jit, vmap and grad"):
        jax.vmap(lambda expectations: mwal(mdp, expectations).objective)(jnp.ones((2, 4)))
    assert jax.jit(lambda: mwal(mdp, [5.0] * 4).objective)() == mwal(mdp, [5.0] * 4).objective
