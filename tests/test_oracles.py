"""The oracles against each other, against brute force, and against answers known by hand."""

import itertools

import numpy as np
import oracles
import pytest


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def chain(num_states):
    """One action, state s goes to s + 1; the last state stays."""
    transition = np.zeros((num_states, 1, num_states))
    for s in range(num_states):
        transition[s, 0, min(s + 1, num_states - 1)] = 1.0
    return transition


def ring(num_states):
    """Two noisy actions, backwards and forwards, on a ring: all local models are equal."""
    transition = np.zeros((num_states, 2, num_states))
    for s, (action, step) in itertools.product(range(num_states), enumerate((-1, 1))):
        transition[s, action, (s + step) % num_states] += 0.9
        transition[s, action, (s - step) % num_states] += 0.1
    return transition


def one_step(states, actions):
    return [(np.array([s]), np.array([a])) for s, a in zip(states, actions, strict=True)]


# ------------------------------------------------------------------ occupancy, values, planning


def test_occupancy_meets_the_flow_and_agrees_with_values(rng):
    transition, discount, initial, features = model = oracles.random_mdp(rng, 7, 3, N=3)
    policy = rng.dirichlet(np.ones(3), size=7)
    x = oracles.occupancy(transition, discount, initial, policy)
    inflow = discount * np.einsum("sa,sat->t", x, transition)
    np.testing.assert_allclose(x.sum(axis=1), initial + inflow, rtol=1e-12)
    assert x.sum() == pytest.approx(1 / (1 - discount))
    np.testing.assert_allclose(oracles.policy_from_occupancy(x), policy, rtol=1e-12)
    values = [initial @ oracles.policy_value(transition, discount, policy, features[:, :, k]) for k in range(3)]
    np.testing.assert_allclose(oracles.feature_expectations(*model, policy), values, rtol=1e-12)


def test_optimal_value_is_the_best_of_all_deterministic_policies(rng):
    transition, discount, _, features = oracles.random_mdp(rng, 5, 2)
    reward = features[:, :, 0]
    value, action_value = oracles.optimal_value(transition, discount, reward)
    values = [
        oracles.policy_value(transition, discount, np.eye(2)[list(actions)], reward)
        for actions in itertools.product(range(2), repeat=5)
    ]
    np.testing.assert_allclose(value, np.max(values, axis=0), rtol=1e-12)
    np.testing.assert_allclose(action_value.max(axis=1), value, rtol=1e-12)


# ----------------------------------------------------------------------------- demonstrations


def test_empirical_policy_counts():
    trajectories = [
        (np.array([0, 1, 0]), np.array([1, 0, 1])),
        (np.array([0, 3, 0]), np.array([0, 1, 1])),
    ]
    visited, policy = oracles.empirical_policy(4, 2, trajectories)
    np.testing.assert_array_equal(visited, [True, True, False, True])
    np.testing.assert_allclose(policy, [[0.25, 0.75], [1, 0], [0.5, 0.5], [0, 1]])


def test_monte_carlo_of_a_long_deterministic_trajectory(rng):
    transition, discount, features = chain(4), 0.9, rng.uniform(size=(4, 1, 2))
    initial, policy = np.eye(4)[0], np.ones((4, 1))
    trajectories = oracles.sample_trajectories(rng, transition, initial, policy, 2, 300)
    np.testing.assert_allclose(
        oracles.monte_carlo_feature_expectations(features, discount, trajectories),
        oracles.feature_expectations(transition, discount, initial, features, policy),
        rtol=1e-12,
    )


def test_monte_carlo_begins_with_weight_one():
    features = np.array([[[3.0]], [[5.0]]])
    trajectories = [(np.array([0, 1]), np.array([0, 0])), (np.array([1]), np.array([0]))]
    expected = ((3 + 0.5 * 5) + 5) / 2
    assert oracles.monte_carlo_feature_expectations(features, 0.5, trajectories) == [expected]


# ------------------------------------------------------------------------------ local models


def test_reach_on_a_chain_goes_forwards_only():
    transition = chain(6)
    assert oracles.reach(transition, 2, 0) == [2]
    assert oracles.reach(transition, 2, 2) == [2, 3, 4]
    assert oracles.reach(transition, 4, 9) == [4, 5]


