"""LPAL's columns: the pool of policies against their occupancies, games against HiGHS, lanes that share a pool."""

import jax
import numpy as np
import oracles
import pytest
import small_models

from jaxhom import Status, lpal
from jaxhom.apprenticeship import column_games
from jaxhom.apprenticeship.policy_pool import PolicyPool

# ------------------------------------------------------------------------------------------- pool


def fill(pool, case, count):
    """Adds policies, every other one deterministic; returns their occupancies [count, S, A] and expectations."""
    rng = np.random.default_rng(count)
    states, actions = case.shape
    occupancies = []
    for number in range(count):
        chosen = rng.integers(actions, size=states)
        policy = rng.dirichlet(np.ones(actions), size=states) if number % 2 else np.eye(actions)[chosen]
        x = oracles.occupancy(case.transition, case.discount, case.initial, policy)
        expected = np.einsum("sa,sak->k", x, case.features)
        assert pool.add(x.sum(axis=1), policy if number % 2 else chosen, expected) == number
        occupancies.append(x)
    return np.array(occupancies), np.einsum("nsa,sak->nk", occupancies, case.features)


@pytest.mark.parametrize("count", [1, 64, 65, 150])
def test_the_pool_grows(count):
    case = small_models.case("absorbing")
    pool = PolicyPool(case.mdp)
    assert pool.expected.shape == (0, 3)
    _, expected = fill(pool, case, count)
    np.testing.assert_allclose(pool.expected, expected, rtol=0, atol=1e-12)


def test_mixtures_are_sums_of_occupancies():
    """Of deterministic policies, of stochastic ones, and of both; before and after the pool has grown."""
    case = small_models.case("absorbing")
    pool = PolicyPool(case.mdp)
    occupancies, _ = fill(pool, case, 70)
    rng = np.random.default_rng(1)
    for numbers in ([4], [3], [0, 2, 68], [1, 69], [69, 0, 5, 64, 63]):
        q = rng.dirichlet(np.ones(len(numbers)))
        expected = np.einsum("n,nsa->sa", q, occupancies[numbers])
        np.testing.assert_allclose(pool.mixture(np.array(numbers), q), expected, rtol=0, atol=1e-12)


def test_the_pool_keeps_what_it_was_given():
    """An occupancy that its owner writes over later stays as it was."""
    case = small_models.case("absorbing")
    pool, mu = PolicyPool(case.mdp), np.arange(6.0)
    pool.add(mu, np.ones(6, int), np.zeros(3))
    mu[:] = -1.0
    np.testing.assert_array_equal(pool.mixture([0], [1.0]), np.arange(6.0)[:, None] * [0.0, 1.0])


# ------------------------------------------------------------------------------------------ games

WIDTH = 5


@pytest.mark.parametrize(
    ("features", "expected"),
    [(1, [32]), (8, [32]), (9, [32, 64]), (16, [32, 64]), (17, [32, 64, 128]), (64, [32, 128, 256])],
)
def test_capacities(features, expected):
    assert column_games.capacities(features) == expected


def payoffs(counts, num_features=20):
    rng = np.random.default_rng(sum(counts))
    games = [rng.normal(size=(num_features, count)) for count in counts]
    games[-1] *= 100.0
    return games


def cold(games):
    return [(np.zeros(len(payoff)), np.zeros(payoff.shape[1])) for payoff in games]


def play(games, former=None, bounds=None, tolerance=1e-5, share=0.0):
    bounds = [np.inf] * len(games) if bounds is None else bounds
    return column_games.play(games, cold(games) if former is None else former, bounds, tolerance, share, WIDTH)


def assert_proved(solution, games):
    """Distributions over the columns that exist, and bounds that they prove, around HiGHS's value."""
    for k, payoff in enumerate(games):
        w, q = solution.w[k], solution.q[k]
        size = np.abs(payoff).max()
        np.testing.assert_array_equal(q[payoff.shape[1] :], 0.0)
        np.testing.assert_allclose([w.sum(), q.sum()], 1.0, rtol=0, atol=1e-9)
        assert w.min() >= 0 and q.min() >= 0
        lower, upper = (payoff @ q[: payoff.shape[1]]).min(), (w @ payoff).max()
        np.testing.assert_allclose([solution.lower[k], solution.upper[k]], [lower, upper], rtol=0, atol=1e-9 * size)
        assert lower - 1e-7 * size <= size * oracles.game_value(payoff / size) <= upper + 1e-7 * size


