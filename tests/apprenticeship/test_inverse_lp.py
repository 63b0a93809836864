"""Ng and Russell's linear programs: against the same written out densely from their paper, solved by HiGHS."""

import numpy as np
import oracles
import pytest

import jaxhom
from jaxhom import MDP, Demonstrations, Status, gridworld, inverse_lp
from jaxhom.solvers.sum_of_minima import SumOfMinima


def random_arrays(seed, num_features=3):
    """A model whose features do not depend on the action, as in the paper; [S, K]."""
    transition, discount, initial, features = oracles.random_mdp(np.random.default_rng(seed), 6, 3, K=num_features)
    return transition, discount, initial, features[:, 0]


def best_actions(transition, discount, reward):
    reward = np.broadcast_to(reward[:, None], transition.shape[:2])
    return oracles.optimal_value(transition, discount, reward)[1].argmax(axis=1)


def assert_explains(learned, mdp, reward):
    """The expert's policy and the greedy one are worth the same, which is the most; ties are no rare thing."""
    transition, discount = (np.asarray(leaf, np.float64) for leaf in (mdp.transition, mdp.discount))
    transition = transition / transition.sum(axis=2, keepdims=True)
    best = oracles.optimal_value(transition, discount, reward)[0]
    for policy in (learned.policy, learned.greedy_policy):
        value = oracles.policy_value(transition, discount, np.asarray(policy, np.float64), reward)
        digits = 1e-7 if mdp.dtype == np.float64 else 1e-4
        np.testing.assert_allclose(value, best, rtol=0, atol=digits * (1 + np.abs(best).max()))


def losses(mdp, policy, reward):
    """V(s) - Q(s, a) of a policy."""
    transition, discount = (np.asarray(leaf, np.float64) for leaf in (mdp.transition, mdp.discount))
    value = oracles.policy_value(transition, discount, policy, reward)
    return value[:, None] - (reward + discount * transition @ value)


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("l1", [0.0, 0.3, 2.0, 1e3])
@pytest.mark.parametrize("max_weight", [1.0, 0.01])
@pytest.mark.parametrize("is_by_state", [False, True])
def test_a_policy_against_the_program_of_the_paper(seed, l1, max_weight, is_by_state):
    transition, discount, initial, features = random_arrays(seed)
    actions = best_actions(transition, discount, features @ [0.2, 1.0, -0.5])
    mdp = MDP.from_dense(transition, discount=discount, initial=initial, features=None if is_by_state else features)
    rewards = np.eye(6) if is_by_state else features
    expected, _ = oracles.inverse_lp_from_policy(transition, discount, actions, rewards, l1, max_weight)
    learned = inverse_lp(mdp, actions, l1=l1, max_weight=max_weight)
    np.testing.assert_allclose([learned.objective, learned.bound], expected, rtol=0, atol=1e-7)
    assert learned.objective <= learned.bound and learned.status == Status.SOLVED
    assert learned.weights.shape == (6 if is_by_state else 3,)
    assert np.abs(learned.weights).max() <= max_weight
    reward = np.broadcast_to((rewards @ np.asarray(learned.weights))[:, None], (6, 3))
    loss = losses(mdp, np.eye(3)[actions], reward)
    assert loss.min() >= -1e-7
    others = np.where(np.eye(3)[actions] > 0, np.inf, loss).min(axis=1)
    total = others.sum() - l1 * np.abs(np.asarray(learned.weights)).sum()
    np.testing.assert_allclose(learned.objective, total, rtol=0, atol=1e-8)
    np.testing.assert_array_equal(learned.policy, np.eye(3)[actions])
    if l1 == 1e3:
        assert not learned.weights.any() and learned.objective == 0
    assert_explains(learned, mdp, reward)


def test_expectations_are_those_of_the_policy():
    transition, discount, initial, features = random_arrays(0)
    policy = np.eye(3)[best_actions(transition, discount, features[:, 0])]
    occupancy = oracles.occupancy(transition, discount, initial, policy)
    for given, expected in ((features, features.T @ occupancy.sum(axis=1)), (None, occupancy.sum(axis=1))):
        mdp = MDP.from_dense(transition, discount=discount, initial=initial, features=given)
        np.testing.assert_allclose(inverse_lp(mdp, policy).expectations, expected)


