"""Explanations against set arithmetic and HiGHS: who voted, how far, how well the maps do."""

import functools
import pickle
from typing import NamedTuple

import jax
import numpy as np
import oracles
import pytest

import jaxhom
from jaxhom import MDP, Demonstrations, SimilarityTable


class World(NamedTuple):
    """A model, its tensor, and a few trajectories, raw and as demonstrations."""

    mdp: MDP
    transition: np.ndarray
    trajectories: list
    demonstrations: Demonstrations
    coordinates: np.ndarray


@functools.cache
def world(name):
    """A grid, and "strip": two rows of eight cells, the last column of which cannot leave."""
    rng = np.random.default_rng(1)
    if name == "strip":
        transition = oracles.restrict(oracles.gridworld_transition(8), list(range(16)))
        transition[[7, 15]] = np.eye(16)[[7, 15]][:, None]
        mdp, coordinates = MDP.from_dense(transition, discount=0.9), np.stack(np.divmod(np.arange(16), 8), axis=1)
    else:
        domain = jaxhom.gridworld(6)
        mdp, coordinates = domain.mdp, np.asarray(domain.coordinates)
    transition, initial = np.asarray(mdp.transition), np.asarray(mdp.initial)
    policy = rng.dirichlet(np.ones(mdp.num_actions), size=mdp.num_states)
    trajectories = oracles.sample_trajectories(rng, transition, initial, policy, 2, 3)
    return World(mdp, transition, trajectories, Demonstrations.from_trajectories(trajectories), coordinates)


_errors = {}


@functools.cache
def error_between(name, source, target, distance, anchored):
    """The optimum of LP (9) from the local model of one state to that of another; one LP for equal models."""
    models = [oracles.local_model(world(name).transition, s, distance)[1] for s in (source, target)]
    key = (*(model.tobytes() for model in models), anchored)
    if key not in _errors:
        _errors[key] = oracles.homomorphism_lp(*models, anchored)[0]
    return _errors[key]


def voters_of(name, state, visited, distance=1, threshold=0.0, anchored=True, mutual=False):
    """Algorithm 1 at one state: (t, the similar demonstrated states in s^t), or (-1, none)."""
    within, t = {state}, 0
    while True:
        grown, t = oracles.grow(world(name).transition, within), t + 1
        if grown == within:
            return -1, []
        within = grown
        ways = [(state, other) for other in sorted(within) if visited[other]]
        voters = [
            other
            for s, other in ways
            if error_between(name, s, other, distance, anchored) <= threshold + 1e-9
            and (not mutual or error_between(name, other, s, distance, anchored) <= threshold + 1e-9)
        ]
        if voters:
            return t, voters


def assert_certified(found, name, sources, targets, distance, anchored):
    """The maps are feasible, attain errors between the bounds, and so does the optimum."""
    transition = world(name).transition
    for pair, (s, other) in enumerate(zip(sources, targets, strict=True)):
        rows, source = oracles.local_model(transition, int(s), distance)
        columns, target = oracles.local_model(transition, int(other), distance)
        n, m = len(rows), len(columns)
        for states, expected in ((found.sources[pair], rows), (found.targets[pair], columns)):
            np.testing.assert_array_equal(states[: len(expected)], expected)
            assert (states[len(expected) :] == -1).all()
        f = found.maps[pair, :n, :m]
        assert found.maps[pair].sum() == pytest.approx(f.sum())
        assert f.min() >= 0
        np.testing.assert_allclose(f.sum(axis=1), 1.0, atol=1e-9)
        if anchored:
            assert f[0, 0] == 1
        lower, upper = found.lower[pair], found.upper[pair]
        assert lower <= error_between(name, int(s), int(other), distance, anchored) + 1e-9 <= upper + 2e-9
        assert lower - 1e-9 <= oracles.homomorphism_residual(source, target, f) <= upper
        assert upper - lower <= 1e-6
        assert found.status[pair] == jaxhom.Status.SOLVED


OPTIONS = {"distance": 2, "threshold": 0.4, "mutual": True}


@functools.cache
def generalized():
    """Algorithm 1 on the strip: exact and inexact votes, one way alone and both, and states that find nothing."""
    return jaxhom.soft_local_homomorphism(world("strip").mdp, world("strip").demonstrations, **OPTIONS)


