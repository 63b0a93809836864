"""What was done at an episode's end is no evidence elsewhere, and no vote counts for an action that does not exist."""

import functools

import chex
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest

import jaxhom
from jaxhom import MDP, Demonstrations
from jaxhom.generalization.evidence import has_vote
from jaxhom.interop import from_gymnasium


def with_coordinates(method, width):
    """A method of (mdp, demonstrations) on a board of the given width."""

    def call(mdp, demonstrations):
        coordinates = np.stack(np.divmod(np.arange(mdp.num_states), width), axis=1)
        return method(mdp, demonstrations, coordinates=coordinates)

    return call


def methods(width):
    return {
        "Algorithm 1": functools.partial(jaxhom.soft_local_homomorphism, threshold=0.1),
        "as printed": functools.partial(jaxhom.soft_local_homomorphism, threshold=0.1, anchored=False),
        "hops": jaxhom.nearest_neighbors,
        "euclidean": with_coordinates(functools.partial(jaxhom.nearest_neighbors, metric="euclidean"), width),
        "regression": with_coordinates(jaxhom.occupancy_regression, width),
        "global": functools.partial(jaxhom.soft_homomorphism, max_iterations=40),
        "maximum entropy": jaxhom.uniform_elsewhere,
    }


@functools.cache
def episodes(name):
    """An environment, and walks of its expert in it that stop at the end, and that walk on."""
    options = {"map_name": "8x8"} if name == "FrozenLake-v1" else {"is_slippery": True}
    env = from_gymnasium(gymnasium.make(name, **options), discount=0.95)
    expert = jaxhom.optimal_policy(env.mdp, env.reward)
    arguments = jax.random.key(1), env.mdp, expert.policy, 2, 100
    walked = jaxhom.sample_demonstrations(*arguments)
    return env, jaxhom.sample_demonstrations(*arguments, terminal=env.terminal), walked


def assert_alike(cut, whole, goes_on):
    """The same for every state but those where episodes end, bit by bit."""
    for field in ("policy", "visited", "radius", "support"):
        np.testing.assert_array_equal(getattr(cut, field)[goes_on], getattr(whole, field)[goes_on])


@pytest.mark.parametrize("method", ["Algorithm 1", "hops", "euclidean", "regression"])
@pytest.mark.parametrize(("name", "width"), [("FrozenLake-v1", 8), ("CliffWalking-v1", 12)])
def test_stopping_at_the_end_or_walking_on_is_the_same(name, width, method):
    env, stopped, walked = episodes(name)
    assert np.all(stopped.terminated) and np.any(env.terminal[walked.states])
    cut, whole = (methods(width)[method](env.mdp, demonstrations) for demonstrations in (stopped, walked))
    assert not np.any(np.asarray(cut.visited)[env.terminal]) and np.any(np.asarray(whole.visited)[env.terminal])
    goes_on = ~np.asarray(env.terminal)
    assert_alike(cut, whole, goes_on)
    # what was done at the end is kept there, and nowhere else
    _, empirical = jaxhom.empirical_policy(env.mdp, walked)
    np.testing.assert_array_equal(whole.policy[whole.visited], empirical[whole.visited])
    if method != "Algorithm 1":  # maps take a while to compile
        for state in np.flatnonzero(goes_on & ~np.asarray(whole.visited))[:2]:
            assert str(cut.explain(state)) == str(whole.explain(state))


def corridor():
    """Three cells and a goal; action 0 goes left, 1 right."""
    return MDP.from_dense(np.eye(4)[np.array([[0, 1], [0, 2], [1, 3], [3, 3]])], discount=0.9)


@pytest.mark.parametrize("anchored", [False, True])
def test_the_global_map_does_not_lead_to_the_end_either(anchored):
    walks = [([1, 2], [1, 1])], [([1, 2, 3, 3], [1, 1, 0, 0])]
    cut, whole = (
        jaxhom.soft_homomorphism(corridor(), Demonstrations.from_trajectories(walk), anchored=anchored)
        for walk in walks
    )
    assert_alike(cut, whole, np.arange(4) < 3)
    np.testing.assert_allclose(whole.policy, [[0, 1], [0, 1], [0, 1], [1, 0]], rtol=0, atol=1e-12)
    assert cut.error_upper == whole.error_upper
    assert str(cut.explain(0)) == str(whole.explain(0))


def test_algorithm_1_on_a_lake_against_the_oracle():
    """FrozenLake 4x4, three walks that end in a hole, at the goal, and nowhere; and what is done in hole and goal."""
    mdp = from_gymnasium(gymnasium.make("FrozenLake-v1", map_name="4x4"), discount=0.9).mdp
    trajectories = [([0, 4, 8, 4, 5, 5], [0, 0, 3, 1, 2, 2]), ([13, 14, 15, 15], [1, 2, 3, 3]), ([0, 1, 2], [2, 2, 1])]
    demonstrations = Demonstrations.from_trajectories(trajectories)
    for method, oracle in (
        (
            functools.partial(jaxhom.soft_local_homomorphism, threshold=0.2),
            functools.partial(oracles.algorithm1, threshold=0.2, tolerance=1e-9),
        ),
        (jaxhom.nearest_neighbors, oracles.hops_nearest_neighbors),
    ):
        found = method(mdp, demonstrations)
        policy, radius = oracle(np.asarray(mdp.transition), trajectories)
        np.testing.assert_array_equal(found.radius, radius)
        np.testing.assert_allclose(found.policy, policy, rtol=0, atol=1e-12)
        assert np.any(radius > 0)


