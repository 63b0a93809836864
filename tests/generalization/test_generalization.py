"""Algorithm 1 and the other ways to extend a policy, state by state against set arithmetic and HiGHS."""

import functools
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest

from jaxhom import (
    MDP,
    Demonstrations,
    SimilarityTable,
    Status,
    gridworld,
    local_similarity,
    maximum_entropy,
    nearest_neighbors,
    programs,
    racetrack,
    soft_homomorphism,
    soft_local_homomorphism,
    uniform_elsewhere,
)
from jaxhom.similarity import class_pairs

TRACK = ["S..F", "S..F"]


class World(NamedTuple):
    """A model, its tensor, and trajectories of a random policy, raw and as demonstrations."""

    mdp: MDP
    transition: np.ndarray
    trajectories: list
    demonstrations: Demonstrations


@functools.cache
def world(name):
    rng = np.random.default_rng(1)
    if name == "grid":
        mdp, number, horizon = gridworld(8).mdp, 2, 6
    elif name == "track":
        mdp, number, horizon = racetrack(TRACK).mdp, 2, 5
    else:  # "strip": two rows of eight cells, at most eight of them within two steps
        strip = oracles.restrict(oracles.gridworld_transition(8), list(range(16)))
        mdp, number, horizon = MDP.from_dense(strip, discount=0.9), 1, 3
    transition, initial = np.asarray(mdp.transition), np.asarray(mdp.initial)
    policy = rng.dirichlet(np.ones(mdp.num_actions), size=mdp.num_states)
    trajectories = oracles.sample_trajectories(rng, transition, initial, policy, number, horizon)
    return World(mdp, transition, trajectories, Demonstrations.from_trajectories(trajectories))


_errors = {}


@pytest.fixture(autouse=True)
def _remember_errors(monkeypatch):
    """One LP for equal local models in all tests of this file."""
    solve = oracles.homomorphism_lp

    def remembered(source, target, anchored=True, **more):
        if any(more.values()):
            return solve(source, target, anchored, **more)
        key = (source.shape, source.tobytes(), target.shape, target.tobytes(), anchored)
        if key not in _errors:
            _errors[key] = solve(source, target, anchored)
        return _errors[key]

    monkeypatch.setattr(oracles, "homomorphism_lp", remembered)


def assert_extends(result, world, policy, radius):
    """The given policy and radii; the expert's own frequencies and radius 0 where it was seen."""
    num_states, num_actions = policy.shape
    chex.assert_shape(result.policy, (num_states, num_actions))
    chex.assert_shape([result.visited, result.radius, result.support], (num_states,))
    chex.assert_type([result.visited, result.radius, result.support], [bool, jnp.int32, jnp.int32])
    visited, empirical = oracles.empirical_policy(num_states, num_actions, world.trajectories)
    np.testing.assert_array_equal(result.visited, visited)
    np.testing.assert_array_equal(result.radius, radius)
    np.testing.assert_allclose(result.policy, policy, rtol=0, atol=1e-12)
    np.testing.assert_allclose(result.policy[visited], empirical[visited], rtol=0, atol=1e-15)
    np.testing.assert_array_equal(radius == 0, visited)
    np.testing.assert_array_equal(result.support[visited], 1)
    np.testing.assert_array_equal(result.support == 0, radius == -1)


# ------------------------------------------------------------------------------------- Algorithm 1

CASES = [
    ("grid", {}),
    ("grid", {"anchored": False}),
    ("grid", {"mutual": True}),
    ("grid", {"threshold": 0.3}),
    ("grid", {"threshold": 0.3, "mutual": True, "anchored": False}),
    ("track", {}),
    ("track", {"anchored": False}),
    ("track", {"mutual": True}),
    ("track", {"threshold": 0.3}),
    ("strip", {"distance": 2}),
    ("strip", {"distance": 2, "threshold": 0.3, "mutual": True}),
]


def case_name(case):
    return case if isinstance(case, str) else "-".join(f"{k}={v}" for k, v in case.items())


@pytest.mark.parametrize(("name", "options"), CASES, ids=case_name)
def test_algorithm_1(name, options):
    here, tolerance = world(name), 1e-4
    result = soft_local_homomorphism(here.mdp, here.demonstrations, tolerance=tolerance, **options)
    policy, radius = oracles.algorithm1(here.transition, here.trajectories, tolerance=1e-9, **options)
    assert_extends(result, here, policy, radius)
    assert radius.max() >= 2
    expected = expected_support(here, radius, **options)
    np.testing.assert_array_equal(result.support, expected)
    # no error lies in the band in which either answer would be right
    band = [e for e, _ in _errors.values() if 1e-9 < e - options.get("threshold", 0.0) <= tolerance]
    assert not band