def test_local_model_redirects_what_leaves(rng):
    states, local = oracles.local_model(chain(6), 2, 2)
    assert states == [2, 3, 4]
    np.testing.assert_array_equal(local[:, 0], [[0, 1, 0], [0, 0, 1], [0, 0, 1]])
    transition = oracles.gridworld_transition(4)
    states, local = oracles.local_model(transition, 5, 1)
    assert states == [5, 1, 4, 6, 9]
    np.testing.assert_allclose(local.sum(axis=2), 1.0)
    np.testing.assert_allclose(local[0], transition[5][:, states])
    # state 1 (above the centre): down goes to the centre, all else stays
    np.testing.assert_allclose(local[1, :, 1], [0.925, 0.225, 0.925, 0.925])
    np.testing.assert_allclose(local[1, :, 0], [0.075, 0.775, 0.075, 0.075])
    transition = oracles.random_mdp(rng, 6, 2)[0]
    states, local = oracles.local_model(transition, 4, 1)
    assert states == [4, 0, 1, 2, 3, 5]
    np.testing.assert_allclose(local, transition[np.ix_(states, range(2), states)])


# ------------------------------------------------------------------------------ homomorphisms


@pytest.mark.parametrize("anchored", [True, False])
def test_homomorphism_error_is_zero_up_to_renaming(rng, anchored):
    source = oracles.random_mdp(rng, 5, 3)[0]
    order = [0, 3, 1, 4, 2]
    target = source[np.ix_(order, range(3), order)]
    error, mapping = oracles.homomorphism_lp(source, target, anchored)
    assert error == pytest.approx(0.0, abs=1e-8)
    assert oracles.homomorphism_residual(source, target, mapping) == pytest.approx(0, abs=1e-8)


@pytest.mark.parametrize("anchored", [True, False])
def test_homomorphism_error_is_that_of_its_map(rng, anchored):
    for n, m in [(2, 5), (4, 4), (5, 2)]:
        source, target = oracles.random_mdp(rng, n, 3)[0], oracles.random_mdp(rng, m, 3)[0]
        error, mapping = oracles.homomorphism_lp(source, target, anchored)
        assert mapping.shape == (n, m)
        assert np.all(mapping >= 0)
        np.testing.assert_allclose(mapping.sum(axis=1), 1.0)
        residual = oracles.homomorphism_residual(source, target, mapping)
        assert error > 1e-3
        assert residual == pytest.approx(error, abs=1e-8)
        if anchored:
            assert mapping[0, 0] == pytest.approx(1.0)
            assert error >= oracles.homomorphism_lp(source, target, False)[0] - 1e-8


def test_homomorphism_error_of_two_states_by_brute_force(rng):
    for _ in range(3):
        source, target = oracles.random_mdp(rng, 2, 2)[0], oracles.random_mdp(rng, 2, 2)[0]
        scan = np.linspace(0, 1, 101)
        rows = np.stack([scan, 1 - scan], axis=1)
        residuals = np.array(
            [[oracles.homomorphism_residual(source, target, np.stack([p, q])) for q in rows] for p in rows]
        )
        # the residual moves by at most 2 for a unit of p or q, the nearest point is 0.005 away
        free, anchored = (oracles.homomorphism_lp(source, target, flag)[0] for flag in (False, True))
        assert residuals.min() - 0.02 <= free <= residuals.min() + 1e-8
        assert residuals[-1].min() - 0.01 <= anchored <= residuals[-1].min() + 1e-8


def test_anchored_error_of_a_single_state_is_known(rng):
    # f = (1, 0, ...) is the only map: e = max_a 1 - T'(0, a, 0), all else being smaller
    target = oracles.random_mdp(rng, 4, 3)[0]
    error, _ = oracles.homomorphism_lp(np.ones((1, 3, 1)), target)
    assert error == pytest.approx(1 - target[0, :, 0].min())
    assert oracles.homomorphism_lp(target, np.ones((1, 3, 1)))[0] == pytest.approx(0, abs=1e-9)