@pytest.mark.parametrize("method", methods(1))
def test_nothing_but_ends_is_no_demonstration(method):
    """Only what is done in the goal was shown."""
    mdp = corridor()
    found = methods(4)[method](mdp, Demonstrations.from_trajectories([([3, 3], [1, 1])]))
    np.testing.assert_array_equal(found.visited, [False, False, False, True])
    np.testing.assert_array_equal(found.policy[3], [0.0, 1.0])
    np.testing.assert_array_equal(found.support[:3], 0)
    if method != "regression":  # which goes by the occupancy, with any data or none
        np.testing.assert_array_equal(found.policy[:3], 0.5)
        np.testing.assert_array_equal(found.radius[:3], -1)
        assert "nothing was found" in found.explain(0).reason


# ------------------------------------------------------------------------ actions that do not exist


@functools.cache
def board():
    """A 4x4 board whose pieces cannot move off it, and walks on it."""
    cells = np.stack(np.divmod(np.arange(16), 4), axis=1)
    target = cells[:, None] + np.array([[-1, 0], [1, 0], [0, -1], [0, 1]])
    allowed = ((target >= 0) & (target < 4)).all(axis=-1)
    step = np.eye(16)[np.where(allowed, target @ [4, 1], 0)]
    mdp = MDP.from_dense(0.9 * step + 0.1 * np.eye(16)[:, None], discount=0.9, allowed=allowed)
    policy = np.random.default_rng(0).uniform(size=(16, 4)) * allowed
    policy /= policy.sum(axis=1, keepdims=True)
    return mdp, allowed, jaxhom.sample_demonstrations(jax.random.key(0), mdp, policy, 1, 6)


@pytest.mark.parametrize("method", methods(1))
def test_no_policy_takes_an_action_that_does_not_exist(method):
    mdp, allowed, demonstrations = board()
    found = methods(4)[method](mdp, demonstrations)
    policy = np.asarray(found.policy)
    assert 0 < np.sum(found.visited) < 10
    assert np.all(policy[~allowed] == 0)
    np.testing.assert_allclose(policy.sum(axis=1), 1.0, rtol=1e-12)
    alone = np.asarray(found.radius) == -1
    np.testing.assert_allclose(policy[alone], (allowed / allowed.sum(axis=1, keepdims=True))[alone], rtol=1e-12)
    for state in np.flatnonzero(np.asarray(found.radius) > 0)[:4]:
        explanation = found.explain(state)
        np.testing.assert_array_equal(explanation.policy, policy[state])
        if len(explanation.voters):  # the global map names the larger shares only
            mixed = explanation.weights @ explanation.voter_policies
            np.testing.assert_allclose(mixed, policy[state], rtol=0, atol=1e-2 if method == "global" else 1e-12)


@pytest.mark.parametrize("metric", ["hops", "euclidean"])
def test_who_has_no_vote_is_passed_over(metric):
    """A corridor whose left end lacks the action of its neighbour: the next one along votes."""
    cells = np.arange(4)
    corridor = np.eye(4)[np.stack([cells - 1, cells + 1, np.array([0, 3, 3, 2])], axis=1).clip(0, 3)]
    allowed = np.ones((4, 3), bool)
    allowed[0, 2] = False
    mdp = MDP.from_dense(corridor, discount=0.9, allowed=allowed)
    demonstrations = Demonstrations.from_trajectories([([1], [2]), ([2], [1]), ([2], [2])])
    options = {"coordinates": cells[:, None]} if metric == "euclidean" else {}
    found = jaxhom.nearest_neighbors(mdp, demonstrations, metric=metric, **options)
    np.testing.assert_array_equal(found.policy, [[0, 1, 0], [0, 0, 1], [0, 0.5, 0.5], [0, 0.5, 0.5]])
    np.testing.assert_array_equal(found.radius, [2, 0, 0, 1])
    explanation = found.explain(0)
    np.testing.assert_array_equal(explanation.voters, [2])
    assert explanation.reason.endswith("Votes for actions that it lacks do not count.")
    np.testing.assert_array_equal(has_vote(mdp, found.policy, np.array([0, 0, 3]), np.array([1, 2, 1])), [0, 1, 1])
    nobody = jaxhom.nearest_neighbors(mdp, Demonstrations.from_trajectories([([1], [2])]), metric=metric, **options)
    np.testing.assert_array_equal(nobody.policy[0], [0.5, 0.5, 0])
    assert nobody.radius[0] == -1 and "nothing was found" in nobody.explain(0).reason


def test_the_regression_has_no_variable_for_what_does_not_exist():
    """Its occupancy is a flow: nothing leaks through pairs that lead nowhere."""
    mdp, _, demonstrations = board()
    found = methods(4)["regression"](mdp, demonstrations)
    np.testing.assert_allclose(found.explainer.occupancy.sum(), 10.0, rtol=1e-6)
    kept = np.asarray(jaxhom.occupancy(mdp, found.policy))
    np.testing.assert_allclose(found.explainer.occupancy, kept, rtol=0, atol=1e-5)


def test_what_has_a_model_will_do_for_one():
    world = jaxhom.gridworld(4)
    demonstrations = Demonstrations.from_trajectories([([5], [1])])
    for use in (jaxhom.nearest_neighbors, jaxhom.uniform_elsewhere):
        chex.assert_trees_all_equal(use(world, demonstrations), use(world.mdp, demonstrations))
    np.testing.assert_array_equal(
        jaxhom.empirical_policy(world, demonstrations)[1][5], jnp.eye(4, dtype=world.mdp.dtype)[1]
    )
