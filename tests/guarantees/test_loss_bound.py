"""The bound on what is lost, against enumeration of all policies that agree with the expert."""

import functools
import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
import small_models

import jaxhom
from jaxhom import MDP, Demonstrations, Status, loss_bound
from jaxhom.guarantees import first_steps
from jaxhom.planning import policy_iteration

SEEDS, CASES = 20, 50  # of random models: seeds times cases of each
KINDS = ("deterministic", "stochastic", "missing actions", "absorbing")


class Problem(NamedTuple):
    """A small model, an expert that was seen, and a policy; `arrays` are what the oracles take."""

    mdp: MDP
    arrays: tuple
    demonstrations: Demonstrations
    expert: np.ndarray
    agreed: np.ndarray
    allowed: np.ndarray
    policy: np.ndarray

    @property
    def best(self):
        """U, and the policies that attain it."""
        return oracles.best_agreeing(*self.arrays, self.expert, self.agreed, self.allowed)

    @property
    def own(self):
        return oracles.feature_expectations(*self.arrays, self.policy)


def problem(rng, kind="deterministic", num_features=3, discount=0.9, states=6, steps=3):
    """A random problem with two actions."""
    transition, _, initial, features = oracles.random_mdp(rng, states, 2, N=3, K=num_features)
    features -= 0.3
    allowed = np.ones((states, 2), bool)
    if kind == "missing actions":
        allowed[rng.random(states) < 0.3, 1] = False
    if kind == "absorbing":
        transition[:2] = np.eye(states)[:2, None]
    acts = rng.dirichlet(np.ones(2), states) if kind == "stochastic" else np.eye(2)[rng.integers(2, size=states)]
    acts = np.where(allowed, acts, 0.0)
    acts = np.where(acts.sum(axis=1, keepdims=True) > 0, acts, np.eye(2)[0])
    acts /= acts.sum(axis=1, keepdims=True)
    walks = oracles.sample_trajectories(rng, transition, initial, acts, 6 if kind == "stochastic" else 1, steps)
    visited, expert = oracles.empirical_policy(states, 2, walks)
    agreed = visited & ~oracles.absorbing(np.where(allowed[..., None], transition, transition[:, :1]))
    policy = rng.dirichlet(np.ones(2), states) * allowed
    policy /= policy.sum(axis=1, keepdims=True)
    if rng.random() < 0.5:
        policy = np.where(agreed[:, None], expert, policy)
    mdp = MDP.from_dense(transition, discount=discount, initial=initial, features=features, allowed=allowed)
    arrays = (transition, discount, initial, features)
    return Problem(mdp, arrays, Demonstrations.from_trajectories(walks), expert, agreed, allowed, policy)


def worst_loss(given, weights):
    """The largest loss against any policy that agrees with the expert, by enumeration."""
    policies = oracles.agreeing_policies(given.expert, given.agreed, given.allowed)
    return ((oracles.expectations_of_policies(*given.arrays, policies) - given.own) @ weights).max()


@pytest.mark.parametrize("seed", range(SEEDS))
def test_the_bound_holds_for_all_experts_and_rewards(seed):
    rng = np.random.default_rng(seed)
    for number in range(CASES):
        given = problem(rng, KINDS[number % len(KINDS)], num_features=1 + number % 3)
        best, _ = given.best
        weights = rng.exponential(size=len(best))
        loss = loss_bound(given.mdp, given.demonstrations, given.policy, weights=weights)
        assert worst_loss(given, weights) <= loss.bound
        assert loss.bound == pytest.approx(weights @ (best - given.own), abs=1e-8)
        assert loss.status == Status.SOLVED
        np.testing.assert_array_equal(loss.agreed, given.agreed)
        np.testing.assert_allclose(loss.optima, best, rtol=0, atol=1e-9)
        assert (loss.optima >= best - 1e-13).all()
        assert (loss.expectations <= given.own + 1e-13).all()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("num_features", [1, 3])
