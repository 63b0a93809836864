"""Where an episode terminated, eq. (6) goes on for ever: against exact expectations and plain loops."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest

import jaxhom
from jaxhom import MDP, Demonstrations, interop, monte_carlo_feature_expectations

RIGHT = [1, 1, 1]


def corridor(features=((0.0,), (0.0,), (1.0,)), **options):
    """Cells 0, 1 and the goal; action 0 goes left, 1 right; the feature counts steps in the goal."""
    transition = np.eye(3)[np.array([[0, 1], [0, 2], [2, 2]])]
    start = np.eye(3)[0]
    return MDP.from_dense(transition, discount=0.9, initial=start, features=np.asarray(features), **options)


@pytest.mark.parametrize(
    ("states", "actions", "terminated"),
    [
        ([0, 1], [1, 1], True),
        ([0, 1, 2], [1, 1], True),
        ([0, 1, 2], [1, 1], False),
        ([0, 1, 2], [1, 1, 0], True),
        ([0, 1, 2], [1, 1, 0], False),
        ([0, 1, 2, 2], [1, 1, 0, 1], False),
        ([0, 1, 2, 2], [1, 1, 0], True),
    ],
)
def test_time_in_the_goal_is_the_exact_one_however_the_end_was_recorded(states, actions, terminated):
    mdp = corridor()
    demonstrations = Demonstrations.from_trajectories([(states, actions)], [terminated])
    found = monte_carlo_feature_expectations(mdp, demonstrations)
    np.testing.assert_allclose(found, [8.1], rtol=1e-14)
    np.testing.assert_allclose(found, jaxhom.feature_expectations(mdp, np.array(RIGHT)), rtol=1e-12)


def test_an_episode_that_was_cut_off_is_not_continued():
    demonstrations = Demonstrations.from_trajectories([([0, 1], [1, 1]), ([0, 0, 0], [0, 0])])
    np.testing.assert_array_equal(monte_carlo_feature_expectations(corridor(), demonstrations), [0.0])


def test_what_is_done_in_the_goal_is_anyones_guess():
    """Features that depend on the action there: the mean over those allowed if it terminated, else nothing."""
    features = np.zeros((3, 2, 1))
    features[2] = [[3.0], [1.0]]
    ends = [([0, 1, 2], [1, 1])]
    for terminated, factor in ((True, 2.0), (False, 0.0)):
        found = monte_carlo_feature_expectations(
            corridor(features), Demonstrations.from_trajectories(ends, [terminated])
        )
        np.testing.assert_allclose(found, [8.1 * factor], rtol=1e-14)
    allowed = np.array([[True, True], [True, True], [True, False]])
    found = monte_carlo_feature_expectations(
        corridor(features, allowed=allowed), Demonstrations.from_trajectories(ends, [False])
    )
    np.testing.assert_allclose(found, [8.1 * 3.0], rtol=1e-14)


def test_what_is_done_by_a_bandit_is_a_decision():
    mdp = MDP.from_dense(np.ones((1, 2, 1)), discount=0.5, features=[[[1.0, 0.0], [0.0, 1.0]]])
    demonstrations = Demonstrations.from_trajectories([([0, 0], [1, 1])])
    np.testing.assert_array_equal(monte_carlo_feature_expectations(mdp, demonstrations), [0.0, 1.5])


def several_ends(layout):
    """Forty random states; from each, the last two, which absorb, are near. Some trajectories, and where they end."""
    rng = np.random.default_rng(3)
    next_state = rng.integers(38, size=(40, 2, 4))
    next_state[:, 0, 2:] = [38, 39]
    next_state[38:] = np.array([38, 39])[:, None, None]
    probability = rng.dirichlet(np.ones(4), size=(40, 2))
    features = rng.normal(size=(40, 2, 3))
    options = {"discount": 0.8, "initial": np.eye(40)[0], "features": features}
    mdp = MDP.from_successors(next_state, probability, **options)
    transition = np.asarray(mdp.transition)
    if layout == "dense":
        mdp = MDP.from_dense(transition, **options).replace(discount=0.8)
    walk = [0]
    for _ in range(4):
        walk.append(int(next_state[walk[-1], 1, 0]))
    into = np.where(np.arange(40) >= 38, transition[walk[2], 0], 0)
    trajectories, ends = [], []
    for states, actions, terminated, end in (
        (walk[:3], [1, 1, 0], True, into / into.sum()),  # either
        (walk[:3], [1, 1, 0], False, None),
        ([*walk[:4], 39], [1, 1, 1, 0], True, np.eye(40)[39]),
        ([*walk[:2], 38], [1, 0, 1], True, np.eye(40)[38]),  # walked on for a step
        (walk, [1, 1, 1, 1], False, None),
    ):
        trajectories.append((states, actions, terminated))
        ends.append(end)
    demonstrations = Demonstrations.from_trajectories([t[:2] for t in trajectories], [t[2] for t in trajectories])
    plain = [(states[: len(actions)], actions) for states, actions, _ in trajectories]
    return mdp, demonstrations, oracles.monte_carlo_feature_expectations(features, 0.8, plain, ends)


@pytest.mark.parametrize("layout", ["dense", "successors"])
def test_ends_that_are_not_known_are_weighted_by_their_probability(layout):
    mdp, demonstrations, expected = several_ends(layout)
    np.testing.assert_allclose(monte_carlo_feature_expectations(mdp, demonstrations), expected, rtol=1e-12)


def test_under_jit_vmap_and_grad():
    mdp, demonstrations, expected = several_ends("dense")
    lanes = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf[::-1]]), demonstrations)
    found = jax.jit(jax.vmap(monte_carlo_feature_expectations, (None, 0)))(mdp, lanes)
    np.testing.assert_allclose(found, [expected, expected], rtol=1e-12)

    def total(discount):
        return monte_carlo_feature_expectations(mdp.replace(discount=discount), demonstrations).sum()

    derivative = jax.jit(jax.value_and_grad(total))
    (_, slope), step = derivative(0.8), 1e-6
    low, high = (derivative(0.8 + h)[0] for h in (-step, step))
    np.testing.assert_allclose(slope, (high - low) / (2 * step), rtol=1e-7)


@pytest.mark.parametrize(
    ("trajectory", "message"),
    [
        (
            ([0, 1, 0], [1, 0]),
            "trajectory 1 terminated in state 0, which is not absorbing in this model: if it was cut",
        ),
        (([0, 0], [0, 0]), "trajectory 1 terminated after state 0, action 0, which lead to no absorbing state"),
    ],
)
def test_an_end_where_nothing_absorbs_is_refused(trajectory, message):
    demonstrations = Demonstrations.from_trajectories([([0, 1], [1, 1]), trajectory], [True, True])
    with pytest.raises(ValueError, match=re.escape(message)):
        monte_carlo_feature_expectations(corridor(), demonstrations)
    found = jax.jit(monte_carlo_feature_expectations)(corridor(), demonstrations)
    np.testing.assert_allclose(found, [8.1 / 2], rtol=1e-14)  # under a trace it is not continued


def test_episodes_without_a_step():
    """Nothing but a final state: as can come out of a traced `terminal`."""
    demonstrations = Demonstrations.from_trajectories([([0, 1, 2], [1, 1])] * 2, [True, True])
    mask = demonstrations.mask.at[1].set(False)
    found = monte_carlo_feature_expectations(corridor(), demonstrations.replace(mask=mask))
    np.testing.assert_allclose(found, [(8.1 + 10.0) / 2], rtol=1e-14)
    lost = demonstrations.replace(mask=mask, final_states=jnp.array([2, -1]))
    with pytest.raises(ValueError, match="trajectory 1 terminated without a step or a final state"):
        monte_carlo_feature_expectations(corridor(), lost)


def test_sampled_episodes_that_stop_at_the_goal_or_walk_on_in_it():
    mdp = corridor(((0.0, 1.0), (-1.0, 2.0), (1.0, 0.0)))
    options = jax.random.key(0), mdp, np.full((3, 2), 0.5), 16, 60
    walked = jaxhom.sample_demonstrations(*options)
    cut = jaxhom.sample_demonstrations(*options, terminal=np.array([False, False, True]))
    assert np.all(cut.terminated) and not np.any(walked.terminated)
    both = (monte_carlo_feature_expectations(mdp, demonstrations) for demonstrations in (cut, walked))
    np.testing.assert_allclose(*both, rtol=1e-12)


@pytest.mark.parametrize("name", ["timeouts", "truncations", "truncated"])
def test_an_episode_with_both_flags_was_cut_off(name):
    ends = [False, False, True]
    episode = {"observations": [0, 1, 0], "actions": [0, 0, 0], "dones": ends}
    read = interop.demonstrations_from_episodes
    assert read([episode])[0].terminated.tolist() == [True]
    assert read([episode | {name: ends}])[0].terminated.tolist() == [False]
    assert read([episode | {"infos": [{}, {}, {"TimeLimit.truncated": True}]}])[0].terminated.tolist() == [False]
    for infos in (3, {"a": 1}, [], None):
        assert read([episode | {"infos": infos}])[0].terminated.tolist() == [True]


@pytest.mark.parametrize("flag", ["no", float("nan"), 2])
def test_flags_that_are_none_are_refused(flag):
    with pytest.raises(ValueError, match="episode 0: terminal.* must be"):
        interop.demonstrations_from_episodes([{"obs": [0, 1], "acts": [0], "terminal": flag}])