def test_an_absorbing_state_empties_the_printed_lp_but_not_the_anchored(rng):
    source, target = oracles.random_mdp(rng, 4, 2)[0], oracles.random_mdp(rng, 4, 2)[0]
    target[3] = np.eye(4)[3]
    assert oracles.homomorphism_lp(source, target, False)[0] == pytest.approx(0, abs=1e-9)
    assert oracles.homomorphism_lp(source, target, True)[0] > 1e-2


def test_homomorphism_is_not_symmetric():
    # two copies of one state fold onto it, but not the other way round when anchored
    copies = np.zeros((2, 1, 2))
    copies[0, 0, 1] = copies[1, 0, 0] = 1.0
    single = np.ones((1, 1, 1))
    assert oracles.homomorphism_lp(copies, single)[0] == pytest.approx(0, abs=1e-9)
    assert oracles.homomorphism_lp(single, copies)[0] == pytest.approx(1.0)


def test_gridworld_has_nine_local_models():
    n = 4
    transition = oracles.gridworld_transition(n)
    models = [oracles.local_model(transition, s, 1)[1] for s in range(n * n)]
    kinds = [tuple((c > 0) + (c == n - 1) for c in divmod(s, n)) for s in range(n * n)]
    first = {kind: kinds.index(kind) for kind in kinds}
    assert len(first) == 9
    for s, kind in enumerate(kinds):
        np.testing.assert_allclose(models[s], models[first[kind]], atol=1e-15)
    for (kind, s), (other, s_other) in itertools.product(first.items(), repeat=2):
        for anchored in (True, False):
            error, _ = oracles.homomorphism_lp(models[s], models[s_other], anchored)
            assert error < 1e-8 if kind == other else error > (0.69 if anchored else 0.1)


def test_global_homomorphism_lp(rng):
    transition = oracles.random_mdp(rng, 6, 2, N=3)[0]
    error, mapping = oracles.global_homomorphism_lp(transition, np.ones(6, dtype=bool))
    assert mapping.shape == (6, 6)
    assert error == pytest.approx(0, abs=1e-8)
    visited = np.array([True, False, True, True, False, False])
    error, mapping = oracles.global_homomorphism_lp(transition, visited)
    restricted = oracles.restrict(transition, [0, 2, 3])
    np.testing.assert_allclose(restricted.sum(axis=2), 1.0)
    assert mapping.shape == (6, 3)
    residual = oracles.homomorphism_residual(transition, restricted, mapping)
    assert residual == pytest.approx(error, abs=1e-8)


# ---------------------------------------------------------------------------- generalization


@pytest.mark.parametrize("distance", [1, 2])
def test_algorithm1_is_nearest_neighbors_where_all_states_are_alike(distance):
    transition = ring(9)
    demonstrations = one_step([0, 0, 0, 4], [0, 0, 1, 1])
    policy, radius = oracles.algorithm1(transition, demonstrations, distance=distance)
    expected, expected_radius = oracles.hops_nearest_neighbors(transition, demonstrations)
    np.testing.assert_array_equal(radius, expected_radius)
    np.testing.assert_array_equal(radius, [0, 1, 2, 1, 0, 1, 2, 2, 1])
    np.testing.assert_allclose(policy, expected)
    np.testing.assert_allclose(policy[1], [2 / 3, 1 / 3])
    np.testing.assert_allclose(policy[2], [1 / 3, 2 / 3])  # both vote, with one vote each
    np.testing.assert_allclose(policy[7], [2 / 3, 1 / 3])


def test_algorithm1_finds_nothing_where_nothing_is_similar():
    transition = oracles.gridworld_transition(4)
    policy, radius = oracles.algorithm1(transition, one_step([0, 5], [3, 1]))
    expected = np.full((4, 4), -1)
    expected[0, 0] = expected[1, 1] = 0
    expected[1, 2] = expected[2, 1] = 1
    expected[2, 2] = 2
    np.testing.assert_array_equal(radius.reshape(4, 4), expected)
    np.testing.assert_allclose(policy[radius == -1], 0.25)
    np.testing.assert_allclose(policy[radius > 0], np.eye(4)[[1, 1, 1]])
    # a threshold above every error makes it nearest neighbours
    generous = oracles.algorithm1(transition, one_step([0, 5], [3, 1]), threshold=1.0)
    neighbors = oracles.hops_nearest_neighbors(transition, one_step([0, 5], [3, 1]))
    np.testing.assert_array_equal(generous[1], neighbors[1])
    np.testing.assert_allclose(generous[0], neighbors[0])


