"""Maximum causal entropy against soft value iteration in NumPy, differences, and minimisation without derivatives."""

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
import oracles
import pytest
import scipy.optimize
import small_models

import jaxhom
from jaxhom.apprenticeship import causal_entropy, descent
from jaxhom.apprenticeship.causal_entropy import Evidence, HostObjective, objective_in_program, scaled_features
from jaxhom.models.mdp import MDP
from jaxhom.planning.host_chains import host_model

WALKS = [([0, 1, 2, 3, 0], [1, 0, 2, 1, 1]), ([4, 5, 1], [0, 2, 2])]


def problem(seed=0, *, K=2, restricts=False, dtype=np.float64, scales=None):
    """A random model of 7 states and its arrays; walks in it."""
    rng = np.random.default_rng(seed)
    transition, discount, initial, features = oracles.random_mdp(rng, 7, 3, K=K)
    features = features * (np.ones(K) if scales is None else np.asarray(scales))
    allowed = np.ones((7, 3), bool)
    if restricts:
        allowed[[2, 5, 6], [0, 0, 1]] = False
    arrays = {"discount": discount, "initial": initial.astype(dtype), "features": features.astype(dtype)}
    mdp = MDP.from_dense(transition.astype(dtype), allowed=allowed, **arrays)
    demonstrations = jaxhom.Demonstrations.from_trajectories(WALKS)
    steps = [pair for states, actions in WALKS for pair in zip(states, actions, strict=True)]
    return mdp, (transition, discount, initial, features), allowed, demonstrations, steps


def oracle(arrays, allowed, evidence, scale, *, l1=0.0, l2=1e-3):
    """The objective with penalties, as a function of weights of the features as they are."""
    transition, discount, initial, features = arrays
    features = np.where(allowed[..., None], features, 0.0)

    def objective(weights):
        forbidding = np.where(allowed, 0.0, -np.inf)
        policy, value, _ = oracles.soft_optimal(transition, discount, features @ weights + forbidding)
        if "steps" in evidence:
            fit = -np.mean([np.log(policy[s, a]) for s, a in evidence["steps"]])
        else:
            fit = (1 - discount) * (initial @ value - weights @ evidence["expectations"])
        scaled = weights * scale
        return fit + l1 * np.abs(scaled).sum() + 0.5 * l2 * scaled @ scaled

    return objective


def minimum(objective, K, nonnegative):
    """Without derivatives, from several starts; the best is refined."""
    bounds = [(0, 60) if nonnegative else (-60, 60)] * K

    def run(start, xatol, fatol):
        options = {"xatol": xatol, "fatol": fatol, "maxiter": 4000, "maxfev": 4000}
        return scipy.optimize.minimize(objective, start, method="Nelder-Mead", bounds=bounds, options=options)

    starts = [np.full(K, 0.1), np.full(K, 2.0), np.arange(K) + 0.5]
    best = min((run(start, 1e-2, 1e-4) for start in starts), key=lambda one: one.fun)
    return run(best.x, 1e-9, 1e-13)


@pytest.mark.parametrize("restricts", [False, True])
@pytest.mark.parametrize("nonnegative", [True, False])
@pytest.mark.parametrize("kind", ["demonstrations", "expectations"])
def test_the_minimum_is_the_oracles(kind, nonnegative, restricts):
    mdp, arrays, allowed, demonstrations, steps = problem(restricts=restricts)
    vhat = np.array([3.0, 5.5])
    given = {"demonstrations": demonstrations} if kind == "demonstrations" else {"expectations": vhat}
    evidence = {"steps": steps} if kind == "demonstrations" else {"expectations": vhat}
    learned = jaxhom.max_causal_entropy(mdp, nonnegative=nonnegative, l2=0.01, **given)
    scale = scaled_features(mdp)[1]
    objective = oracle(arrays, allowed, evidence, scale, l2=0.01)
    best = minimum(objective, 2, nonnegative)
    np.testing.assert_allclose(learned.objective, objective(np.asarray(learned.weights)), rtol=1e-9)
    np.testing.assert_allclose(learned.objective, best.fun, atol=1e-8)
    np.testing.assert_allclose(learned.weights, best.x, atol=1e-3)
    assert learned.status == jaxhom.Status.SOLVED and learned.gradient_norm <= 1e-6


def test_policies_go_with_the_weights():
    mdp, arrays, _, demonstrations, _ = problem()
    learned = jaxhom.max_causal_entropy(mdp, demonstrations)
    transition, discount, initial, features = arrays
    reward = features @ np.asarray(learned.weights)
    np.testing.assert_allclose(learned.policy, oracles.soft_optimal(transition, discount, reward)[0], atol=1e-8)
    value = oracles.optimal_value(transition, discount, reward)[0]
    np.testing.assert_allclose(
        oracles.policy_value(transition, discount, np.asarray(learned.greedy_policy), reward), value
    )
    expected = oracles.feature_expectations(transition, discount, initial, features, np.asarray(learned.policy))
    np.testing.assert_allclose(learned.expectations, expected)


