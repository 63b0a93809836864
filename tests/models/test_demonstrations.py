"""Demonstrations: frequencies and eq. (6) against plain loops; samples against distributions."""

import pickle
import re

import chex
import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
import small_models

from jaxhom.models import sampling
from jaxhom.models.demonstrations import (
    Demonstrations,
    empirical_policy,
    monte_carlo_feature_expectations,
    sample_demonstrations,
)
from jaxhom.models.mdp import MDP

# Compiled once per shape; `UnderJitTest` runs them uncompiled too.
POLICY, EXPECTATIONS = jax.jit(empirical_policy), jax.jit(monte_carlo_feature_expectations)

RAGGED = [([0, 1, 2], [0, 2, 1]), ([4], [1]), ([1, 1, 1, 6, 0], [2, 2, 0, 1, 1])]


# ---------------------------------------------------------------------------- ragged trajectories


def test_ragged_trajectories_are_padded_and_masked():
    demonstrations = Demonstrations.from_trajectories(RAGGED)
    assert (demonstrations.num_trajectories, demonstrations.horizon) == (3, 5)
    for i, (states, actions) in enumerate(RAGGED):
        length = len(states)
        np.testing.assert_array_equal(demonstrations.mask[i], np.arange(5) < length)
        np.testing.assert_array_equal(demonstrations.states[i, :length], states)
        np.testing.assert_array_equal(demonstrations.actions[i, :length], actions)
        assert not np.any(demonstrations.states[i, length:])
        assert not np.any(demonstrations.actions[i, length:])
    chex.assert_type([demonstrations.states, demonstrations.actions], jnp.int32)
    chex.assert_type(demonstrations.mask, bool)


@pytest.mark.parametrize(
    "trajectories",
    [
        iter([((0.0, 3.0, 3.0), (1.0, 1.0, 0.0))]),
        np.array([[[0, 3, 3], [1, 1, 0]]], np.uint8),
        [(jnp.array([0, 3, 3]), np.array([1, 1, 0]))],
    ],
)
def test_any_whole_numbers_in_any_sequence_will_do(trajectories):
    expected = Demonstrations.from_trajectories([([0, 3, 3], [1, 1, 0])])
    chex.assert_trees_all_equal(Demonstrations.from_trajectories(trajectories), expected)