def test_three_states_in_closed_form():
    """A corridor whose last state absorbs: to go on costs nothing, to wait in 0 and 1 costs gamma (V' - V).

    With R = (-1, -1, 1) and a discount of one half, V = (-1, 0, 2). Waiting once then costs V - R - V / 2, 1/2 in state
    0 and 1 in state 1; in state 2 nothing can be lost. No rewards within 1 lose more: 3/2.
    """
    transition = np.eye(3)[[[0, 1], [1, 2], [2, 2]]]
    mdp = MDP.from_dense(transition, discount=0.5)
    learned = inverse_lp(mdp, [1, 1, 1])
    reward = np.array([[-1.0, -1.0, 1.0]]).T + np.zeros((3, 2))
    np.testing.assert_allclose(losses(mdp, np.eye(2)[[1, 1, 1]], reward)[:, 0], [0.5, 1.0, 0.0])
    expected, _ = oracles.inverse_lp_from_policy(transition, 0.5, np.array([1, 1, 1]), np.eye(3), 0.0, 1.0)
    np.testing.assert_allclose(learned.objective, expected, rtol=0, atol=1e-9)
    assert learned.objective >= 1.5 - 1e-9 and learned.weights[2] == 1 and learned.weights[1] == -1


@pytest.mark.parametrize("seed", [0, 1])
def test_random_policies_tie_what_they_do(seed):
    """All that is done with positive probability is worth the same; among four actions, two in state 2."""
    rng = np.random.default_rng(seed)
    transition, discount, initial, features = oracles.random_mdp(rng, 5, 4, K=6)
    mdp = MDP.from_dense(transition, discount=discount, initial=initial, features=features)
    policy = np.eye(4)[rng.integers(4, size=5)]
    policy[2] = [0.3, 0.7, 0.0, 0.0]
    learned = inverse_lp(mdp, policy)
    loss = losses(mdp, policy, features @ np.asarray(learned.weights))
    assert loss.min() >= -1e-7 and learned.status == Status.SOLVED
    np.testing.assert_allclose(loss[2, :2], 0, rtol=0, atol=1e-7)
    others = np.where(policy > 0, np.inf, loss).min(axis=1)
    np.testing.assert_allclose([learned.objective, learned.bound], others.sum(), rtol=0, atol=1e-7)


def test_the_uniform_policy_has_no_alternatives():
    mdp = gridworld(3, num_regions=9, discount=0.9).mdp
    learned = inverse_lp(mdp, np.full((9, 4), 0.25))
    assert learned.objective == 0 and learned.bound < 1e-9 and learned.status == Status.SOLVED


def test_missing_actions_are_no_alternatives():
    """With one action left in every state nothing is lost; with one more pair, its loss alone."""
    transition, discount, initial, features = random_arrays(3)
    actions = best_actions(transition, discount, features[:, 1])
    allowed = np.eye(3, dtype=bool)[actions]
    mdp = MDP.from_dense(transition, discount=discount, initial=initial, features=features, allowed=allowed)
    assert inverse_lp(mdp, actions).objective == 0
    allowed[2] = True
    mdp = MDP.from_dense(transition, discount=discount, initial=initial, features=features, allowed=allowed)
    learned = inverse_lp(mdp, actions)
    assert not np.asarray(learned.greedy_policy)[~allowed].any()
    full = MDP.from_dense(transition, discount=discount, initial=initial, features=features)
    reward = np.broadcast_to((features @ np.asarray(learned.weights))[:, None], (6, 3))
    loss = losses(full, np.eye(3)[actions], reward)[2]
    np.testing.assert_allclose(learned.objective, np.delete(loss, actions[2]).min(), rtol=0, atol=1e-8)


def test_nonnegative_weights():
    transition, discount, initial, features = random_arrays(1)
    actions = best_actions(transition, discount, features @ [1.0, 0.2, 0.0])
    mdp = MDP.from_dense(transition, discount=discount, initial=initial, features=features)
    learned = inverse_lp(mdp, actions, nonnegative=True)
    assert learned.weights.min() >= 0 and learned.status == Status.SOLVED
    assert 0 < learned.objective <= inverse_lp(mdp, actions).objective + 1e-9


