"""Answers about single states: counted where the expert's actions are, left out where time is; every consumer."""

import functools
import pickle

import chex
import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
import small_models

from jaxhom import (
    Demonstrations,
    choose_generalization,
    disjoint_union,
    empirical_policy,
    gridworld,
    monte_carlo_feature_expectations,
    nearest_neighbors,
    occupancy_regression,
    optimal_policy,
    sample_demonstrations,
    soft_local_homomorphism,
    uniform_elsewhere,
)
from jaxhom.interop import load_demonstrations, save_demonstrations
from jaxhom.models.mdp import MDP

WALKS = [([0, 1, 2], [0, 2, 1]), ([1, 1, 1, 6, 0], [2, 2, 0, 1, 1])]
STATES, ACTIONS = [4, 1, 4], [1, 0, 2]
AS_WALKS = [*WALKS, *(([s], [a]) for s, a in zip(STATES, ACTIONS, strict=True))]


@functools.cache
def answered():
    return Demonstrations.from_trajectories(WALKS).with_answers(STATES, ACTIONS)


def test_answers_are_trajectories_of_one_step_that_are_marked():
    shown = answered()
    assert (len(shown), shown.horizon) == (5, 5)
    assert shown.is_answer.tolist() == [False, False, True, True, True]
    for found, expected in zip(shown, AS_WALKS, strict=True):
        np.testing.assert_array_equal(found[0], expected[0])
        np.testing.assert_array_equal(found[1], expected[1])
    assert not shown.terminated.any() and (shown.final_states == -1).all()
    chex.assert_type([shown.states, shown.actions, shown.final_states], jnp.int32)
    only = shown[shown.is_answer]
    assert (only.states[:, 0].tolist(), only.actions[:, 0].tolist()) == (STATES, ACTIONS)
    chex.assert_trees_all_equal(shown[~shown.is_answer], Demonstrations.from_trajectories(WALKS))


def test_rounds_of_answers_add_up_and_none_change_nothing():
    shown = Demonstrations.from_trajectories(WALKS)
    rounds = shown.with_answers(STATES[:1], ACTIONS[:1]).with_answers(STATES[1:], ACTIONS[1:])
    chex.assert_trees_all_equal(rounds, answered())
    chex.assert_trees_all_equal(shown.with_answers([], []), shown)


def test_they_count_in_the_policy_and_not_in_the_mean():
    case = small_models.case("dense")
    visited, policy = empirical_policy(case.mdp, answered())
    expected_visited, expected = oracles.empirical_policy(*case.shape, AS_WALKS)
    np.testing.assert_array_equal(visited, expected_visited)
    np.testing.assert_allclose(policy, expected, rtol=1e-15)
    plain = oracles.monte_carlo_feature_expectations(case.features, case.discount, WALKS)
    for mean in (monte_carlo_feature_expectations, jax.jit(monte_carlo_feature_expectations)):
        np.testing.assert_allclose(mean(case.mdp, answered()), plain, rtol=1e-12)
    with pytest.raises(ValueError, match="no trajectories but answers"):
        monte_carlo_feature_expectations(case.mdp, answered()[2:])


def test_an_answer_in_an_absorbing_state_is_not_absorbed():
    """A trajectory of one step that ended there would go on for ever in the mean."""
    ring = MDP.from_successors([[[1]], [[1]]], [[[1.0]]] * 2, discount=0.5, features=[[1.0], [4.0]])
    walk = Demonstrations.from_trajectories([([0, 1], [0])])
    found = monte_carlo_feature_expectations(ring, walk.with_answers([1], [0]))
    np.testing.assert_allclose(found, monte_carlo_feature_expectations(ring, walk))


def test_inside_programs():
    """Traced answers and traced demonstrations; one lane of answers each."""
    case, shown = small_models.case("dense"), Demonstrations.from_trajectories(WALKS)
    states, actions = jnp.array([STATES, [0, 2, 3]]), jnp.array([ACTIONS, [1, 1, 1]])
    chex.assert_trees_all_equal(jax.jit(Demonstrations.with_answers)(shown, states[0], actions[0]), answered())
    policies = jax.vmap(lambda s, a: empirical_policy(case.mdp, shown.with_answers(s, a))[1])(states, actions)
    for lane in range(2):
        plain = empirical_policy(case.mdp, shown.with_answers(states[lane], actions[lane]))[1]
        np.testing.assert_allclose(policies[lane], plain)
    skipped = jax.jit(Demonstrations.with_answers)(shown, jnp.array([-1, 4]), jnp.array([2, 1]))
    for found, expected in zip(
        empirical_policy(case.mdp, skipped), empirical_policy(case.mdp, shown.with_answers([4], [1])), strict=True
    ):
        np.testing.assert_array_equal(found, expected)