@pytest.mark.parametrize("kind", ["demonstrations", "expectations"])
@pytest.mark.parametrize("restricts", [False, True])
def test_gradients_against_differences(kind, restricts):
    """On the host and in a program."""
    mdp, arrays, allowed, demonstrations, steps = problem(K=3, restricts=restricts)
    features, scale = scaled_features(mdp)
    vhat = np.array([1.0, 4.0, 2.0])
    if kind == "demonstrations":
        evidence = Evidence(frequencies=causal_entropy.frequencies_of(mdp, demonstrations))
    else:
        evidence = Evidence(expectations=vhat / scale)
    parts = {"steps": steps} if kind == "demonstrations" else {"expectations": vhat}
    expected = oracle(arrays, allowed, parts, scale, l2=0.0)
    weights = np.array([0.5, 2.0, -1.0])
    value, gradient = HostObjective(mdp, host_model(mdp), features, evidence)(weights)
    differences = [(expected((weights + h) / scale) - expected((weights - h) / scale)) / 2e-5 for h in 1e-5 * np.eye(3)]
    np.testing.assert_allclose(value, expected(weights / scale))
    np.testing.assert_allclose(gradient, differences, atol=1e-8)
    inside = jax.jit(jax.value_and_grad(lambda w: objective_in_program(mdp, features, evidence, w, jnp.zeros(7))[0]))
    np.testing.assert_allclose(inside(weights)[0], value, rtol=1e-9)
    np.testing.assert_allclose(inside(weights)[1], gradient, atol=1e-9)


def test_expectations_that_a_policy_has_are_matched():
    """Without penalties, and of a policy that does everything everywhere, so that weights stay finite."""
    case = small_models.case("dense")
    policy = small_models.random_policy(np.random.default_rng(0), *case.shape)
    vhat = oracles.feature_expectations(*case.arrays, policy)
    learned = jaxhom.max_causal_entropy(case.mdp, expectations=vhat, nonnegative=False, l2=0.0, tolerance=1e-8)
    np.testing.assert_allclose(learned.expectations, vhat, atol=1e-5)
    signed = jaxhom.max_causal_entropy(case.mdp, expectations=vhat, l2=0.0, tolerance=1e-8)
    assert (signed.expectations >= vhat - 1e-5).all()  # at least: where the weight is 0 it may be more
    np.testing.assert_allclose(np.asarray(signed.weights) * (signed.expectations - vhat), 0, atol=1e-5)


def test_the_two_objectives_agree_on_endless_walks_without_chance():
    """Weighted by gamma^t, the log-likelihood of a walk telescopes to V(s_0) - w . its discounted features."""
    transition = np.eye(3)[np.array([[1, 2], [2, 0], [0, 1]])]
    features = np.random.default_rng(3).normal(size=(3, 2, 2))
    mdp = MDP.from_dense(transition, discount=0.5, initial=[1, 0, 0], features=features)
    states, actions, discount = [0], [], 0.5
    for t in range(60):
        actions.append((t * t) % 2)
        states.append(int(transition[states[-1], actions[-1]].argmax()))
    weights = np.array([0.4, -1.2])
    policy, value, _ = oracles.soft_optimal(transition, discount, features @ weights)
    weighted = [-(discount**t) * np.log(policy[s, a]) for t, (s, a) in enumerate(zip(states, actions, strict=False))]
    walks = jaxhom.Demonstrations.from_trajectories([(states, actions)])
    vhat = np.asarray(jaxhom.monte_carlo_feature_expectations(mdp, walks))
    np.testing.assert_allclose(np.sum(weighted), value[0] - weights @ vhat, atol=1e-9)


@pytest.mark.parametrize(
    "optimizer", [optax.adam(0.1), optax.sgd(2.0), optax.lbfgs(), optax.chain(optax.clip(1.0), optax.adam(0.05))]
)
def test_any_optimiser_finds_the_same(optimizer):
    mdp, _, _, demonstrations, _ = problem()
    expected = jaxhom.max_causal_entropy(mdp, demonstrations, l2=0.05)
    learned = jaxhom.max_causal_entropy(mdp, demonstrations, l2=0.05, optimizer=optimizer, max_iterations=3000)
    np.testing.assert_allclose(learned.objective, expected.objective, atol=1e-6)
    np.testing.assert_allclose(learned.weights, expected.weights, atol=1e-2)
    assert learned.gradient_norm <= 1e-4