@pytest.mark.parametrize("discount", [0.9, 0.99999])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_types_and_long_horizons(dtype, discount):
    transition, _, initial, features = random_arrays(2)
    actions = best_actions(transition, discount, features @ [0.2, 1.0, -0.5])
    mdp = MDP.from_dense(transition.astype(dtype), discount=discount, initial=initial, features=features.astype(dtype))
    learned = inverse_lp(mdp, actions)
    assert learned.weights.dtype == learned.objective.dtype == learned.policy.dtype == dtype
    assert learned.status == Status.SOLVED
    transition, discount = np.asarray(mdp.transition, np.float64), float(mdp.discount)
    transition = transition / transition.sum(axis=2, keepdims=True)
    expected, _ = oracles.inverse_lp_from_policy(transition, discount, actions, features.astype(dtype), 0.0, 1.0)
    np.testing.assert_allclose(learned.objective, expected, rtol=1e-8 if dtype == np.float64 else 1e-4)
    assert_explains(learned, mdp, np.asarray(mdp.features, np.float64) @ np.asarray(learned.weights, np.float64))


def test_the_expert_of_a_gridworld():
    mdp = gridworld(5, num_regions=25, discount=0.9).mdp
    weights = np.random.default_rng(0).uniform(size=25) ** 4
    expert = jaxhom.optimal_policy(mdp, mdp.features @ weights)
    learned = inverse_lp(mdp, expert)
    assert learned.status == Status.SOLVED
    assert_explains(learned, mdp, np.asarray(mdp.features @ learned.weights))
    by_state = inverse_lp(mdp.replace(features=np.zeros((25, 0))), expert)  # every cell is a region
    np.testing.assert_allclose(by_state.objective, learned.objective, rtol=0, atol=1e-6)


def test_ties_up_to_rounding_leave_the_rewards_that_there_are():
    """On the racetrack only one ratio of the two rewards explains the expert: constraints met exactly leave none."""
    mdp = jaxhom.racetrack("a").mdp
    expert = jaxhom.optimal_policy(mdp, np.asarray(mdp.features) @ np.array([5.0, 200.0]))
    learned = inverse_lp(mdp, expert)
    assert learned.status == Status.SOLVED and learned.objective > 100
    np.testing.assert_allclose(learned.weights[0] / learned.weights[1], 5 / 200, rtol=0.02)


# ---------------------------------------------------------------------------------------- demonstrations


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_demonstrations_against_the_program_of_the_paper(seed):
    """The weights are best for the policies met, and no policy is better for them than one that was met, or Vhat."""
    rng = np.random.default_rng(seed)
    transition, discount, initial, features = oracles.random_mdp(rng, 6, 3, K=4)
    mdp = MDP.from_dense(transition, discount=discount, initial=initial, features=features)
    action_value = oracles.optimal_value(transition, discount, features @ [0.2, 1.0, -0.5, 0.3])[1]
    walks = oracles.sample_trajectories(rng, transition, initial, np.eye(3)[action_value.argmax(1)], 5, 60)
    learned = inverse_lp(mdp, Demonstrations.from_trajectories(walks))
    assert learned.status == Status.SOLVED
    np.testing.assert_array_equal(learned.policy, learned.greedy_policy)
    weights = np.asarray(learned.weights)
    reached = oracles.feature_expectations(transition, discount, initial, features, np.asarray(learned.policy))
    np.testing.assert_allclose(learned.expectations, reached, rtol=0, atol=1e-9)
    best = initial @ oracles.optimal_value(transition, discount, features @ weights)[0]
    np.testing.assert_allclose(weights @ reached, best, rtol=0, atol=1e-8)
    assert np.abs(weights).max() <= 1
    np.testing.assert_allclose(learned.objective, learned.bound, rtol=0, atol=1e-6)


@pytest.mark.parametrize("seed", [0, 1])
def test_the_first_round_of_demonstrations(seed):
    """One program, against the uniform policy alone."""
    rng = np.random.default_rng(seed)
    transition, discount, initial, features = oracles.random_mdp(rng, 6, 3, K=4)
    mdp = MDP.from_dense(transition, discount=discount, initial=initial, features=features)
    walks = oracles.sample_trajectories(rng, transition, initial, np.full((6, 3), 1 / 3), 3, 20)
    expert = oracles.monte_carlo_feature_expectations(features, discount, walks)
    met = oracles.feature_expectations(transition, discount, initial, features, np.full((6, 3), 1 / 3))[None]
    learned = inverse_lp(mdp, Demonstrations.from_trajectories(walks), max_iterations=1, max_weight=2.0)
    expected = oracles.inverse_lp_from_expectations(expert, met, 2.0)
    np.testing.assert_allclose([learned.objective, learned.bound], expected, rtol=0, atol=1e-7)
    np.testing.assert_allclose(expected, 2 * np.abs(expert - met).sum(), rtol=0, atol=1e-7)
    assert learned.iterations == 1