def expected_support(here, radius, distance=1, threshold=0.0, anchored=True, mutual=False):
    """How many demonstrated states within the radius are similar."""
    models = functools.cache(lambda s: oracles.local_model(here.transition, s, distance)[1])

    def error(s, other):
        return oracles.homomorphism_lp(models(s), models(other), anchored)[0]

    visited = {int(s) for states, _ in here.trajectories for s in states}
    support = np.where(radius == 0, 1, 0)
    for s in np.flatnonzero(radius > 0).tolist():
        for other in visited.intersection(oracles.reach(here.transition, s, radius[s])):
            similar = error(s, other) <= threshold + 1e-9
            similar = similar and (not mutual or error(other, s) <= threshold + 1e-9)
            support[s] += similar
    return support


def test_anchored_and_mutual_relations_refuse_more():
    """On a track, as printed: every local model absorbs, so that the nearest demonstrated states vote."""
    here = world("track")
    printed = soft_local_homomorphism(here.mdp, here.demonstrations, anchored=False)
    hops = nearest_neighbors(here.mdp, here.demonstrations)
    chex.assert_trees_all_close(printed, hops, rtol=0, atol=1e-12)
    anchored = soft_local_homomorphism(here.mdp, here.demonstrations)
    mutual = soft_local_homomorphism(here.mdp, here.demonstrations, mutual=True)
    found = [(np.asarray(result.radius) >= 0).sum() for result in (hops, anchored, mutual)]
    assert found[0] > found[1] > found[2]


def test_float32_gives_the_same_policy():
    here = world("grid")
    narrow = gridworld(8, dtype=np.float32).mdp
    result = soft_local_homomorphism(narrow, here.demonstrations, tolerance=1e-3)
    assert result.policy.dtype == jnp.float32
    policy, radius = oracles.algorithm1(here.transition, here.trajectories, tolerance=1e-9)
    np.testing.assert_array_equal(result.radius, radius)
    np.testing.assert_allclose(result.policy, policy, rtol=0, atol=1e-6)


def test_one_table_of_decisions_serves_many_demonstrations():
    here = world("grid")
    shared = SimilarityTable(here.mdp)
    first = soft_local_homomorphism(here.mdp, here.demonstrations, threshold=0.3, table=shared)
    solved, met = shared.num_solved, len(shared.known()[0])
    assert met > 0
    with pytest.warns(DeprecationWarning, match="similarity is now called table"):
        again = soft_local_homomorphism(here.mdp, here.demonstrations, threshold=0.3, similarity=shared)
    assert shared.num_solved == solved and len(shared.known()[0]) == met
    with pytest.warns(DeprecationWarning), pytest.raises(ValueError, match="give one of them"):
        soft_local_homomorphism(here.mdp, here.demonstrations, table=shared, similarity=shared)
    alone = soft_local_homomorphism(here.mdp, here.demonstrations, threshold=0.3)
    chex.assert_trees_all_equal(first, again, alone)
    stricter = soft_local_homomorphism(here.mdp, here.demonstrations, table=shared)
    chex.assert_trees_all_equal(stricter, soft_local_homomorphism(here.mdp, here.demonstrations))
    with pytest.raises(ValueError, match="table was made with distance=1 and anchored=True, not with distance=2"):
        soft_local_homomorphism(here.mdp, here.demonstrations, distance=2, table=shared)


def test_the_former_name_of_uniform_elsewhere_warns():
    here = world("grid")
    with pytest.warns(DeprecationWarning, match="maximum_entropy is now called uniform_elsewhere"):
        former = maximum_entropy(here.mdp, here.demonstrations)
    chex.assert_trees_all_equal(former, uniform_elsewhere(here.mdp, here.demonstrations))