def test_algorithm_1_explains_its_votes():
    here, general = world("strip"), generalized()
    visited, empirical = oracles.empirical_policy(*here.transition.shape[:2], here.trajectories)
    answers = []
    for state in np.flatnonzero(~visited).tolist():
        explanation = general.explain(state)
        radius, voters = voters_of("strip", int(state), visited, **OPTIONS)
        answers.append(radius)
        assert (explanation.state, explanation.radius) == (state, radius)
        np.testing.assert_array_equal(explanation.voters, voters)
        np.testing.assert_array_equal(explanation.policy, general.policy[state])
        assert f"State {state}: " in str(explanation)
        if radius < 0:
            assert "nothing was found, so the policy is uniform" in str(explanation)
            np.testing.assert_allclose(explanation.policy, 1.0 / here.mdp.num_actions)
            assert explanation.maps is None and explanation.lower is None and explanation.upper is None
            continue
        assert len(voters) == general.support[state]
        np.testing.assert_allclose(explanation.weights @ explanation.voter_policies, explanation.policy, atol=1e-12)
        np.testing.assert_allclose(explanation.voter_policies, empirical[voters])
        np.testing.assert_array_equal(explanation.distances, radius)
        assert_certified(explanation.forward, "strip", [state] * len(voters), voters, 2, True)
        assert_certified(explanation.backward, "strip", voters, [state] * len(voters), 2, True)
        assert f"{radius} step" in str(explanation) and f"\n  voter {voters[0]}: {state} -> " in str(explanation)
        np.testing.assert_array_equal(explanation.maps, explanation.forward.maps)
        assert (explanation.lower <= explanation.upper).all()
    assert max(answers) >= 2 and min(answers) == -1


def test_maps_of_the_program_as_printed():
    """Every state of the strip can be sent to its closed end at no error."""
    here, sources, targets = world("strip"), [0, 3, 9, 3], [7, 15, 15, 3]
    found = SimilarityTable(here.mdp, anchored=False).maps(sources, targets)
    assert_certified(found, "strip", sources, targets, 1, False)
    assert found.upper.max() <= 1e-6


def test_a_map_can_merge_states_but_not_split_them():
    """0 chooses between 2 and 3, 1 has only 4: both of them can be 4, but 4 cannot be both."""
    successors = np.array([[2, 3, 2, 3], [4] * 4, [1] * 4, [1] * 4, [0] * 4])
    mdp = MDP.from_dense(np.eye(5)[successors], discount=0.9)
    found = SimilarityTable(mdp).maps([0, 1], [1, 0])
    assert (found.sources.tolist(), found.targets.tolist()) == ([[0, 2, 3], [1, 4, -1]], [[1, 4, -1], [0, 2, 3]])
    np.testing.assert_allclose(found.maps[0], [[1, 0, 0], [0, 1, 0], [0, 1, 0]], atol=1e-5)
    assert found.upper[0] <= 1e-6
    assert 0.5 - 1e-6 <= found.lower[1] <= 0.5 <= found.upper[1] <= 0.5 + 1e-6


# -------------------------------------------------------------------------------------- the other methods


def test_demonstrated_states_speak_for_themselves():
    state = int(world("strip").trajectories[0][0][0])
    explanation = generalized().explain(state)
    assert (explanation.radius, explanation.voters.tolist(), explanation.weights.tolist()) == (0, [state], [1.0])
    np.testing.assert_array_equal(explanation.policy, generalized().policy[state])
    assert f"State {state}: demonstrated" in str(explanation)


def test_states_that_were_left_out_say_so():
    here = world("strip")
    general = jaxhom.soft_local_homomorphism(here.mdp, here.demonstrations, states=np.arange(16) != 2, **OPTIONS)
    assert "no policy was asked for here" in str(general.explain(2))


def test_steps_to_the_nearest_neighbors():
    here = world("strip")
    general = jaxhom.nearest_neighbors(here.mdp, here.demonstrations)
    visited, empirical = oracles.empirical_policy(16, 4, here.trajectories)
    for state in np.flatnonzero(~visited):
        explanation = general.explain(state)
        radius = int(general.radius[state])
        if radius < 0:
            assert "no demonstrated state is among them" in str(explanation)
            continue
        voters = [s for s in oracles.reach(here.transition, state, radius) if visited[s]]
        np.testing.assert_array_equal(explanation.voters, voters)
        np.testing.assert_array_equal(explanation.distances, radius)
        np.testing.assert_allclose(empirical[voters].mean(axis=0), explanation.policy)
        assert f"{len(voters)} demonstrated state" in str(explanation)
    assert (np.asarray(general.radius) < 0).any()