def test_pickles_files_and_parts(tmp_path):
    shown = answered()
    chex.assert_trees_all_equal(pickle.loads(pickle.dumps(shown)), shown)
    chex.assert_trees_all_equal(jax.tree.map(jnp.array, shown), shown)
    save_demonstrations(tmp_path / "shown.npz", shown)
    chex.assert_trees_all_equal(load_demonstrations(tmp_path / "shown.npz"), shown)
    mdp = small_models.case("dense").mdp
    placed = disjoint_union([mdp, mdp]).place(1, shown)
    np.testing.assert_array_equal(placed.is_answer, shown.is_answer)
    assert placed.states[2, 0] == STATES[0] + mdp.num_states


def test_a_file_that_marks_a_longer_trajectory_is_refused(tmp_path):
    steps = np.zeros((2, 3), int)
    for marks, message in (([False, True], r"is_answer\[1\] marks"), ([False], "is_answer"), ([0, 1], "must be bool")):
        np.savez(tmp_path / "wrong.npz", states=steps, actions=steps, is_answer=marks)
        with pytest.raises(ValueError, match=message):
            load_demonstrations(tmp_path / "wrong.npz")


REFUSED = {
    "shapes": (([1, 2], [0]), r"actions.*\(2,\)"),
    "no sequence": ((1, 0), "states"),
    "negative": (([0, -1], [0, 0]), r"states\[1\] must not be negative"),
    "not whole": (([0, 1], [0.5, 0]), r"actions\[0\] must be whole"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_malformed_answers_are_refused(case):
    (states, actions), message = REFUSED[case]
    with pytest.raises(ValueError, match=message):
        Demonstrations.from_trajectories(WALKS).with_answers(states, actions)


def test_validate_names_what_the_model_lacks():
    mdp, shown = small_models.case("dense").mdp, Demonstrations.from_trajectories(WALKS)
    with pytest.raises(ValueError, match=r"states\[2, 0\] must lie in \[0, 7\)"):
        shown.with_answers([7], [0]).validate(mdp)
    with pytest.raises(ValueError, match=r"actions\[2, 0\] must lie in \[0, 3\)"):
        shown.with_answers([6], [3]).validate(mdp)
    with pytest.raises(ValueError, match="is_answer"):
        shown.replace(is_answer=jnp.zeros(3, bool)).validate(mdp)


def test_they_are_never_left_out_and_always_known():
    """Scores against fits one trajectory at a time, of which answers are none."""
    grid = gridworld(6)
    goal = np.zeros((36, 4))
    goal[20] = 1.0
    plan = optimal_policy(grid, goal)
    walks = sample_demonstrations(jax.random.key(1), grid, plan, 3, 7)
    free = np.setdiff1d(np.arange(36), np.asarray(walks.states))[:4]
    asked = np.append(free, walks.states[0, 2])  # one of a state that a trajectory visits too
    shown = walks.with_answers(asked, np.argmax(plan.policy, axis=1)[asked])
    candidates = {"plain": {}, "k-NN": nearest_neighbors, "uniform": uniform_elsewhere}
    scores = choose_generalization(grid, shown, candidates, mixing=0.1).scores
    one_by_one = {
        "plain": lambda mdp, d: soft_local_homomorphism(mdp, d),
        "k-NN": lambda mdp, d: nearest_neighbors(mdp, d),
        "uniform": lambda mdp, d: uniform_elsewhere(mdp, d),
    }
    again = choose_generalization(grid, shown, one_by_one, mixing=0.1).scores
    for name, function in one_by_one.items():
        total = 0.0
        for left_out in range(3):
            general = function(grid.mdp, shown[np.arange(len(shown)) != left_out])
            states, actions = walks[left_out]
            share = np.where(general.visited[states], 0.05, 0.1)
            total += np.log((1 - share) * general.policy[states, actions] + share / 4).sum()
        np.testing.assert_allclose([scores[name], again[name]], total / 21, atol=1e-3)
    with pytest.raises(ValueError, match="at least two trajectories"):
        choose_generalization(grid, walks[:1].with_answers(free, free % 4), candidates)


def test_every_method_follows_them():
    grid = gridworld(4)
    shown = Demonstrations.from_trajectories([([0, 1, 2], [3, 3, 1])]).with_answers([9, 9, 9], [0, 0, 1])
    for function in (uniform_elsewhere, nearest_neighbors, soft_local_homomorphism, occupancy_regression):
        more = (grid.coordinates,) if function is occupancy_regression else ()
        general = function(grid, shown, *more)
        assert general.visited[9]
        np.testing.assert_allclose(general.policy[9], [2 / 3, 1 / 3, 0, 0], atol=1e-12)


def test_an_answer_with_an_end_says_nothing_of_time():
    """As files may hold them: the state after it is known, or that its episode ended there."""
    mdp = gridworld(3, num_regions=9).mdp
    walk = Demonstrations.from_trajectories([([0, 1, 2], [0, 2, 1])])
    plain = walk.with_answers([4], [1])
    ended = plain.replace(final_states=jnp.array([-1, 4]), terminated=jnp.array([False, True]))
    expected = monte_carlo_feature_expectations(mdp, walk)
    for shown in (plain, ended):
        np.testing.assert_allclose(monte_carlo_feature_expectations(mdp, shown), expected)