def test_an_expert_attains_it(kind, num_features, rng):
    for _ in range(20):
        given = problem(rng, kind, num_features)
        corners = [worst_loss(given, weights) for weights in np.eye(num_features)]
        loss = loss_bound(given.mdp, given.demonstrations, given.policy)
        assert loss.bound == pytest.approx(max(corners), abs=1e-8)
        assert corners[int(loss.worst)] == pytest.approx(max(corners), abs=1e-8)
        np.testing.assert_allclose(loss.gaps, corners, rtol=0, atol=1e-8)
        for weights, corner in zip(np.eye(num_features), corners, strict=True):
            found = loss_bound(given.mdp, given.demonstrations, given.policy, weights=2.0 * weights)
            assert found.bound == pytest.approx(2.0 * corner, abs=1e-8)


@pytest.mark.parametrize("kind", KINDS)
def test_contributions_are_the_performance_difference(kind, rng):
    for _ in range(20):
        given = problem(rng, kind)
        transition, discount, initial, features = given.arrays
        weights = rng.exponential(size=3)
        _, best = given.best
        parts = [
            oracles.loss_by_states(transition, discount, initial, features[..., k], best[k], given.policy)
            for k in range(3)
        ]
        loss = loss_bound(given.mdp, given.demonstrations, given.policy)
        np.testing.assert_allclose(loss.contributions, parts[int(loss.worst)], rtol=0, atol=1e-9)
        assert loss.contributions.sum() == pytest.approx(float(loss.bound), rel=1e-6, abs=1e-9)
        loss = loss_bound(given.mdp, given.demonstrations, given.policy, weights=weights)
        np.testing.assert_allclose(loss.contributions, weights @ parts, rtol=0, atol=1e-9)
        assert loss.contributions.sum() == pytest.approx(float(loss.bound), rel=1e-6, abs=1e-9)
        agrees = given.agreed & (np.abs(given.policy - given.expert).max(axis=1) < 1e-12)
        np.testing.assert_array_equal(np.asarray(loss.contributions)[agrees], 0.0)


def test_a_policy_that_agrees_has_no_negative_gap(rng):
    for kind in KINDS:
        given = problem(rng, kind)
        policy = np.where(given.agreed[:, None], given.expert, given.policy)
        loss = loss_bound(given.mdp, given.demonstrations, policy)
        assert (loss.gaps >= 0).all()
        np.testing.assert_array_equal(np.asarray(loss.contributions)[given.agreed], 0.0)


def test_a_policy_can_be_better_than_the_expert(rng):
    """Where the expert is seen everywhere and does badly."""
    given = problem(rng, steps=60, num_features=1)
    mdp = given.mdp
    best = jaxhom.optimal_policy(mdp, mdp.features[..., 0])
    everywhere = Demonstrations.from_trajectories([([s], [1 - int(best.policy[s].argmax())]) for s in range(6)])
    loss = loss_bound(mdp, everywhere, best)
    assert loss.agreed.all()
    worst = np.eye(2)[1 - np.asarray(best.policy).argmax(axis=1)]
    expected = [oracles.feature_expectations(*given.arrays, policy) for policy in (worst, np.asarray(best.policy))]
    assert loss.bound == pytest.approx(float((expected[0] - expected[1])[0]), abs=1e-8)
    assert loss.bound < 0


def test_nothing_known_is_no_agreement():
    """An absorbing state decides nothing: U is the optimum over all policies."""
    mdp = small_models.case("absorbing").mdp
    loss = loss_bound(
        mdp, Demonstrations.from_trajectories([([2, 2], [0, 1])]), jaxhom.optimal_policy(mdp, mdp.features[..., 0])
    )
    best = jaxhom.optimal_policy(mdp, jnp.moveaxis(mdp.features, -1, 0)).value @ mdp.initial
    assert not loss.agreed.any()
    np.testing.assert_allclose(loss.optima, best, rtol=0, atol=1e-9)
    assert abs(loss.gaps[0]) < 1e-9


# ----------------------------------------------------------------------------------- first steps


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("horizon", [1, 2, 7])
def test_the_first_steps(kind, horizon, rng):
    for _ in range(10):
        given = problem(rng, kind)
        transition, discount, initial, features = given.arrays
        where = np.where(given.allowed[..., None], features, -1e9)  # what is not allowed is never the best
        best = oracles.best_agreeing_steps(transition, discount, initial, where, given.expert, given.agreed, horizon)
        own = [
            oracles.steps_of_policies(transition, discount, initial, features[..., k], [given.policy] * horizon)
            for k in range(3)
        ]
        loss = loss_bound(given.mdp, given.demonstrations, given.policy, horizon=horizon)
        np.testing.assert_allclose(loss.gaps, best - own, rtol=0, atol=1e-9)
        assert (loss.gaps >= best - own).all()
        assert loss.contributions.sum() == pytest.approx(float(loss.bound), rel=1e-6, abs=1e-9)
        weights = rng.exponential(size=3)
        loss = loss_bound(given.mdp, given.demonstrations, given.policy, horizon=horizon, weights=weights)
        assert loss.bound == pytest.approx(weights @ (best - own), abs=1e-8)
        assert loss.contributions.sum() == pytest.approx(float(loss.bound), rel=1e-6, abs=1e-9)