def test_what_could_not_be_decided_is_said(monkeypatch):
    """A threshold beside an error, and few iterations: pairs stay open, and the result and its text say so."""
    here = world("grid")
    representatives = np.array([0, 1, 7, 8, 9, 15, 56, 57, 63])
    pairs = np.repeat(representatives, 9), np.tile(representatives, 9)
    errors = local_similarity(here.mdp, *pairs, tolerance=1e-7).lower
    beside = float(np.median(errors[errors > 0.1])) - 1e-6
    monkeypatch.setattr(programs, "pays", lambda seconds: True)  # all by programs, whose iterations are limited
    monkeypatch.setattr(class_pairs, "_MAX_PRODUCTS", 0.0)
    monkeypatch.setattr(class_pairs, "_MIN_ITERATIONS", 1)
    result = soft_local_homomorphism(here.mdp, here.demonstrations, threshold=beside, tolerance=1e-9)
    undecided, visited = np.asarray(result.undecided), np.asarray(result.visited)
    assert undecided.sum() > 0 and not undecided[visited].any()
    assert Status(int(result.status)) == Status.ITERATION_LIMIT
    text = str(result.explain(int(np.argmax(undecided))))
    assert "could not be decided, which counts as different" in text
    decided = soft_local_homomorphism(here.mdp, here.demonstrations)
    assert not np.asarray(decided.undecided).any() and int(decided.status) == Status.SOLVED


def test_only_the_states_that_ask_are_answered():
    here = world("grid")
    everyone = soft_local_homomorphism(here.mdp, here.demonstrations)
    asking = np.arange(64) % 3 == 0
    result = soft_local_homomorphism(here.mdp, here.demonstrations, states=asking)
    chosen = asking | np.asarray(everyone.visited)
    np.testing.assert_array_equal(result.policy[chosen], everyone.policy[chosen])
    np.testing.assert_array_equal(result.radius[chosen], everyone.radius[chosen])
    np.testing.assert_array_equal(result.policy[~chosen], 0.25)
    np.testing.assert_array_equal(result.radius[~chosen], -1)
    with pytest.raises(ValueError, match=r"states must have shape \(64,\), got \(3,\)"):
        soft_local_homomorphism(here.mdp, here.demonstrations, states=[True] * 3)


# ----------------------------------------------------------------------------------- the baselines


@pytest.mark.parametrize("name", ["grid", "track", "strip"])
def test_hops(name):
    here = world(name)
    result = nearest_neighbors(here.mdp, here.demonstrations)
    policy, radius = oracles.hops_nearest_neighbors(here.transition, here.trajectories)
    assert_extends(result, here, policy, radius)
    visited = np.flatnonzero(result.visited)
    for s in np.flatnonzero(radius > 0):
        voters = np.intersect1d(oracles.reach(here.transition, s, radius[s]), visited)
        assert result.support[s] == len(voters)


@pytest.mark.parametrize("scale", [1.0, 0.1, 1e5])
@pytest.mark.parametrize("name", ["grid", "track"])
def test_euclidean(name, scale):
    """On the track the 25 speeds of a cell are no distance apart. Ties are found at any scale."""
    here = world(name)
    domain = gridworld(8) if name == "grid" else racetrack(TRACK)
    coordinates = scale * (np.asarray(domain.coordinates) + [3.0, -7.0])
    result = nearest_neighbors(here.mdp, here.demonstrations, metric="euclidean", coordinates=coordinates)
    num_actions = here.mdp.num_actions
    policy, nearest = oracles.euclidean_nearest_neighbors(coordinates, num_actions, here.trajectories)
    visited = np.asarray(result.visited)
    radius = np.where(visited, 0, np.maximum(np.ceil(nearest - 1e-9 * scale), 1))
    assert_extends(result, here, policy, radius)
    distance = np.linalg.norm(coordinates[:, None] - coordinates[visited], axis=-1)
    tied = np.sum(distance <= nearest[:, None] * (1 + 1e-9), axis=1)
    np.testing.assert_array_equal(result.support, np.where(visited, 1, tied))


@pytest.mark.parametrize(
    ("dtype", "spacing", "offset"), [(np.float32, 1e3, 5e6), (np.float64, 0.1, 5e6), (np.float64, 0.1, 1e9)]
)
def test_ties_far_from_the_origin(dtype, spacing, offset):
    """Map coordinates of a survey: a grid of some spacing, millions of metres away, rounded to the type."""
    grid = gridworld(9)
    corners_and_middle = Demonstrations.from_trajectories([([s], [k % 4]) for k, s in enumerate([0, 8, 40, 72, 80])])
    near, far = (
        nearest_neighbors(grid.mdp, corners_and_middle, metric="euclidean", coordinates=coordinates)
        for coordinates in (grid.coordinates, (np.asarray(grid.coordinates) * spacing + offset).astype(dtype))
    )
    assert np.any(near.support > 1)
    np.testing.assert_array_equal(far.support, near.support)
    np.testing.assert_allclose(far.policy, near.policy, rtol=0, atol=1e-12)