@pytest.fixture(params=["interior point", "pdhg"])
def solver(request, monkeypatch):
    if request.param == "pdhg":
        monkeypatch.setattr(column_games, "_MAX_NEWTON_SIZE", 0)
    return request.param


@pytest.mark.parametrize("counts", [(1, 33, 64, 12, 40), (34, 1, 2)], ids=str)
def test_games_of_different_lengths(solver, counts):
    """As many games as the width, and fewer."""
    games = payoffs(counts)
    solution = play(games)
    assert solution.q.shape == (WIDTH, 64)
    assert_proved(solution, games)
    assert (solution.upper - solution.lower)[: len(games)].max() <= 1e-5


def test_short_games_are_not_padded_to_the_largest_capacity(monkeypatch):
    shapes = []
    monkeypatch.setattr(column_games, "_by_interior_point", lambda payoff, *_: shapes.append(payoff.shape) or ())
    for counts in ((1, 32), (1, 33)):
        play(payoffs(counts))
    assert shapes == [(WIDTH, 20, 32), (WIDTH, 20, 64)]


def test_games_begin_where_they_are_told(solver):
    """Near the solution, in a game with one more column; or, for one of them, in the middle."""
    games = payoffs((10, 20, 30, 40))
    shorter = [payoff[:, :-1] for payoff in games]
    first = play(shorter, tolerance=1e-2)
    former = [(first.w[k], np.append(first.q[k, : payoff.shape[1]], 0.0)) for k, payoff in enumerate(shorter)]
    former[1] = cold(games)[1]
    former[2] = (former[2][0], 0.5 * former[2][1])  # columns that were dropped took their share with them
    solution = play(games, former)
    assert_proved(solution, games)
    assert (solution.upper - solution.lower)[:4].max() <= 1e-5


def test_games_stop_early_where_much_is_open():
    games = payoffs((7, 20, 30, 40))
    bounds = [payoff.max() for payoff in games]
    solution, exact = play(games, bounds=bounds, share=0.5), play(games)
    assert_proved(solution, games)
    for k in range(4):
        assert solution.upper[k] - solution.lower[k] <= 0.5 * (bounds[k] - solution.lower[k])
        assert solution.steps[k] < exact.steps[k]


# ------------------------------------------------------------------------------------------ lanes

TOLERANCE = 1e-3


def expectations_around(case, count):
    """What random policies expect, made better and worse feature by feature."""
    rng = np.random.default_rng(count)
    policies = small_models.random_policy(rng, count, *case.shape)
    exact = [oracles.feature_expectations(*case.arrays, policy) for policy in policies]
    return np.array(exact) * rng.uniform(0.7, 1.3, size=(count, case.features.shape[2]))


@pytest.mark.parametrize("name", ["sparse", "restart"])
def test_the_answer_is_the_same_twice_and_other_lanes_do_not_spoil_it(name):
    """Twelve lanes share what they find: in programs that call LAPACK, which two at a time would wait for each other
    for ever ("sparse"), and in programs that run side by side if there is more than one core ("restart").

    Each is then solved beside copies of itself alone, and its certificate is held to the model in NumPy.
    """
    case = small_models.case(name)
    expectations = expectations_around(case, 12)
    batch, again = (lpal(case.mdp, expectations, tolerance=TOLERANCE) for _ in range(2))
    jax.tree.map(np.testing.assert_array_equal, batch, again)
    backwards = lpal(case.mdp, expectations[::-1], tolerance=TOLERANCE)
    np.testing.assert_array_equal(batch.status, Status.SOLVED)
    np.testing.assert_allclose(backwards.margin[::-1], batch.margin, rtol=0, atol=TOLERANCE)
    for k in (0, 5, 11):
        given = expectations[k]
        best = oracles.lpal(*case.arrays, given)[0]
        alone = lpal(case.mdp, np.tile(given, (12, 1)), tolerance=TOLERANCE)
        for solution, at in ((batch, k), (backwards, 11 - k), (alone, 3)):
            margin, bound = float(solution.margin[at]), float(solution.margin_bound[at])
            true = oracles.margin(*case.arrays, given, np.asarray(solution.policy[at]))
            np.testing.assert_allclose(margin, true, rtol=0, atol=1e-6)
            assert best - TOLERANCE - 1e-6 <= margin <= best + 1e-6
            assert best - 1e-6 <= bound <= margin + TOLERANCE