def test_the_first_steps_by_enumeration(rng):
    """All sequences of three policies on three states."""
    given = problem(rng, states=3, steps=1, num_features=1)
    transition, discount, initial, features = given.arrays
    policies = oracles.agreeing_policies(given.expert, given.agreed)
    worth = [
        oracles.steps_of_policies(transition, discount, initial, features[..., 0], sequence)
        for sequence in itertools.product(policies, repeat=3)
    ]
    assert len(worth) == 4**3
    loss = loss_bound(given.mdp, given.demonstrations, given.policy, horizon=3)
    assert loss.optima[0] == pytest.approx(max(worth), abs=1e-9)


def test_features_one_at_a_time(rng, monkeypatch):
    """As where the values of all times would not fit."""
    given, weights = problem(rng), rng.exponential(size=3)
    together = loss_bound(given.mdp, given.demonstrations, given.policy, weights=weights, horizon=5)
    monkeypatch.setattr(first_steps, "_NUMBERS_AT_A_TIME", 1)
    alone = loss_bound(given.mdp, given.demonstrations, given.policy, weights=weights, horizon=5)
    np.testing.assert_allclose(alone.contributions, together.contributions, rtol=0, atol=1e-12)


def test_many_steps_are_all_time(rng):
    given = problem(rng, "stochastic")
    few = loss_bound(given.mdp, given.demonstrations, given.policy, horizon=400)
    many = loss_bound(given.mdp, given.demonstrations, given.policy, horizon=2**70)
    np.testing.assert_allclose(many.bound, few.bound, rtol=1e-12)
    forever = loss_bound(given.mdp, given.demonstrations, given.policy)
    np.testing.assert_allclose(few.gaps, forever.gaps, rtol=0, atol=1e-8)
    np.testing.assert_allclose(few.contributions, forever.contributions, rtol=0, atol=1e-8)


# ---------------------------------------------------------------------------- models of all kinds


@functools.cache
def walks_on(name):
    case = small_models.case(name)
    rng = np.random.default_rng(5)
    expert = np.eye(case.shape[1])[rng.integers(case.shape[1], size=case.shape[0])]
    walks = oracles.sample_trajectories(rng, case.transition, case.initial, expert, 3, 6)
    return Demonstrations.from_trajectories(walks), walks


def restricted(case, walks):
    """The model [S, A, ...] in which demonstrated states have the expert's row for every action; its U by planning."""
    transition, discount, initial, features = case.arrays
    visited, expert = oracles.empirical_policy(*case.shape, walks)
    agreed = visited & ~oracles.absorbing(transition)
    transition, features = transition.copy(), features.copy()
    transition[agreed] = np.einsum("sa,sat->st", expert, transition)[agreed, None]
    features[agreed] = np.einsum("sa,sak->sk", expert, features)[agreed, None]
    values = [oracles.optimal_value(transition, discount, features[..., k])[0] for k in range(features.shape[2])]
    return np.array([initial @ value for value in values])


def check_against_planning(case, demonstrations, walks, policy, atol):
    """The bound against dense policy iteration; it holds, and is within `atol`."""
    gaps = restricted(case, walks) - oracles.feature_expectations(*case.arrays, policy)
    loss = loss_bound(case.mdp, demonstrations, policy)
    assert (np.asarray(loss.gaps, float) >= gaps - 1e-10).all()
    np.testing.assert_allclose(loss.gaps, gaps, rtol=0, atol=atol)
    return loss


def test_small_models(case, rng):
    demonstrations, walks = walks_on(case.name)
    policy = small_models.random_policy(rng, *case.shape)
    loss = check_against_planning(case, demonstrations, walks, policy, 1e-8)
    assert loss.contributions.sum() == pytest.approx(float(loss.bound), rel=1e-6, abs=1e-8)