def test_euclidean_distances_to_the_nearest_neighbors():
    here = world("grid")
    general = jaxhom.nearest_neighbors(here.mdp, here.demonstrations, metric="euclidean", coordinates=here.coordinates)
    _, nearest = oracles.euclidean_nearest_neighbors(here.coordinates, 4, here.trajectories)
    for state in np.flatnonzero(~np.asarray(general.visited)):
        explanation = general.explain(state)
        away = np.linalg.norm(here.coordinates[explanation.voters] - here.coordinates[state], axis=1)
        np.testing.assert_allclose(away, nearest[state])
        np.testing.assert_allclose(explanation.distances, nearest[state])
        assert len(explanation.voters) == general.support[state]
        np.testing.assert_allclose(explanation.weights @ explanation.voter_policies, general.policy[state])
        assert f"at distance {nearest[state]:.4g}" in str(explanation)


def test_the_global_map_explains_by_its_row():
    here = world("strip")
    general = jaxhom.soft_homomorphism(here.mdp, here.demonstrations, anchored=False, tolerance=1e-2)
    for state in np.flatnonzero(~np.asarray(general.visited)):
        explanation = general.explain(state)
        assert len(explanation.voters) == general.support[state]
        assert 1.0 - 1e-3 * int(general.visited.sum()) <= explanation.weights.sum() <= 1.0 + 1e-12
        mixed = explanation.weights @ explanation.voter_policies
        np.testing.assert_allclose(mixed, general.policy[state], rtol=0, atol=1e-3 * int(general.visited.sum()))
    assert f"LP (8), as printed, one map for all states with {float(general.error_lower):.3g}" in str(explanation)


@pytest.mark.parametrize(
    ("method", "text"),
    [
        (jaxhom.uniform_elsewhere, "nothing was found, so the policy is uniform: not demonstrated"),
        (lambda mdp, demos: jaxhom.occupancy_regression(mdp, demos, world("grid").coordinates), "no state voted"),
    ],
    ids=["maximum entropy", "regression"],
)
def test_methods_without_votes(method, text):
    here = world("grid")
    general = method(here.mdp, here.demonstrations)
    state = int(np.flatnonzero(~np.asarray(general.visited))[0])
    explanation = general.explain(state)
    assert text in str(explanation)
    assert not len(explanation.voters)
    np.testing.assert_array_equal(explanation.policy, general.policy[state])


# ------------------------------------------------------------------------- what is kept, what is refused


def test_a_generalization_by_hand_needs_no_word_of_how_it_ended():
    general = generalized()
    by_hand = jaxhom.Generalization(
        policy=general.policy,
        visited=general.visited,
        radius=general.radius,
        support=general.support,
        explainer=general.explainer,
    )
    assert str(by_hand.explain(2)) == str(general.explain(2))


def test_a_generalization_is_a_pytree_of_arrays_and_can_be_pickled():
    here, general = world("strip"), generalized()
    leaves, structure = jax.tree.flatten(general)
    assert [leaf.shape for leaf in leaves] == [(16, 4), (16,), (16,), (16,), (16,), ()]
    assert structure == jax.tree.structure(jaxhom.nearest_neighbors(here.mdp, here.demonstrations))
    copy = pickle.loads(pickle.dumps(general))
    assert str(copy.explain(2)) == str(general.explain(2))
    passed = jax.jit(lambda general: general.replace(radius=general.radius + 1))(general)
    np.testing.assert_array_equal(passed.radius, general.radius + 1)
    with pytest.raises(ValueError, match="no longer knows how it was made"):
        passed.explain(2)


@pytest.mark.parametrize(
    ("state", "message"),
    [
        (36, "state must be below 36, got 36"),
        (-1, "state must not be negative, got -1"),
        (0.5, "state must be whole, got 0.5"),
        ([3], r"state must have shape \(\), one state, got \(1,\)"),
        ("a", "state must hold integers"),
        (True, "state must hold integers, got dtype bool"),
    ],
)
def test_states_that_do_not_exist_are_refused(state, message):
    here = world("grid")
    general = jaxhom.uniform_elsewhere(here.mdp, here.demonstrations)
    with pytest.raises(ValueError, match=message):
        general.explain(state)
