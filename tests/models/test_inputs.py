"""What users pass beside a model is brought to one form at every door, or refused with the first index."""

import jax
import numpy as np
import pytest

import jaxhom
from jaxhom import MDP
from jaxhom.models.inputs import check_coordinates, check_labels, check_policy
from jaxhom.models.mdp import absorbing_states, uniform_policy

# Two states, three actions; action 2 exists in state 1 alone, where it stays.
ALLOWED = np.array([[True, True, False], [True, True, True]])
TRANSITION = np.zeros((2, 3, 2))
TRANSITION[0, 0] = TRANSITION[1, 0] = [1, 0]
TRANSITION[0, 1] = TRANSITION[1, 1] = TRANSITION[1, 2] = [0, 1]
JUNK = TRANSITION.copy()
JUNK[0, 2] = [-3.0, np.nan]


def model(layout="dense", **options):
    options = {"discount": 0.9, "allowed": ALLOWED, **options}
    if layout == "dense":
        return MDP.from_dense(JUNK, **options)
    # A hundred states that lead on to the next, so that lists of successors are kept; the same gap in state 0.
    next_state = np.minimum(np.arange(100)[:, None, None] + np.array([1, 2, 3])[:, None], 99)
    next_state[0, 2] = -7
    allowed = np.ones((100, 3), bool)
    allowed[0, 2] = False
    return MDP.from_successors(next_state, np.ones((100, 3, 1)), **{**options, "allowed": allowed})


@pytest.mark.parametrize("layout", ["dense", "successors"])
def test_rows_of_actions_that_are_not_allowed_are_nothing(layout):
    mdp = model(layout)
    assert mdp.restricts_actions and mdp.is_dense == (layout == "dense")
    assert not np.asarray(mdp.allowed)[0, 2] and np.asarray(mdp.allowed).sum() == mdp.allowed.size - 1
    assert (np.asarray(mdp.probability)[0, 2] == 0).all()
    np.testing.assert_allclose(np.asarray(uniform_policy(mdp))[0], [0.5, 0.5, 0])


def test_features_of_such_pairs_are_not_looked_at():
    features = np.ones((2, 3, 1))
    features[0, 2] = np.nan
    assert np.asarray(model(features=features).features)[0, 2, 0] == 0


def test_a_state_without_any_action_is_refused():
    with pytest.raises(ValueError, match=r"allowed\[1\] allows no action"):
        model(allowed=np.array([[True] * 3, [False] * 3]))


def test_actions_can_be_taken_away_and_not_be_given():
    mdp = MDP.from_dense(TRANSITION + np.eye(2)[:, None] * ~ALLOWED[..., None], discount=0.9)
    fewer = mdp.replace(allowed=ALLOWED)
    np.testing.assert_array_equal(fewer.probability, model().probability)
    with pytest.raises(ValueError, match=r"allowed\[0, 2\] is a pair without transitions"):
        fewer.replace(allowed=np.ones((2, 3), bool))


def test_absorbing_states():
    assert np.asarray(absorbing_states(model())).tolist() == [False, False]
    assert np.asarray(absorbing_states(model().replace(allowed=ALLOWED & [False, True, True]))).tolist() == [
        False,
        True,
    ]
    assert np.asarray(absorbing_states(model("successors"))).tolist() == [False] * 99 + [True]


DOORS = {
    "occupancy": jaxhom.occupancy,
    "feature_expectations": jaxhom.feature_expectations,
    "policy_value": lambda mdp, policy: jaxhom.policy_value(mdp, policy, np.ones((2, 3))),
    "evaluate_exactly": lambda mdp, policy: jaxhom.evaluate_exactly(mdp, policy, np.ones((2, 3)), 3),
    "evaluate_by_sampling": lambda mdp, policy: jaxhom.evaluate_by_sampling(
        jax.random.key(0), mdp, policy, np.ones((2, 3)), 3, num_trials=2
    ),
    "agreement": lambda mdp, policy: jaxhom.agreement(mdp, policy, policy),
    "sample_demonstrations": lambda mdp, policy: jaxhom.sample_demonstrations(jax.random.key(0), mdp, policy, 1, 2),
    "lpal": lambda mdp, policy: jaxhom.lpal(mdp, [1.0], initial_policy=policy),
}