@functools.cache
def penalised():
    """Of three features: the least objective by the oracle, and weights without a penalty on the sum."""
    mdp, arrays, allowed, demonstrations, steps = problem(K=3)
    objective = oracle(arrays, allowed, {"steps": steps}, scaled_features(mdp)[1], l1=0.05, l2=1e-2)
    plain = jaxhom.max_causal_entropy(mdp, demonstrations, nonnegative=False, l2=1e-2)
    return mdp, demonstrations, minimum(objective, 3, nonnegative=False).fun, plain.weights


@pytest.mark.parametrize("optimizer", [None, optax.adam(0.05)])
def test_a_penalty_on_the_sum_makes_weights_zero(optimizer):
    """Of free weights, and as the oracle has it."""
    mdp, demonstrations, least, plain = penalised()
    options = {"nonnegative": False, "l2": 1e-2, "optimizer": optimizer, "max_iterations": 3000}
    sparse = jaxhom.max_causal_entropy(mdp, demonstrations, l1=0.05, **options)
    assert (plain == 0).sum() < (sparse.weights == 0).sum()
    np.testing.assert_allclose(sparse.objective, least, atol=1e-6)
    huge = jaxhom.max_causal_entropy(mdp, demonstrations, l1=1e3, **options)
    assert (huge.weights == 0).all()
    np.testing.assert_allclose(huge.policy, 1 / 3)


def test_units_of_features_do_not_matter():
    one = problem(K=3)
    other = problem(K=3, scales=[1e6, 1.0, 1e-3])
    learned = jaxhom.max_causal_entropy(one[0], one[3])
    again = jaxhom.max_causal_entropy(other[0], other[3])
    np.testing.assert_allclose(again.policy, learned.policy, atol=1e-5)
    np.testing.assert_allclose(again.weights * np.array([1e6, 1.0, 1e-3]), learned.weights, atol=1e-4)


def test_constant_features_have_no_weight():
    mdp, *_, demonstrations, _ = problem(K=3)
    features = np.array(mdp.features)
    features[..., 1] = 4.0
    learned = jaxhom.max_causal_entropy(mdp.replace(features=features), demonstrations)
    assert learned.weights[1] == 0 and np.isfinite(learned.expectations).all()


def test_batches_of_expectations_are_lane_by_lane():
    mdp, *_ = problem(K=3)
    vhat = np.random.default_rng(1).uniform(1, 6, size=(3, 3))
    learned = jaxhom.max_causal_entropy(mdp, expectations=vhat)
    for lane in range(3):
        one = jaxhom.max_causal_entropy(mdp, expectations=vhat[lane])
        chex.assert_trees_all_close(jax.tree.map(lambda leaf, lane=lane: leaf[lane], learned), one, atol=1e-8)


def test_inside_programs():
    """Under jit and vmap, in expectations and in demonstrations; by another optimiser, so to its tolerance."""
    mdp, _, _, demonstrations, _ = problem()
    vhat = np.array([[3.0, 5.0], [4.0, 4.5]])
    expected = jaxhom.max_causal_entropy(mdp, expectations=vhat, l2=0.05)
    fit = lambda vhat: jaxhom.max_causal_entropy(mdp, expectations=vhat, l2=0.05, tolerance=1e-5)  # noqa: E731
    for found in (jax.vmap(fit)(vhat), jax.jit(fit)(vhat)):
        np.testing.assert_allclose(found.objective, expected.objective, atol=1e-6)
        np.testing.assert_allclose(found.policy, expected.policy, atol=1e-3)
        assert (found.status == jaxhom.Status.SOLVED).all()
    inside = jax.jit(lambda walks: jaxhom.max_causal_entropy(mdp, walks, l2=0.05))(demonstrations)
    outside = jaxhom.max_causal_entropy(mdp, demonstrations, l2=0.05)
    np.testing.assert_allclose(inside.objective, outside.objective, atol=1e-6)
    np.testing.assert_allclose(inside.greedy_policy, outside.greedy_policy)


def test_float32():
    mdp, *_, demonstrations, _ = problem(dtype=np.float32)
    exact, *_ = problem()
    learned = jaxhom.max_causal_entropy(mdp, demonstrations)
    expected = jaxhom.max_causal_entropy(exact, demonstrations)
    chex.assert_type([learned.policy, learned.weights, learned.objective, learned.gradient_norm], jnp.float32)
    np.testing.assert_allclose(learned.policy, expected.policy, atol=1e-3)
    inside = jax.jit(lambda walks: jaxhom.max_causal_entropy(mdp, walks))(demonstrations)
    np.testing.assert_allclose(inside.objective, expected.objective, atol=1e-4)