def test_algorithm1_variants_on_a_gridworld(rng):
    n = 6
    transition = oracles.gridworld_transition(n)
    policy = rng.dirichlet(np.ones(4), size=n * n)
    demonstrations = oracles.sample_trajectories(rng, transition, np.eye(36)[0], policy, 3, 15)
    anchored = oracles.algorithm1(transition, demonstrations)
    assert np.all(anchored[1] >= -1)
    assert np.any(anchored[1] > 0)
    np.testing.assert_allclose(anchored[0].sum(axis=1), 1.0)
    for options in ({"anchored": False}, {"mutual": True}):
        other = oracles.algorithm1(transition, demonstrations, **options)
        np.testing.assert_allclose(other[0], anchored[0])
        np.testing.assert_array_equal(other[1], anchored[1])


def test_mutual_similarity_is_stricter():
    # 3 comes back to itself, as 2 does; 0 and 1, which nothing comes back to, fold onto it, but it onto neither
    transition = np.zeros((4, 1, 4))
    transition[0, 0, [1, 2]] = 0.5
    transition[1:, 0, 2:] = 0.5
    demonstrations = one_step([3], [0])
    assert oracles.algorithm1(transition, demonstrations)[1].tolist() == [2, 1, 1, 0]
    assert oracles.algorithm1(transition, demonstrations, mutual=True)[1].tolist() == [-1, -1, 1, 0]


def test_what_was_done_in_an_absorbing_state_is_no_evidence():
    """Every local model folds onto it; nobody learns from it."""
    transition = np.zeros((4, 1, 4))
    transition[0, 0, [1, 3]] = transition[1, 0, [0, 3]] = 0.5
    transition[2, 0, 3] = transition[3, 0, 3] = 1.0
    np.testing.assert_array_equal(oracles.absorbing(transition), [False, False, False, True])
    for method in (oracles.algorithm1, oracles.hops_nearest_neighbors):
        assert method(transition, one_step([3], [0]))[1].tolist() == [-1, -1, -1, 0]
    coordinates = [[0, 0], [0, 1], [0, 2], [0, 3]]
    absorbs = oracles.absorbing(transition)
    policy, distance = oracles.euclidean_nearest_neighbors(coordinates, 2, one_step([0, 3], [0, 1]), absorbs)
    np.testing.assert_array_equal(policy, [[1, 0], [1, 0], [1, 0], [0, 1]])
    np.testing.assert_array_equal(distance, [0, 1, 2, 0])


def test_monte_carlo_of_an_episode_that_is_absorbed(rng):
    """Cut at the absorbing state and continued, or simulated for long."""
    transition, features = chain(4), rng.uniform(size=(4, 1, 2))
    walk = (np.array([1, 2]), np.array([0, 0]))
    np.testing.assert_allclose(
        oracles.monte_carlo_feature_expectations(features, 0.9, [walk], [np.eye(4)[3]]),
        oracles.feature_expectations(transition, 0.9, np.eye(4)[1], features, np.ones((4, 1))),
        rtol=1e-12,
    )


def test_hops_follow_the_direction_of_the_graph():
    policy, radius = oracles.hops_nearest_neighbors(chain(5), one_step([2], [0]))
    np.testing.assert_array_equal(radius, [2, 1, 0, -1, -1])
    np.testing.assert_allclose(policy, 1.0)


def test_euclidean_nearest_neighbors():
    coordinates = [[0, 0], [0, 1], [0, 2], [1, 2], [3, 3]]
    policy, distance = oracles.euclidean_nearest_neighbors(coordinates, 2, one_step([0, 2], [0, 1]))
    np.testing.assert_allclose(policy, [[1, 0], [0.5, 0.5], [0, 1], [0, 1], [0, 1]])
    np.testing.assert_allclose(distance, [0, 1, 0, 1, np.sqrt(10)])