def test_several_policies_against_the_program_of_the_paper(rng):
    """Terms of both signs, so that the penalty of 2 for violations counts."""
    met = rng.normal(size=(7, 4))
    expert = met.mean(axis=0) + 0.3 * rng.normal(size=4)
    rows = np.concatenate([expert - met, 2 * (expert - met)])
    program = SumOfMinima(rows, np.tile(np.arange(7), 2), np.zeros((0, 4)), 0.0, 0.5, False, False)
    weights, bound = program.solve()
    expected = oracles.inverse_lp_from_expectations(expert, met, 0.5)
    np.testing.assert_allclose([program.value(weights), bound], expected, rtol=0, atol=1e-8)
    assert (rows @ weights).min() < 0


def test_a_program_that_fails_says_so(monkeypatch):
    """Weights of 0 keep to the constraints; the bound holds, and the status is honest."""
    from jaxhom.solvers import sum_of_minima

    class Nothing:
        x = None

    monkeypatch.setattr(sum_of_minima, "_highs", lambda *arguments: Nothing())
    transition, discount, initial, features = random_arrays(0)
    mdp = MDP.from_dense(transition, discount=discount, initial=initial, features=features)
    actions = best_actions(transition, discount, features @ [0.2, 1.0, -0.5])
    learned = inverse_lp(mdp, actions)
    expected, _ = oracles.inverse_lp_from_policy(transition, discount, actions, features, 0.0, 1.0)
    assert learned.status == Status.STALLED and learned.objective == 0 and learned.bound >= expected


# -------------------------------------------------------------------------------------------- rejections


def small_model():
    transition, discount, initial, features = random_arrays(0)
    return MDP.from_dense(transition, discount=discount, initial=initial, features=features)


WALK = Demonstrations.from_trajectories([([0, 1], [1, 2])])


@pytest.mark.parametrize(
    ("expert", "options", "message"),
    [
        ([0] * 5, {}, r"expert must have shape \(6, 3\), got \(5,\)"),
        ([0, 0, 0, 7, 0, 0], {}, r"expert\[3\] must be below 3, got 7"),
        (np.full((6, 3), 0.5), {}, r"sum of expert\[0\] must be 1"),
        (np.full((2, 6, 3), 1 / 3), {}, r"expert must have shape \(6, 3\), got \(2, 6, 3\)"),
        ("expert", {}, "expert"),
        (Demonstrations.from_trajectories([([0, 9], [0, 0])]), {}, r"states\[0, 1\]"),
        ([0] * 6, {"l1": -1.0}, "l1 must be finite and not negative, got -1.0"),
        ([0] * 6, {"l1": "much"}, "l1 must be a number"),
        ([0] * 6, {"max_weight": 0.0}, "max_weight must be finite and positive, got 0.0"),
        ([0] * 6, {"max_weight": np.inf}, "max_weight must be finite and positive, got inf"),
        ([0] * 6, {"nonnegative": 2}, "nonnegative must be True or False, got 2"),
        (WALK, {"max_iterations": 0}, "max_iterations must be at least 1, got 0"),
    ],
)
def test_what_is_refused(expert, options, message):
    with pytest.raises(ValueError, match=message):
        inverse_lp(small_model(), expert, **options)


def test_actions_that_are_not_allowed_and_models_that_do_not_do(monkeypatch):
    transition, discount, *_ = random_arrays(0)
    allowed = np.ones((6, 3), bool)
    allowed[4, 0] = False
    with pytest.raises(ValueError, match=r"expert\[4, 0\] is an action that is not allowed there"):
        inverse_lp(MDP.from_dense(transition, discount=discount, allowed=allowed), [0] * 6)
    with pytest.raises(ValueError, match="the model has no features"):
        inverse_lp(MDP.from_dense(transition, discount=discount), WALK)
    monkeypatch.setattr("jaxhom.apprenticeship.inverse_lp._MOST_NUMBERS", 10)
    with pytest.raises(ValueError, match="6 x 3 x 3 numbers"):
        inverse_lp(small_model(), [0] * 6)


def test_slack_alone_makes_no_reward():
    """No reward of three regions explains always going up: what the slack would allow is not taken for one."""
    grid = jaxhom.gridworld(3, num_regions=9, discount=0.9).mdp
    mdp = grid.replace(features=np.asarray(grid.features)[..., [2, 5, 8]])
    learned = jaxhom.inverse_lp(mdp, np.zeros(9, int))
    assert (learned.weights == 0).all() and learned.objective == 0