@pytest.mark.parametrize("is_traced", [False, True])
@pytest.mark.parametrize(("scale", "radius"), [(1e9, 1e9), (1e12, 2**31 - 128), (1e-9, 1)])
def test_radii_hold_in_int32(scale, radius, is_traced):
    mdp = MDP.from_dense(np.repeat(np.eye(2)[[1, 0]][:, None], 2, axis=1), discount=0.5)
    demonstrations = Demonstrations.from_trajectories([([0], [1])])
    learn = functools.partial(nearest_neighbors, metric="euclidean", coordinates=[[0.0], [scale]])
    result = (jax.jit(learn) if is_traced else learn)(mdp, demonstrations)
    assert result.radius.tolist() == [0, radius]


def test_euclidean_in_three_dimensions():
    """By hand: state 3 has two nearest states, 0 and 1, with two actions each."""
    mdp = MDP.from_dense(np.repeat(np.eye(4)[[1, 2, 3, 0]][:, None], 2, axis=1), discount=0.5)
    demonstrations = Demonstrations.from_trajectories([([0, 1, 2], [0, 1, 1]), ([1], [0])])
    coordinates = [[0, 0, 0], [2, 2, 2], [5, 5, 5], [1, 1, 1]]
    result = nearest_neighbors(mdp, demonstrations, metric="euclidean", coordinates=coordinates)
    np.testing.assert_allclose(result.policy[3], [0.75, 0.25])
    assert result.radius[3] == 2 and result.support[3] == 2


@pytest.mark.parametrize("name", ["grid", "track"])
def test_uniform_elsewhere(name):
    here = world(name)
    result = uniform_elsewhere(here.mdp, here.demonstrations)
    visited, policy = oracles.empirical_policy(*here.transition.shape[:2], here.trajectories)
    assert_extends(result, here, policy, np.where(visited, 0, -1))
    np.testing.assert_array_equal(result.policy[~visited], 1 / here.mdp.num_actions)


def test_the_global_map():
    """LP (8): the error against HiGHS, between a model and its part that was demonstrated."""
    here = world("strip")
    result = soft_homomorphism(here.mdp, here.demonstrations, anchored=False, tolerance=2e-3)
    visited, empirical = oracles.empirical_policy(16, 4, here.trajectories)
    error, _ = oracles.global_homomorphism_lp(here.transition, visited)
    assert result.error_lower <= error + 1e-9 and result.error_upper >= error - 1e-9
    assert result.error_upper - result.error_lower <= 2e-3
    np.testing.assert_array_equal(result.visited, visited)
    np.testing.assert_allclose(result.policy[visited], empirical[visited])
    np.testing.assert_allclose(result.policy.sum(axis=1), 1.0)
    np.testing.assert_array_equal(result.radius, np.where(visited, 0, 1))
    # pi(s, .) is an average of the demonstrated policies
    low, high = empirical[visited].min(axis=0), empirical[visited].max(axis=0)
    assert np.all(result.policy >= low - 1e-9) and np.all(result.policy <= high + 1e-9)


def test_the_global_error_on_a_6x6_grid(rng):
    """LP (8) against HiGHS, with a sixth of the states demonstrated."""
    transition = oracles.gridworld_transition(6)
    trajectories = [(np.array([0, 1, 7, 8]), rng.integers(4, size=4)), (np.array([35, 34]), rng.integers(4, size=2))]
    mdp = MDP.from_dense(transition, discount=0.9)
    result = soft_homomorphism(mdp, Demonstrations.from_trajectories(trajectories), anchored=False, tolerance=1e-3)
    visited = np.isin(np.arange(36), [0, 1, 7, 8, 34, 35])
    error, _ = oracles.global_homomorphism_lp(transition, visited)
    assert result.error_lower - 1e-9 <= error <= result.error_upper + 1e-9
    assert result.error_upper - result.error_lower <= 1e-3 and 0.05 < error < 0.95


# ---------------------------------------------------------------------------- where nothing is found

METHODS = {
    "Algorithm 1": soft_local_homomorphism,
    "hops": nearest_neighbors,
    "euclidean": lambda mdp, demonstrations: nearest_neighbors(
        mdp, demonstrations, metric="euclidean", coordinates=np.arange(mdp.num_states)[:, None]
    ),
    "maximum entropy": uniform_elsewhere,
    "global": soft_homomorphism,
}