def test_occupancy_regression(rng):
    n = 4
    transition, discount, initial = oracles.gridworld_transition(n), 0.9, np.eye(n * n)[0]
    coordinates = np.stack(np.divmod(np.arange(n * n), n), axis=1)
    demonstrations = one_step([0, 1, 5], [3, 1, 1])
    visited, empirical = oracles.empirical_policy(n * n, 4, demonstrations)
    x, policy, objective = oracles.occupancy_regression(transition, discount, initial, coordinates, demonstrations)
    np.testing.assert_allclose(oracles.occupancy(transition, discount, initial, policy), x, atol=1e-8)
    np.testing.assert_allclose(policy[visited], empirical[visited])
    p, q = coordinates.T
    basis = np.stack([np.ones(n * n), p, q, p**2, q**2, p * q], axis=1)

    def least_squares_distance(x):
        residual = x.sum(axis=1) - basis @ np.linalg.lstsq(basis, x.sum(axis=1))[0]
        return np.linalg.norm(residual)

    # |r|_2 <= |r|_1 <= sqrt(S) |r|_2, and no policy that copies the expert does better
    assert least_squares_distance(x) <= objective + 1e-8
    for _ in range(20):
        other = np.where(visited[:, None], empirical, rng.dirichlet(np.ones(4), size=n * n))
        occupancy = oracles.occupancy(transition, discount, initial, other)
        assert objective <= np.sqrt(n * n) * least_squares_distance(occupancy) + 1e-8
    # with every state demonstrated only one occupancy is left
    full = one_step(range(n * n), policy.argmax(axis=1))
    fixed, _, _ = oracles.occupancy_regression(transition, discount, initial, coordinates, full)
    only = oracles.occupancy(transition, discount, initial, np.eye(4)[policy.argmax(axis=1)])
    np.testing.assert_allclose(fixed, only, atol=1e-8)


# --------------------------------------------------------------------------------------- LPAL


@pytest.mark.parametrize("seed", range(5))
def test_lpal_margin_is_attained_and_certified(seed):
    rng = np.random.default_rng(seed)
    model = transition, discount, initial, features = oracles.random_mdp(rng, 10, 3, N=3, K=4)
    expectations = rng.uniform(0, 10, size=4)
    best, x, weights = oracles.lpal(*model, expectations)
    assert oracles.margin(*model, expectations, oracles.policy_from_occupancy(x)) == pytest.approx(best, abs=1e-8)
    assert weights.sum() == pytest.approx(1)
    assert np.all(weights >= -1e-9)
    value, _ = oracles.optimal_value(transition, discount, features @ weights)
    assert initial @ value - weights @ expectations == pytest.approx(best, abs=1e-8)


