"""LPAL by the sparse interior-point method: HiGHS on the same program, features up to one per state."""

from unittest import mock

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest

import jaxhom
from jaxhom import interop
from jaxhom.apprenticeship import interior_point
from jaxhom.apprenticeship.interior_point import LinearProgram


@pytest.mark.parametrize("num_regions", [16, 64])
def test_monte_carlo_expectations(num_regions):
    world = jaxhom.gridworld(8, num_regions=num_regions)
    mdp = world.mdp
    expert = jaxhom.optimal_policy(mdp, mdp.features[..., -1])
    samples = [jaxhom.sample_demonstrations(jax.random.key(i), mdp, expert.policy, 5, 20) for i in range(2)]
    expectations = jnp.stack([jaxhom.monte_carlo_feature_expectations(mdp, sample) for sample in samples])
    solution = jaxhom.lpal(mdp, expectations, method="interior_point")
    arrays = [np.asarray(mdp.transition), 0.99, np.asarray(mdp.initial), np.asarray(mdp.features)]
    for lane in range(2):
        best = oracles.lpal(*arrays, np.asarray(expectations[lane]))[0]
        assert solution.margin[lane] - 1e-8 <= best <= solution.margin_bound[lane] + 1e-8
        true = oracles.margin(*arrays, np.asarray(expectations[lane]), np.asarray(solution.policy[lane]))
        assert float(solution.margin[lane]) == pytest.approx(true, abs=1e-7)
    assert (solution.status == jaxhom.Status.SOLVED).all()


def test_one_feature_per_state_and_states_that_hardly_occur():
    """Occupancies of all sizes, and expectations that a policy reaches exactly: rounding must not stop it short."""
    lake = interop.from_gymnasium(gymnasium.make("FrozenLake-v1"), discount=0.99)
    mdp = lake.mdp.replace(features=np.repeat(np.eye(16)[:, None], 4, axis=1))
    expert = jaxhom.optimal_policy(mdp, lake.reward)
    expectations = jaxhom.feature_expectations(mdp, expert.policy)
    solution = jaxhom.lpal(mdp, expectations, method="interior_point")
    assert solution.status == jaxhom.Status.SOLVED
    assert solution.margin <= 0.0 <= solution.margin_bound  # states add up to a constant: v* = 0


@pytest.mark.parametrize("restricts", [False, True])
def test_compiled_steps_find_what_the_host_finds(restricts):
    """On a band, in batches and alone, with and without actions that some states lack."""
    mdp = jaxhom.gridworld(16, num_regions=4).mdp
    if restricts:
        mdp = mdp.replace(allowed=np.random.default_rng(0).random((256, mdp.num_actions)) < 0.9)
    rng = np.random.default_rng(1)
    expectations, tolerance = rng.uniform(0.0, 20.0, (3, mdp.num_features)) * [[1.0], [0.1], [1.0]], np.full(3, 1e-6)
    program = LinearProgram(mdp)
    points = program.solve_many(expectations, tolerance, np.array([100, 100, 2]))
    assert points[2].steps == 2
    alone = program.solve_many(expectations[:1], tolerance[:1], np.array([100]))[0]
    np.testing.assert_allclose(alone.x, points[0].x, atol=1e-6)
    for lane in range(2):
        plain = program.solve(expectations[lane], 1e-6)
        np.testing.assert_allclose(points[lane].weights, plain.weights, atol=1e-5)
        reached = [
            np.einsum("sak,sa->k", mdp.features, point.x) - expectations[lane] for point in (points[lane], plain)
        ]
        assert reached[0].min() == pytest.approx(reached[1].min(), abs=2e-6)
    assert not points[0].x[~np.asarray(mdp.allowed)].any()


def test_a_batch_that_cannot_be_compiled_or_begun_goes_lane_by_lane(monkeypatch):
    """A factorisation that rounding spoils at the start is no error of the caller's."""
    mdp = jaxhom.gridworld(16, num_regions=16).mdp
    expectations = np.random.default_rng(0).uniform(0.0, 8.0, size=(8, 16))
    expected = jaxhom.lpal(mdp, expectations, method="interior_point")
    spoiled = mock.Mock(side_effect=np.linalg.LinAlgError)
    monkeypatch.setattr(interior_point.LinearProgram, "solve_many", spoiled)
    monkeypatch.setattr(interior_point, "_SOON", 0)  # so small a model is not compiled otherwise
    solution = jaxhom.lpal(mdp, expectations, method="interior_point")
    assert spoiled.called
    assert (solution.status == jaxhom.Status.SOLVED).all()
    np.testing.assert_allclose(solution.margin, expected.margin, rtol=0, atol=1e-3)