@pytest.mark.parametrize("method", [soft_local_homomorphism, nearest_neighbors])
def test_states_that_cannot_reach_a_demonstrated_one_stay_uniform(method):
    """Two grids that never meet, one seen in its middle; and a chain, seen at its head or in its middle."""
    grid = oracles.gridworld_transition(3)
    chain = np.eye(4)[[1, 2, 3, 3]][:, None].repeat(4, axis=1)
    transition = np.zeros((22, 4, 22))
    for first, block in ((0, grid), (9, grid), (18, chain)):
        last = first + len(block)
        transition[first:last, :, first:last] = block
    mdp = MDP.from_dense(transition, discount=0.9)
    for seen, by_hand in ((18, [0, -1, -1, -1]), (20, [2, 1, 0, -1])):
        trajectories = [(np.array([4]), np.array([2])), (np.array([seen]), np.array([3]))]
        result = method(mdp, Demonstrations.from_trajectories(trajectories))
        np.testing.assert_array_equal(result.radius[9:18], -1)
        np.testing.assert_array_equal(result.support[9:18], 0)
        np.testing.assert_array_equal(result.policy[9:18], 0.25)
        if method is nearest_neighbors:
            np.testing.assert_array_equal(result.radius[:9], [2, 1, 2, 1, 0, 1, 2, 1, 2])
            np.testing.assert_array_equal(result.radius[18:], by_hand)
            oracle = oracles.hops_nearest_neighbors
        else:
            oracle = oracles.algorithm1
        expected, radius = oracle(transition, trajectories)
        np.testing.assert_array_equal(result.radius, radius)
        np.testing.assert_allclose(result.policy, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", METHODS)
def test_nothing_to_do_where_everything_was_visited(name):
    here = world("strip")
    pairs = [*(zip(range(16), np.arange(16) % 4, strict=True)), *zip(range(8), np.arange(1, 9) % 4, strict=True)]
    trajectories = [(np.array([state]), np.array([action])) for state, action in pairs]
    result = METHODS[name](here.mdp, Demonstrations.from_trajectories(trajectories))
    _, expected = oracles.empirical_policy(16, 4, trajectories)
    np.testing.assert_allclose(result.policy, expected, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(result.radius, 0)
    np.testing.assert_array_equal(result.support, 1)
    assert result.visited.all()


# ------------------------------------------------------------------------------ what is refused


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize(
    ("trajectory", "message"),
    [
        (([0, 16], [0, 0]), r"states\[0, 1\] must lie in \[0, 16\)"),
        (([3], [4]), r"actions\[0, 0\] must lie in \[0, 4\)"),
    ],
)
def test_demonstrations_of_another_model_are_refused(name, trajectory, message):
    with pytest.raises(ValueError, match=message):
        METHODS[name](world("strip").mdp, Demonstrations.from_trajectories([trajectory]))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"threshold": -0.1}, "threshold must not be negative, got -0.1"),
        ({"threshold": np.nan}, "threshold must be a number, got nan"),
        ({"tolerance": 0.0}, "tolerance must be positive, got 0.0"),
        ({"distance": 0}, "distance must be at least 1, got 0"),
    ],
)
def test_options_of_algorithm_1_out_of_range_are_refused(options, message):
    here = world("strip")
    with pytest.raises(ValueError, match=message):
        soft_local_homomorphism(here.mdp, here.demonstrations, **options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"metric": "manhattan"}, "metric must be .*, got 'manhattan'"),
        ({"metric": "euclidean"}, "needs coordinates"),
        ({"metric": "euclidean", "coordinates": np.full((16, 1), -1e200)}, r"must not be above 1e\+150 in size"),
        ({"coordinates": np.zeros((15, 2))}, r"coordinates must have shape \(16, D\), got \(15, 2\)"),
        ({"coordinates": np.zeros(16)}, r"coordinates must have shape \(16, D\), got \(16,\)"),
        ({"coordinates": np.full((16, 2), np.nan)}, r"coordinates\[0, 0\] must be finite, got nan"),
    ],
)
def test_neighbors_without_a_distance_are_refused(options, message):
    here = world("strip")
    with pytest.raises(ValueError, match=message):
        nearest_neighbors(here.mdp, here.demonstrations, **{"metric": "euclidean", **options})