def test_lpal_is_zero_where_features_are_a_partition(rng):
    n = 4
    transition, initial = oracles.gridworld_transition(n), np.eye(n * n)[0]
    features = np.repeat(np.eye(n)[np.arange(n * n) // n][:, None], 4, axis=1)
    policy = rng.dirichlet(np.ones(4), size=n * n)
    expectations = oracles.feature_expectations(transition, 0.95, initial, features, policy)
    assert oracles.margin(transition, 0.95, initial, features, expectations, policy) == 0
    best, _, _ = oracles.lpal(transition, 0.95, initial, features, expectations)
    assert best == pytest.approx(0, abs=1e-8)


# --------------------------------------------------------------------------------- evaluation


def test_evaluation_of_a_chain_stops_at_its_end():
    transition, policy, initial = chain(4), np.ones((4, 1)), np.array([0.5, 0, 0.5, 0])
    reward = np.array([[1.0], [2.0], [10.0], [100.0]])
    terminal = np.array([False, False, False, True])
    event = {"leaves the start": np.array([[1.0], [0], [0], [0]])}
    result = oracles.finite_horizon_evaluation(transition, initial, policy, reward, 9, terminal, event)
    # half the trials take 3 steps (1 + 2 + 10), half take 1 (10)
    assert result == pytest.approx({"steps": 2.0, "reward_per_step": 11.5 / 2.0, "leaves the start": 0.5 / 2.0})
    result = oracles.finite_horizon_evaluation(transition, initial, policy, reward, 2, terminal)
    assert result == pytest.approx({"steps": 1.5, "reward_per_step": 6.5 / 1.5})
    result = oracles.finite_horizon_evaluation(transition, initial, policy, reward, 2)
    assert result == pytest.approx({"steps": 2.0, "reward_per_step": 56.5 / 2.0})


def test_evaluation_agrees_with_sampling(rng):
    transition, _, initial, features = oracles.random_mdp(rng, 5, 2, N=3)
    policy, reward = rng.dirichlet(np.ones(2), size=5), features[:, :, 0]
    result = oracles.finite_horizon_evaluation(transition, initial, policy, reward, 6)
    samples = [
        reward[states, actions].mean()
        for states, actions in oracles.sample_trajectories(rng, transition, initial, policy, 2000, 6)
    ]
    standard_error = np.std(samples) / np.sqrt(len(samples))
    assert abs(np.mean(samples) - result["reward_per_step"]) < 4 * standard_error


# --------------------------------------------------------------------------------- guarantees


def test_agreeing_policies_of_two_states():
    """State 0 is fixed: it stays half the time. State 1 may go back or stay, which pays 1 a step."""
    transition = np.array([[[1.0, 0.0], [0.0, 1.0]], [[1.0, 0.0], [0.0, 1.0]]])
    features, initial = np.array([[[0.0], [0.0]], [[0.0], [1.0]]]), np.array([1.0, 0.0])
    policy, agreed = np.full((2, 2), 0.5), np.array([True, False])
    policies = oracles.agreeing_policies(policy, agreed)
    np.testing.assert_array_equal(policies, [[[0.5, 0.5], [1.0, 0.0]], [[0.5, 0.5], [0.0, 1.0]]])
    best, attained = oracles.best_agreeing(transition, 0.5, initial, features, policy, agreed)
    # V(1) = 2, V(0) = 0.25 V(0) + 0.25 * 2
    assert best == pytest.approx([2 / 3])
    np.testing.assert_array_equal(attained[0], policies[1])
    # the first step ends in state 1 with probability 1/2, and the second pays
    found = oracles.best_agreeing_steps(transition, 0.5, initial, features, policy, agreed, 2)
    assert found == pytest.approx([0.25])
    assert oracles.steps_of_policies(transition, 0.5, initial, features[..., 0], policies[[0, 1]]) == 0.25


def test_losses_by_states_add_up(rng):
    transition, discount, initial, features = oracles.random_mdp(rng, 5, 2)
    better, policy = rng.dirichlet(np.ones(2), size=(2, 5))
    worth = oracles.expectations_of_policies(transition, discount, initial, features, np.array([better, policy]))
    for k in range(3):
        parts = oracles.loss_by_states(transition, discount, initial, features[..., k], better, policy)
        assert parts.sum() == pytest.approx(worth[0, k] - worth[1, k])
        expected = oracles.feature_expectations(transition, discount, initial, features, policy)[k]
        assert worth[1, k] == pytest.approx(expected)


# ------------------------------------------------------------------------------- small models


def test_random_mdp_is_a_model(rng):
    for successors in (None, 1, 3):
        transition, _, initial, features = oracles.random_mdp(rng, 6, 2, N=successors, K=4)
        np.testing.assert_allclose(transition.sum(axis=2), 1.0)
        np.testing.assert_array_equal((transition > 0).sum(axis=2), successors or 6)
        assert initial.sum() == pytest.approx(1.0)
        assert features.shape == (6, 2, 4)


def test_gridworld_moves():
    transition = oracles.gridworld_transition(3)
    np.testing.assert_allclose(transition.sum(axis=2), 1.0)
    up, down, left, right = range(4)
    for action, neighbor in ((up, 1), (down, 7), (left, 3), (right, 5)):
        expected = np.zeros(9)
        expected[[1, 7, 3, 5]] = 0.075
        expected[neighbor] += 0.7
        np.testing.assert_allclose(transition[4, action], expected)
    np.testing.assert_allclose(transition[0, up, [0, 1, 3]], [0.85, 0.075, 0.075])