@pytest.mark.parametrize("door", DOORS)
@pytest.mark.parametrize(
    ("policy", "message"),
    [
        ([[2.0, -1.0, 0.0], [1.0, 0, 0]], r"olicy\[0, 1\] must not be negative"),
        ([[0.2, 0.3, 0.0], [1.0, 0, 0]], r"olicy\[0\] must be 1, got 0.5"),
        ([[1.0, 0, 0], [np.nan, 0, 0]], r"olicy\[1, 0\] must be finite"),
        ([[0.5, 0, 0.5], [1.0, 0, 0]], r"olicy\[0, 2\] is an action that is not allowed there"),
        ([0, 3], r"olicy\[1\] must be below 3"),
        ([2, 0], r"olicy\[0, 2\] is an action that is not allowed there"),
        (np.ones((3, 2)) / 2, r"olicy must have shape \(2, 3\)"),
    ],
)
def test_every_door_refuses_what_is_no_policy(door, policy, message):
    with pytest.raises(ValueError, match=message):
        DOORS[door](model(features=np.ones((2, 1))), np.asarray(policy))


def test_a_policy_may_have_other_forms():
    mdp = model()
    given = [[0, 1, 0], [1, 0, 0]]
    for policy in (
        np.array([1, 0]),
        np.array(given),
        np.array(given, np.float32),
        jaxhom.optimal_policy(mdp, [1.0, 0]),
    ):
        assert check_policy(mdp, policy).dtype == mdp.dtype
    np.testing.assert_array_equal(check_policy(mdp, np.array([1, 0])), given)
    thirds = np.array([[0.333333, 0.666666, 0], [0.1, 0.2, 0.7]])
    np.testing.assert_allclose(np.asarray(check_policy(mdp, thirds)).sum(axis=1), 1, rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"initial": np.ones(2)}, "sum of initial must be 1, got 2"),
        ({"discount": -1.0}, "discount must lie strictly between 0 and 1, got -1"),
        ({"features": np.ones((3, 1))}, r"features must have shape"),
        ({"features": np.full((2, 1), np.nan)}, r"features\[0, 0\] must be finite"),
        ({"probability": TRANSITION[:1]}, r"probability must have shape \(2, 3, 2\)"),
        ({"probability": TRANSITION * 2}, r"sum of probability\[0, 0\] must be 1, got 2"),
        ({"next_state": np.zeros((2, 3, 2), int)}, "next_state cannot be replaced"),
    ],
)
def test_replace_checks_like_the_constructors(changes, message):
    with pytest.raises(ValueError, match=message):
        model().replace(**changes)


def test_replace_takes_features_of_states():
    np.testing.assert_array_equal(model().replace(features=[[1.0], [2.0]]).features[1], [[2.0]] * 3)


def test_replace_refuses_successors_that_were_not_there():
    next_state = np.asarray(model("successors").next_state) + np.array([0, 1]) - 1
    half = np.full((100, 3, 2), 0.5)
    half[5, 1] = [0.0, 1.0]
    mdp = MDP.from_successors(next_state.clip(0), half, discount=0.9)
    slot = int(np.flatnonzero(np.asarray(mdp.probability)[5, 1] == 0)[0])
    probability = np.array(mdp.probability)
    probability[5, 1] = 0.5
    with pytest.raises(ValueError, match=rf"probability\[5, 1, {slot}\] is a successor that the model did not have"):
        mdp.replace(probability=probability)
    probability[:] = np.arange(2) == 0
    probability[5, 1] = np.asarray(mdp.probability)[5, 1]
    mdp.replace(probability=probability)  # one successor fewer is fine


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_rows_that_miss_one_in_the_last_digits_are_brought_to_one(dtype):
    """Seven times 0.142857: what a table with six decimals has."""
    ring = np.zeros((7, 1, 7), dtype)
    ring[:] = 0.142857
    mdp = MDP.from_dense(ring, discount=0.9999, initial=np.full(7, 0.142857))
    np.testing.assert_allclose(
        float(jaxhom.occupancy(mdp, np.ones((7, 1))).sum()), 1e4, rtol=1e-7 if dtype == np.float64 else 2e-3
    )
    with pytest.raises(ValueError, match=r"sum of transition\[0, 0\] must be 1, got 0\.99\d* \(what is within"):
        MDP.from_dense(ring * dtype(0.9998), discount=0.9)