def test_what_is_done_where_nothing_is_decided_does_not_count():
    """Steps in the absorbing goal, whose features depend on the action."""
    transition = np.eye(3)[np.array([[1, 0], [2, 1], [2, 2]])]
    features = np.zeros((3, 2, 2))
    features[2, 0, 0] = features[2, 1, 1] = 1.0
    mdp = MDP.from_dense(transition, discount=0.9, features=features)
    short = jaxhom.Demonstrations.from_trajectories([([0, 1], [0, 0])])
    long = jaxhom.Demonstrations.from_trajectories([([0, 1, 2, 2, 2], [0, 0, 1, 1, 1])])
    np.testing.assert_allclose(
        jaxhom.max_causal_entropy(mdp, short).weights, jaxhom.max_causal_entropy(mdp, long).weights
    )
    only = jaxhom.Demonstrations.from_trajectories([([2, 2], [1, 1])])
    with pytest.raises(ValueError, match="demonstrations hold no decision"):
        jaxhom.max_causal_entropy(mdp, only)


def test_limits_are_told_and_a_start_is_used():
    mdp, *_, demonstrations, _ = problem(K=3)
    limited = jaxhom.max_causal_entropy(mdp, demonstrations, max_iterations=1)
    assert limited.status == jaxhom.Status.ITERATION_LIMIT and limited.gradient_norm > 1e-6
    inside = jaxhom.max_causal_entropy(mdp, demonstrations, max_iterations=3, optimizer=optax.adam(0.1))
    assert inside.status == jaxhom.Status.ITERATION_LIMIT and inside.iterations == 3
    solved = jaxhom.max_causal_entropy(mdp, demonstrations)
    again = jaxhom.max_causal_entropy(mdp, demonstrations, initial_weights=solved.weights, tolerance=1e-5)
    assert again.iterations == 0 and again.status == jaxhom.Status.SOLVED
    strict = jaxhom.max_causal_entropy(mdp, demonstrations, nonnegative=False, tolerance=1e-300, max_iterations=200)
    assert strict.status == jaxhom.Status.STALLED


def test_grids_from_one_walk():
    """Far from where the walk went the greedy policy is nearly the expert's; a uniform one is worth a tenth."""
    grid = jaxhom.gridworld(16, num_regions=64)
    shares = []
    for seed in range(3):
        reward = grid.mdp.features @ jaxhom.sample_weights(jax.random.key(seed), 64)
        expert = jaxhom.optimal_policy(grid.mdp, reward)
        walks = jaxhom.sample_demonstrations(jax.random.key(seed), grid.mdp, expert.policy, 10, 50)
        learned = jaxhom.max_causal_entropy(grid.mdp, walks)
        value = jaxhom.policy_value(grid.mdp, learned.greedy_policy, reward) @ grid.mdp.initial
        shares.append(float(value / (expert.value @ grid.mdp.initial)))
    assert np.mean(shares) >= 0.998


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"expectations": np.ones(2)}, "either demonstrations or expectations"),
        ({"demonstrations": None}, "either demonstrations or expectations"),
        ({"demonstrations": [([0], [0])]}, "demonstrations must be Demonstrations, got list"),
        ({"demonstrations": None, "expectations": np.ones(3)}, "expectations must have shape"),
        ({"demonstrations": None, "expectations": [1.0, np.nan]}, r"expectations\[1\] must be finite"),
        ({"l1": -1.0}, "l1 must not be negative"),
        ({"l2": [1.0, 2.0]}, "l2 must be a number"),
        ({"tolerance": 0.0}, "tolerance must be positive"),
        ({"max_iterations": 0}, "max_iterations must be at least 1"),
        ({"optimizer": "adam"}, "optimizer must be an optax.GradientTransformation, got 'adam'"),
        ({"initial_weights": [1.0, -1.0]}, r"initial_weights\[1\] must not be negative unless"),
        ({"initial_weights": [1.0]}, "initial_weights must have shape"),
    ],
)
def test_bad_arguments_are_refused(change, message):
    mdp, *_, demonstrations, _ = problem()
    with pytest.raises(ValueError, match=message):
        jaxhom.max_causal_entropy(mdp, **{"demonstrations": demonstrations} | change)


def test_a_model_without_features_is_refused():
    mdp = MDP.from_dense(np.eye(2)[:, None], discount=0.9)
    with pytest.raises(ValueError, match="no features"):
        jaxhom.max_causal_entropy(mdp, jaxhom.Demonstrations.from_trajectories([([0], [0])]))


@pytest.mark.parametrize("optimizer", [None, optax.sgd(0.1)], ids=["default", "of the user"])
def test_programs_are_compiled_once_per_optimiser(optimizer):
    mdp = jaxhom.gridworld(4, num_regions=4).mdp

    def learn(expectations):
        return jaxhom.max_causal_entropy(mdp, expectations=expectations, optimizer=optimizer, max_iterations=3).weights

    before = []
    for _ in range(3):
        jax.vmap(learn)(jnp.ones((2, 4)))
        before.append(descent._descend._cache_size())
    assert len(set(before)) == 1