@pytest.mark.parametrize(
    ("trajectories", "message"),
    [
        ([], "at least one trajectory is needed, got none"),
        ([([0], [0]), ([], [])], "trajectory 1 is empty"),
        ([([0], [0]), ([0, 1, 2, 3], [0, 1])], "trajectory 1 has 4 states and 2 actions: as many are needed, or one"),
        ([([0, 1], [0, 1, 2])], "trajectory 0 has 2 states and 3 actions"),
        ([([0], [])], "trajectory 0 is empty"),
        ([([0],)], "trajectory 0 must be a pair (states, actions)"),
        ([([0], [0], [1.0])], "trajectory 0 must be a pair (states, actions)"),
        ([3], "trajectory 0 must be a pair (states, actions)"),
        ([([[0]], [0])], "trajectory 0 states must have shape [H], got (1, 1)"),
        ([(0, 0)], "trajectory 0 states must have shape [H], got ()"),
        ([([0, 1], [0, -1])], "trajectory 0 actions[1] must not be negative, got -1"),
        ([([0, 0.5], [0, 1])], "trajectory 0 states[1] must be whole, got 0.5"),
        ([([0, np.nan], [0, 1])], "trajectory 0 states[1] must be whole, got nan"),
        ([([0, 2**31], [0, 1])], "trajectory 0 states[1] must be below 2147483647, got 2147483648"),
        ([(["left"], [0])], "trajectory 0 states must hold integers, got dtype <U4"),
        (None, "trajectories must be a sequence of pairs (states, actions), got NoneType"),
        ([[(3, 1), (4, 0)]], "trajectory 0 could be (states, actions) or two steps (state, action), got [(3, 1), (4"),
        ([((3, 1), (4, 0))], "trajectory 0 could be"),
        ([[[3, 1], [4, 0]]] * 2, "trajectory 0 could be"),
        (np.array([[[3, 1], [4, 0]]]), "trajectory 0 could be"),
    ],
)
def test_from_trajectories_refuses(trajectories, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        Demonstrations.from_trajectories(trajectories)


def test_two_steps_are_what_longer_trajectories_show_them_to_be():
    demonstrations = Demonstrations.from_trajectories([[(3, 4), (1, 0)], [(0, 1, 2), (1, 1, 0)]])
    np.testing.assert_array_equal(demonstrations.states[0, :2], [3, 4])
    np.testing.assert_array_equal(demonstrations.actions[0, :2], [1, 0])


def test_one_long_trajectory_among_many_is_refused_before_it_is_padded():
    steps = np.zeros(100_000, np.int8)
    trajectories = [(steps, steps)] + [(steps[:1], steps[:1])] * 21_475
    with pytest.raises(ValueError, match=r"21476 trajectories padded to the longest, 100000 steps, .* 2\^31 - 2"):
        Demonstrations.from_trajectories(trajectories)


def test_traced_trajectories_are_refused():
    def build(states):
        return Demonstrations.from_trajectories([(states, [0, 0])])

    with pytest.raises(ValueError, match="trajectory 0 states is a traced value"):
        jax.jit(build)(jnp.array([0, 1]))


@pytest.mark.parametrize(
    ("trajectories", "message"),
    [
        (
            [([0], [0]), ([6, 7], [0, 0])],
            "states[1, 1] must lie in [0, 7) (index: trajectory, step)",
        ),
        ([([0, 1], [2, 3])], "actions[0, 1] must lie in [0, 3) (index: trajectory, step), got 3"),
    ],
)
@pytest.mark.parametrize("use", [empirical_policy, monte_carlo_feature_expectations])
def test_states_and_actions_that_the_model_lacks_are_refused(use, trajectories, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        use(small_models.case("dense").mdp, Demonstrations.from_trajectories(trajectories))


def test_fields_of_different_shapes_are_refused():
    demonstrations = Demonstrations.from_trajectories(RAGGED)
    broken = demonstrations.replace(actions=demonstrations.actions[:, 1:])
    with pytest.raises(ValueError, match=r"must have shape \(3, 5\) alike, got \(3, 4\)"):
        broken.validate(small_models.case("dense").mdp)


@pytest.mark.parametrize("use", [empirical_policy, monte_carlo_feature_expectations])
def test_no_steps_at_all_are_refused(use):
    given = Demonstrations.from_trajectories(RAGGED)
    none = given.replace(states=given.states[:, :0], actions=given.actions[:, :0], mask=given.mask[:, :0])
    with pytest.raises(ValueError, match=r"states must have shape \[..., H\] with H >= 1, got \(3, 0\)"):
        use(small_models.case("dense").mdp, none)


def test_padding_is_not_validated():
    demonstrations = Demonstrations.from_trajectories(RAGGED)
    junk = demonstrations.replace(states=jnp.where(demonstrations.mask, demonstrations.states, 99))
    junk.validate(small_models.case("dense").mdp)


def test_ends_of_trajectories():
    trajectories = [([0, 1, 5], [0, 2]), ([4, 6], [1]), ([1, 1], [2, 2])]
    demonstrations = Demonstrations.from_trajectories(trajectories, terminated=[True, False, False])
    np.testing.assert_array_equal(demonstrations.terminated, [True, False, False])
    np.testing.assert_array_equal(demonstrations.final_states, [5, 6, -1])
    np.testing.assert_array_equal(demonstrations.mask, [[True, True], [True, False], [True, True]])
    np.testing.assert_array_equal(demonstrations.states, [[0, 1], [4, 0], [1, 1]])
    chex.assert_type([demonstrations.terminated, demonstrations.final_states], [bool, jnp.int32])
    assert not np.any(Demonstrations.from_trajectories(trajectories).terminated)


@pytest.mark.parametrize(
    ("terminated", "message"),
    [([True], "terminated must have shape (2,), got (1,)"), ([0, 1], "terminated must be bool, got dtype int64")],
)
def test_flags_that_do_not_fit_are_refused(terminated, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        Demonstrations.from_trajectories([([0], [0])] * 2, terminated)


def test_they_are_a_sequence_of_trajectories():
    trajectories = [([0, 1, 5], [0, 2]), ([4], [1]), ([1, 1, 2], [2, 2])]
    demonstrations = Demonstrations.from_trajectories(trajectories, [True, False, False])
    assert len(demonstrations) == 3
    chex.assert_trees_all_equal(list(demonstrations), [(np.array(s), np.array(a)) for s, a in trajectories])
    chex.assert_trees_all_equal(demonstrations[-1], demonstrations[np.int64(2)])
    chex.assert_trees_all_equal(Demonstrations.from_trajectories(demonstrations, [True, False, False]), demonstrations)
    for index in (slice(1, 3), np.array([1, 2]), np.array([False, True, True])):
        some = demonstrations[index]
        assert len(some) == 2 and some.horizon == 2
        chex.assert_trees_all_equal(list(some), list(demonstrations)[1:])
    with pytest.raises(IndexError):
        demonstrations[3]


def test_hidden_steps_of_demonstrations_stay_where_they_are():
    demonstrations = Demonstrations.from_trajectories(RAGGED)
    hidden = demonstrations.replace(mask=demonstrations.mask.at[2, 1].set(False))
    chex.assert_trees_all_equal(Demonstrations.from_trajectories(hidden), hidden)
    ended = np.array([False, True, True])
    found = Demonstrations.from_trajectories(hidden, ended)
    chex.assert_trees_all_equal(found, hidden.replace(terminated=jnp.asarray(ended)))
    with pytest.raises(ValueError, match="terminated must have shape"):
        Demonstrations.from_trajectories(hidden, [True])


def test_they_are_a_pytree_and_can_be_pickled():
    """However they were made: without their ends, nobody is known to have terminated."""
    full = Demonstrations.from_trajectories(RAGGED)
    bare = Demonstrations(states=full.states, actions=full.actions, mask=full.mask)
    for copy in (bare, pickle.loads(pickle.dumps(full)), jax.tree.map(jnp.array, full), full.replace(mask=full.mask)):
        chex.assert_trees_all_equal(copy, full)
        assert jax.tree.structure(copy) == jax.tree.structure(full)
    lanes = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), full)
    axes = Demonstrations(states=0, actions=0, mask=0)
    for in_axes in (0, axes, jax.tree.map(lambda _: 0, full)):
        out = jax.vmap(lambda one: one.replace(terminated=~one.terminated), in_axes=(in_axes,))(lanes)
        assert out.terminated.shape == (2, 3) and np.all(out.terminated)
    inside = jax.jit(lambda states, actions, mask: Demonstrations(states=states, actions=actions, mask=mask))
    chex.assert_trees_all_equal(inside(full.states, full.actions, full.mask), full)


# ------------------------------------------------------- empirical policy, feature expectations


@pytest.mark.parametrize("trajectories", [RAGGED, [([3], [0])], [([0, 0], [0, 1])] * 2])
def test_frequencies_and_expectations_against_plain_loops(trajectories):
    case = small_models.case("dense")
    demonstrations = Demonstrations.from_trajectories(trajectories)
    visited, policy = POLICY(case.mdp, demonstrations)
    expected_visited, expected_policy = oracles.empirical_policy(*case.shape, trajectories)
    np.testing.assert_array_equal(visited, expected_visited)
    np.testing.assert_allclose(policy, expected_policy, rtol=1e-15)
    expected = oracles.monte_carlo_feature_expectations(case.features, case.discount, trajectories)
    actual = EXPECTATIONS(case.mdp, demonstrations)
    np.testing.assert_allclose(actual, expected, rtol=1e-14)


@pytest.mark.parametrize("name", ["one_state", "absorbing", "restart"])
def test_sampled_trajectories_against_plain_loops(name):
    """The only state of the first has one action: what it does after nine steps is certain."""
    case = small_models.case(name)
    policy = small_models.random_policy(np.random.default_rng(1), *case.shape)
    trajectories = oracles.sample_trajectories(np.random.default_rng(2), case.transition, case.initial, policy, 4, 9)
    demonstrations = Demonstrations.from_trajectories(trajectories)
    visited, empirical = POLICY(case.mdp, demonstrations)
    expected = oracles.empirical_policy(*case.shape, trajectories)
    chex.assert_trees_all_close((np.asarray(visited), np.asarray(empirical)), expected, rtol=1e-15)
    ends = [np.ones(1)] * 4 if name == "one_state" else None
    expected = oracles.monte_carlo_feature_expectations(case.features, case.discount, trajectories, ends)
    actual = EXPECTATIONS(case.mdp, demonstrations)
    np.testing.assert_allclose(actual, expected, rtol=1e-13)


def test_junk_on_padding_counts_for_nothing():
    case = small_models.case("dense")
    clean = Demonstrations.from_trajectories(RAGGED)
    junk = clean.replace(states=jnp.where(clean.mask, clean.states, 5))
    for use in (POLICY, EXPECTATIONS):
        chex.assert_trees_all_equal(use(case.mdp, junk), use(case.mdp, clean))


class UnderJitTest(chex.TestCase):
    """Compiled and not, the results are the same, and a discount can be traced."""

    @chex.variants(with_jit=True, without_jit=True)
    def test_frequencies_and_expectations(self):
        case = small_models.case("dense")
        demonstrations = Demonstrations.from_trajectories(RAGGED)
        visited, policy = self.variant(empirical_policy)(case.mdp, demonstrations)
        expected = oracles.empirical_policy(*case.shape, RAGGED)
        chex.assert_trees_all_close((np.asarray(visited), np.asarray(policy)), expected)
        actual = self.variant(monte_carlo_feature_expectations)(case.mdp, demonstrations)
        expected = oracles.monte_carlo_feature_expectations(case.features, case.discount, RAGGED)
        np.testing.assert_allclose(actual, expected, rtol=1e-14)


def test_gradient_of_monte_carlo_in_the_discount():
    case = small_models.case("dense")
    demonstrations = Demonstrations.from_trajectories(RAGGED)

    def total(discount):
        mdp = case.mdp.replace(discount=discount)
        return monte_carlo_feature_expectations(mdp, demonstrations).sum()

    step = 1e-6
    low, high = (
        oracles.monte_carlo_feature_expectations(case.features, case.discount + h, RAGGED).sum() for h in (-step, step)
    )
    derivative = jax.jit(jax.grad(total))(case.discount)
    np.testing.assert_allclose(derivative, (high - low) / (2 * step), rtol=1e-8)


def test_float32_models_give_float32():
    case = small_models.in_float32(small_models.case("dense"))
    demonstrations = Demonstrations.from_trajectories(RAGGED)
    _, policy = POLICY(case.mdp, demonstrations)
    expectations = EXPECTATIONS(case.mdp, demonstrations)
    assert policy.dtype == expectations.dtype == jnp.float32
    expected = oracles.monte_carlo_feature_expectations(case.features, case.discount, RAGGED)
    np.testing.assert_allclose(expectations, expected, rtol=1e-6)


def test_frequencies_do_not_stop_counting():
    """float16 counts in ones up to 2048, as float32 does up to 2^24."""
    mdp = MDP.from_dense(np.ones((1, 2, 1), np.float16), discount=0.5)
    actions = np.arange(100_000) % 4 == 0
    _, policy = POLICY(mdp, Demonstrations.from_trajectories([(np.zeros(100_000, int), actions.astype(int))]))
    assert policy.dtype == jnp.float16
    np.testing.assert_array_equal(policy, [[0.75, 0.25]])


# ---------------------------------------------------------------------------------------- sampling


def assert_frequencies(counts, probability, limit=4.5):
    """Counts of draws from `probability` [..., N]: none impossible, none `limit` sigmas off."""
    assert np.all(counts[probability == 0] == 0)
    total = counts.sum(axis=-1, keepdims=True)
    sigma = np.sqrt(total * probability * (1 - probability))
    assert np.all(np.abs(counts - total * probability) <= limit * sigma + 1e-9)


def with_zeros(rng, shape):
    """Random policy some of whose actions are never taken, the last among them."""
    policy = small_models.random_policy(rng, *shape)
    policy[::2, -1] = 0.0
    policy[1::2, 0] = 0.0
    return policy / policy.sum(axis=-1, keepdims=True)


@pytest.mark.parametrize(
    ("name", "dtype"),
    [("absorbing", np.float64), ("sparse", np.float32)],
)
def test_sampled_frequencies(name, dtype, rng):
    """First states, actions and successors, each against its distribution."""
    case = small_models.case(name)
    if dtype == np.float32:
        case = small_models.in_float32(case)
    policy = with_zeros(rng, case.shape)
    demonstrations = sample_demonstrations(jax.random.key(3), case.mdp, policy, 20_000, 4)
    states, actions = np.asarray(demonstrations.states), np.asarray(demonstrations.actions)
    assert np.all(demonstrations.mask)
    first = np.bincount(states[:, 0], minlength=case.shape[0])
    assert_frequencies(first, case.initial)
    taken = np.zeros(case.shape)
    np.add.at(taken, (states, actions), 1)
    assert_frequencies(taken, policy)
    moved = np.zeros(case.transition.shape)
    np.add.at(moved, (states[:, :-1], actions[:, :-1], states[:, 1:]), 1)
    assert_frequencies(moved, case.transition)


@pytest.mark.parametrize(
    ("cumulative", "uniform", "expected"),
    [
        ([0.0, 0.5, 1.0], 0.0, 1),  # the first has no probability
        ([0.5, 0.5, 1.0], 0.5, 2),  # nor has the second
        ([0.25, 0.75, 0.75], 0.9999999, 1),  # nor the last, where rounding left the total short
        ([0.1, 0.4, 1.0000001], 0.99999994, 2),
        ([1.0, 1.0, 1.0], 0.9999999, 0),
    ],
)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_edges_of_the_inverse_cdf(cumulative, uniform, expected, dtype):
    """An index without probability is not drawn even where the uniform number meets a boundary."""
    inverse_cdf = jax.jit(sampling._inverse_cdf)
    index = inverse_cdf(np.asarray(cumulative, dtype), dtype(uniform))
    assert index == expected


def test_sampled_expectations_approach_the_exact_ones():
    """Eq. (6) on long samples, within five standard errors of V(pi)."""
    case = small_models.case("dense")
    policy = small_models.random_policy(np.random.default_rng(4), *case.shape)
    demonstrations = sample_demonstrations(jax.random.key(5), case.mdp, policy, 1000, 100)
    # [20, M / 20, H]: on 20 groups
    groups = jax.tree.map(lambda x: x.reshape(20, -1, *x.shape[1:]), demonstrations)
    sample = jax.jit(jax.vmap(EXPECTATIONS, (None, 0)))(case.mdp, groups)
    error = np.std(sample, axis=0, ddof=1) / np.sqrt(20)
    expected = oracles.feature_expectations(*case.arrays, policy)
    assert np.all(np.abs(np.mean(sample, axis=0) - expected) <= 5 * error)


def test_the_key_decides():
    case = small_models.case("dense")
    policy = small_models.random_policy(np.random.default_rng(6), *case.shape)
    draw = [sample_demonstrations(jax.random.key(k), case.mdp, policy, 8, 6) for k in (0, 0, 1)]
    chex.assert_trees_all_equal(draw[0], draw[1])
    assert np.any(draw[0].states != draw[2].states)
    chex.assert_shape([draw[0].states, draw[0].actions, draw[0].mask], (8, 6))
    from_list = sample_demonstrations(jax.random.key(0), case.mdp, policy.tolist(), 8, 6)
    chex.assert_trees_all_equal(from_list, draw[0])


def test_sampling_under_jit_and_vmap_agrees_key_by_key():
    case = small_models.case("dense")
    policy = small_models.random_policy(np.random.default_rng(6), *case.shape)
    keys = jax.random.split(jax.random.key(0), 3)

    def draw(key):
        return sample_demonstrations(key, case.mdp, policy, 8, 6)

    lanes = jax.jit(jax.vmap(draw))(keys)
    for i, key in enumerate(keys):
        chex.assert_trees_all_equal(jax.tree.map(lambda x: x[i], lanes), draw(key))  # noqa: B023


def test_one_state_and_one_step():
    mdp = MDP.from_dense(np.ones((1, 1, 1)), discount=0.5, features=np.ones((1, 1)))
    demonstrations = sample_demonstrations(jax.random.key(0), mdp, np.ones((1, 1)), 1, 1)
    assert not np.any(demonstrations.states) and not np.any(demonstrations.actions)
    np.testing.assert_array_equal(monte_carlo_feature_expectations(mdp, demonstrations), [2.0])  # for ever


@pytest.mark.parametrize(
    ("policy_shape", "num_trajectories", "horizon", "message"),
    [
        ((7, 2), 1, 1, r"policy must have shape .*, got \(7, 2\)"),
        ((2, 7, 3), 1, 1, r"policy must have shape .*, got \(2, 7, 3\)"),
        ((7, 3), 0, 1, "num_trajectories must be at least 1, got 0"),
        ((7, 3), 1, 0, "horizon must be at least 1, got 0"),
    ],
)
def test_sampling_refuses(policy_shape, num_trajectories, horizon, message):
    mdp = small_models.case("dense").mdp
    with pytest.raises(ValueError, match=message):
        sample_demonstrations(jax.random.key(0), mdp, np.ones(policy_shape) / 3, num_trajectories, horizon)


def test_episodes_end_at_the_first_terminal_state():
    """The same walks as without ends, up to the end."""
    case = small_models.case("sparse")
    policy = small_models.random_policy(np.random.default_rng(7), *case.shape)
    terminal = np.arange(40) % 7 == 3
    mdp = case.mdp.replace(initial=np.where(terminal, 0, 1) / (~terminal).sum())
    options = jax.random.key(1), mdp, policy, 60, 6
    walked = jax.tree.map(np.asarray, sample_demonstrations(*options))
    cut = jax.tree.map(np.asarray, sample_demonstrations(*options, terminal=terminal))
    chex.assert_shape([cut.states, cut.actions, cut.mask], (60, 6))
    assert 0 < np.sum(cut.terminated) < 60
    np.testing.assert_array_equal(walked.final_states, -1)
    for lane in range(60):
        ends = np.flatnonzero(terminal[walked.states[lane]])
        length = ends[0] if len(ends) else 6
        np.testing.assert_array_equal(cut.mask[lane], np.arange(6) < length)
        for name in ("states", "actions"):
            np.testing.assert_array_equal(getattr(cut, name)[lane, :length], getattr(walked, name)[lane, :length])
            assert not np.any(getattr(cut, name)[lane, length:])
        assert cut.terminated[lane] == terminal[cut.final_states[lane]]
        if length < 6:
            assert cut.final_states[lane] == walked.states[lane, length]
    cut.validate(mdp)  # so the last step leads to the final state

    def draw(key):
        return sample_demonstrations(key, mdp, policy, 60, 6, terminal=terminal)

    keys = jnp.stack([jax.random.key(2), jax.random.key(1)])
    lanes = jax.tree.map(np.asarray, jax.jit(jax.vmap(draw))(keys))
    chex.assert_trees_all_equal(jax.tree.map(lambda leaf: leaf[1], lanes), cut)
    chex.assert_trees_all_equal(jax.tree.map(lambda leaf: leaf[0], lanes), jax.tree.map(np.asarray, draw(keys[0])))


def test_an_episode_that_starts_at_its_end_has_no_step():
    mdp = small_models.case("absorbing").mdp
    terminal = np.arange(6) == 1
    message = "terminal[1] must be False where episodes start: one that starts there has no step, got True"
    with pytest.raises(ValueError, match=re.escape(message)):
        sample_demonstrations(jax.random.key(0), mdp, np.full((6, 2), 0.5), 1, 1, terminal=terminal)
    draw = jax.jit(
        lambda terminal: sample_demonstrations(jax.random.key(0), mdp, jnp.eye(6)[:, :2], 50, 2, terminal=terminal)
    )
    found = draw(jnp.asarray(terminal))
    empty = ~np.asarray(found.mask)[:, 0]
    assert 0 < empty.sum() < 50
    np.testing.assert_array_equal(found.final_states[empty], 1)
    assert np.all(np.asarray(found.terminated)[empty])


@pytest.mark.parametrize(
    ("terminal", "message"),
    [
        (np.zeros(6, bool), "terminal must have shape (7,), got (6,)"),
        (np.zeros(7), "terminal must be bool, got dtype float64"),
    ],
)
def test_terminal_states_that_are_none_are_refused(terminal, message):
    mdp = small_models.case("dense").mdp
    with pytest.raises(ValueError, match=re.escape(message)):
        sample_demonstrations(jax.random.key(0), mdp, np.full((7, 3), 1 / 3), 1, 1, terminal=terminal)


def test_demonstrations_of_demonstrations_keep_what_is_known():
    """Ends, marks of answers; said anew, ends are what is said."""
    shown = Demonstrations.from_trajectories([([0, 1, 2], [1, 1]), ([0, 3], [0])], [True, False])
    shown = shown.with_answers([2], [1])
    again = Demonstrations.from_trajectories(shown)
    for name in ("states", "actions", "mask", "final_states", "terminated", "is_answer"):
        np.testing.assert_array_equal(getattr(again, name), getattr(shown, name))
    assert not Demonstrations.from_trajectories(shown, [False] * 3).terminated.any()


def test_some_trajectories_by_their_numbers():
    demonstrations = Demonstrations.from_trajectories(RAGGED)
    np.testing.assert_array_equal(demonstrations[[2, 0]].states, demonstrations.states[np.array([2, 0])])
    assert len(demonstrations[[]]) == 0
    with pytest.raises(TypeError, match="trajectories have numbers, got the index 'states'"):
        demonstrations["states"]


@pytest.mark.parametrize("key", [0, None, np.zeros(2)])
def test_what_is_no_key_is_refused(key):
    mdp = small_models.case("dense").mdp
    with pytest.raises(ValueError, match=r"key must be a key of jax\.random"):
        sample_demonstrations(key, mdp, np.zeros(mdp.num_states, int), 1, 2)