def test_where_a_model_is_meant_what_has_one_will_do():
    world = jaxhom.gridworld(4)
    plan = jaxhom.optimal_policy(world, np.arange(16.0))
    np.testing.assert_array_equal(jaxhom.occupancy(world, plan), jaxhom.occupancy(world.mdp, plan.policy))
    with pytest.raises(ValueError, match=r"a jaxhom.MDP is needed, or what has one as .mdp, got dict"):
        jaxhom.occupancy({}, plan)


@pytest.mark.parametrize(
    ("coordinates", "message"),
    [
        ([0.0, 1.0], r"coordinates must have shape \(2, D\), got \(2,\)"),
        ([[0.0]], r"coordinates must have shape \(2, D\), got \(1, 1\)"),
        ([[0.0], [np.nan]], r"coordinates\[1, 0\] must be finite"),
        ([[0.0], [0.0, 1.0]], "not a rectangular array"),
    ],
)
def test_coordinates_that_do_not_fit_are_refused(coordinates, message):
    mdp = MDP.from_dense(np.eye(2)[:, None], discount=0.9)
    with pytest.raises(ValueError, match=message):
        check_coordinates(mdp, coordinates)
    assert check_coordinates(mdp, [[1], [2]]).dtype == np.float64


@pytest.mark.parametrize(
    ("labels", "weight", "message"),
    [
        (np.zeros(2), 1.0, r"tags must have shape \(2, 3, L\) or \(2, L\), got \(2,\)"),
        (np.zeros((3, 1)), 1.0, r"tags must have shape"),
        (np.zeros((2, 2, 1)), 1.0, r"tags must have shape"),
        ([[0.0], [np.nan]], 1.0, r"tags\[1, 0\] must be finite, got nan"),
        ([[[0.0], [np.inf], [0.0]]] * 2, 1.0, r"tags\[0, 1, 0\] must be finite, got inf"),
        ([["a"], ["b"]], 1.0, "tags must hold real numbers"),
        ([[0.0], [1.0]], -1.0, "label_weight must not be negative, got -1"),
        ([[0.0], [1.0]], np.nan, "label_weight must be finite"),
        ([[0.0], [1.0]], [1.0], r"label_weight must have shape \(\), got \(1,\)"),
        ([[0.0], [1e308]], 10.0, r"label_weight \* tags\[1, 0\] must be finite, got inf"),
    ],
)
def test_labels_that_do_not_fit_are_refused(labels, weight, message):
    with pytest.raises(ValueError, match=message):
        check_labels(model(), labels, weight, "tags")


def test_labels_of_states_count_for_every_action_and_are_weighted():
    labels = check_labels(model(), [[1, 2], [3, 4]], 0.5)
    assert labels.dtype == model().dtype and labels.shape == (2, 3, 2)
    np.testing.assert_array_equal(labels, np.broadcast_to([[[0.5, 1.0]], [[1.5, 2.0]]], (2, 3, 2)))
    again = jax.jit(lambda labels, weight: check_labels(model(), labels, weight))(np.array([[1, 2], [3, 4]]), 0.5)
    np.testing.assert_array_equal(again, labels)


def test_labels_where_an_action_is_not_allowed_count_unless_they_are_not_finite():
    given = np.arange(12.0).reshape(2, 3, 2)
    given[0, 2, 0] = np.nan
    expected = np.where(np.isnan(given), 0, given)
    np.testing.assert_array_equal(check_labels(model(), given), expected)
    np.testing.assert_array_equal(jax.jit(lambda labels: check_labels(model(), labels))(given), expected)


def test_rewards_of_texts_are_refused_by_name():
    mdp = jaxhom.MDP.from_dense(np.eye(2)[:, None], discount=0.9)
    for reward in (np.full((2, 1), "1"), np.full((2, 1), "1", object)):
        with pytest.raises(ValueError, match="reward must hold real numbers"):
            jaxhom.optimal_policy(mdp, reward)