def test_float32_holds_against_float64(case, rng):
    """The same numbers in a shorter type: the bound is above what they say, rows as they are stored."""
    demonstrations, walks = walks_on(case.name)
    case = small_models.in_float32(case)
    policy = small_models.random_policy(rng, *case.shape).astype(np.float32)
    loss = check_against_planning(case, demonstrations, walks, policy.astype(float), 2e-2)
    assert loss.bound.dtype == loss.contributions.dtype == np.float32
    worst = restricted(case, walks) - oracles.feature_expectations(*case.arrays, policy.astype(float))
    assert float(loss.bound) >= worst.max()


def test_float32_of_a_stochastic_expert(rng):
    for _ in range(20):
        given = problem(rng, "stochastic")
        rounded = [np.asarray(array, np.float32) for array in (given.arrays[0], given.arrays[2], given.arrays[3])]
        mdp = MDP.from_dense(rounded[0], discount=0.9, initial=rounded[1], features=rounded[2])
        arrays = rounded[0].astype(float), float(np.float32(0.9)), rounded[1].astype(float), rounded[2].astype(float)
        policy = given.policy.astype(np.float32)
        loss = loss_bound(mdp, given.demonstrations, policy)
        best, _ = oracles.best_agreeing(*arrays, given.expert, given.agreed)
        gaps = best - oracles.feature_expectations(*arrays, policy.astype(float))
        assert (np.asarray(loss.gaps, float) >= gaps).all()
        np.testing.assert_allclose(loss.gaps, gaps, rtol=0, atol=1e-3)


@pytest.mark.parametrize("way", ["direct", "krylov", "sweeps alone"])
def test_ways_of_solving_agree(way, rng, monkeypatch):
    """What large models go through, on a small one."""
    case = small_models.case("restart")
    demonstrations, walks = walks_on(case.name)
    if way != "direct":
        monkeypatch.setattr("jaxhom.guarantees.all_time._is_direct", lambda choices: False)
    if way == "sweeps alone":
        monkeypatch.setattr(policy_iteration, "iterate", lambda *_: pytest.fail("nothing is left to it"))
    policy = small_models.random_policy(rng, *case.shape)
    loss = check_against_planning(case, demonstrations, walks, policy, 1e-7)
    assert loss.status == Status.SOLVED
    assert loss.contributions.sum() == pytest.approx(float(loss.bound), rel=1e-6)


def test_a_discount_near_one():
    """A ring that hardly mixes: sweeps alone do not get there."""
    case = small_models.slow_ring()
    mdp = case.mdp.replace(discount=0.99999)
    case = case._replace(mdp=mdp, discount=0.99999)
    walks = [(np.arange(20), np.ones(20, int))]
    policy = np.eye(2)[np.arange(258) % 2]
    loss = check_against_planning(case, Demonstrations.from_trajectories(walks), walks, policy, 1e-2)
    assert loss.status == Status.SOLVED
    assert loss.contributions.sum() == pytest.approx(float(loss.bound), rel=1e-6)


def test_what_is_not_solved_says_so_and_holds(monkeypatch):
    case = small_models.slow_ring()
    monkeypatch.setattr(policy_iteration, "iterate", lambda *_: None)
    walks = [(np.arange(20), np.ones(20, int))]
    policy = np.eye(2)[np.arange(258) % 2]
    loss = check_against_planning(case, Demonstrations.from_trajectories(walks), walks, policy, 1e3)
    assert loss.status == Status.STALLED


def test_many_features():
    """64 indicators of regions, in one call; each against its own planning problem."""
    grid = jaxhom.gridworld(16, num_regions=64)
    weights = jaxhom.sample_weights(jax.random.key(1), 64)
    expert = jaxhom.optimal_policy(grid, grid.mdp.features @ weights)
    demonstrations = jaxhom.sample_demonstrations(jax.random.key(0), grid, expert.policy, 5, 50)
    loss = loss_bound(grid, demonstrations, jaxhom.nearest_neighbors(grid, demonstrations), weights=weights)
    mdp, states, taken = grid.mdp, np.asarray(demonstrations.states), np.asarray(demonstrations.actions)
    allowed = np.ones((256, 4), bool)
    allowed[states] = False
    allowed[states, taken] = True
    for k in (0, 17, 63):
        plan = jaxhom.optimal_policy(mdp, np.where(allowed, np.asarray(mdp.features)[..., k], -np.inf))
        assert loss.optima[k] == pytest.approx(float(plan.value @ mdp.initial), abs=1e-8)


# --------------------------------------------------------------------------------------- the door


@functools.cache
def small():
    return problem(np.random.default_rng(3))


def test_policies_in_all_forms_and_batches():
    given = small()
    actions = np.arange(6) % 2
    one = loss_bound(given.mdp, given.demonstrations, actions)
    batch = loss_bound(given.mdp, given.demonstrations, np.stack([given.policy, np.eye(2)[actions]]))
    assert batch.bound.shape == (2,)
    assert batch.contributions.shape == (2, 6)
    jax.tree.map(lambda lane, leaf: np.testing.assert_array_equal(leaf[1], lane), one, batch)


def test_it_says_what_it_assumes():
    loss = loss_bound(small().mdp, small().demonstrations, small().policy)
    said = str(loss)
    assert f"worst feature {int(loss.worst)}" in said
    assert f"{float(loss.bound):.6g}" in said
    assert str(int(loss.contributions.argmax())) in said
    assert "assumes the true model" in said
    assert "deterministic" in said
    assert len(repr(loss).splitlines()) <= 3
    assert str(jax.tree.map(lambda leaf: leaf[None], loss)) == repr(jax.tree.map(lambda leaf: leaf[None], loss))


def test_a_reward_as_the_only_feature(rng):
    """The bound is the exact worst case, which weights on several features only bound."""
    given = problem(rng)
    weights = np.array([1.0, 2.0, 3.0])
    reward = given.mdp.features @ weights
    exact = loss_bound(given.mdp.replace(features=reward[..., None]), given.demonstrations, given.policy)
    assert exact.bound == pytest.approx(worst_loss(given, weights), abs=1e-8)
    assert exact.bound <= loss_bound(given.mdp, given.demonstrations, given.policy, weights=weights).bound + 1e-10


def test_demonstrations_of_another_model_warn():
    impossible = Demonstrations.from_trajectories([([2, 0], [0, 0])])
    mdp = small_models.case("absorbing").mdp
    with pytest.warns(jaxhom.ImpossibleStepsWarning):
        loss_bound(mdp, impossible, np.zeros(6, int))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mdp": "not a model"}, "a jaxhom.MDP is needed"),
        ({"mdp": small().mdp.replace(features=np.zeros((6, 2, 0)))}, "the model has no features"),
        ({"demonstrations": Demonstrations.from_trajectories([([6], [0])])}, "states"),
        ({"policy": np.zeros((6, 2))}, "sum of policy"),
        ({"policy": np.ones((5, 2)) / 2}, "policy must have shape"),
        ({"policy": np.ones((0, 6, 2)) / 2}, "B >= 1"),
        ({"weights": np.ones(2)}, "weights must have shape"),
        ({"weights": [1.0, -1.0, 0.0]}, r"weights\[1\] must not be negative"),
        ({"weights": [1.0, np.nan, 0.0]}, r"weights\[1\] must be finite"),
        ({"horizon": 0}, "horizon must be at least 1"),
        ({"horizon": 2.5}, "horizon must be a whole number"),
        ({"demonstrations": [([0], [0])]}, "demonstrations must be Demonstrations, got list"),
    ],
)
def test_refuses(changes, message):
    arguments = {"mdp": small().mdp, "demonstrations": small().demonstrations, "policy": small().policy} | changes
    with pytest.raises(ValueError, match=message):
        loss_bound(**arguments)


@pytest.mark.parametrize("horizon", [None, 5])
def test_features_whose_sums_overflow_are_refused(horizon):
    given = small()
    features = np.full(given.mdp.features.shape, 1e308)
    with pytest.raises(ValueError, match="too large for sums over time"):
        loss_bound(given.mdp.replace(features=features), given.demonstrations, given.policy, horizon=horizon)


def test_concrete_values_inside_a_program_are_constants():
    given = small()
    inside = jax.jit(lambda x: x + loss_bound(given.mdp, given.demonstrations, given.policy).bound)(0.0)
    assert inside == loss_bound(given.mdp, given.demonstrations, given.policy).bound
