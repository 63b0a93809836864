"""The regression baseline against HiGHS on the same linear program."""

import jax
import numpy as np
import oracles
import pytest

import jaxhom


@pytest.fixture(scope="module")
def problem():
    world = jaxhom.gridworld(6, num_regions=4)
    expert = jaxhom.optimal_policy(world.mdp, world.mdp.features[..., 3])
    return world, jaxhom.sample_demonstrations(jax.random.key(0), world.mdp, expert.policy, 3, 8)


def misfit(coordinates, mass):
    """Least sum of absolute errors of a quadratic in the coordinates, by linear programming."""
    from scipy.optimize import linprog

    x, y = (np.asarray(coordinates) / np.asarray(coordinates).max()).T
    basis = np.stack([np.ones_like(x), x, y, x * x, y * y, x * y], axis=1)
    count, size = basis.shape
    matrix = np.block([[basis, -np.eye(count)], [-basis, -np.eye(count)]])
    cost = np.concatenate([np.zeros(size), np.ones(count)])
    bounds = [(None, None)] * size + [(0, None)] * count
    return linprog(cost, matrix, np.concatenate([mass, -mass]), bounds=bounds).fun


def test_objective_is_the_optimum(problem):
    world, demonstrations = problem
    mdp = world.mdp
    trajectories = [
        (np.asarray(s), np.asarray(a)) for s, a in zip(demonstrations.states, demonstrations.actions, strict=True)
    ]
    found = jaxhom.occupancy_regression(mdp, demonstrations, world.coordinates)
    _, _, objective = oracles.occupancy_regression(
        np.asarray(mdp.transition), 0.99, np.asarray(mdp.initial), np.asarray(world.coordinates), trajectories
    )
    mass = np.asarray(jaxhom.occupancy(mdp, found.policy)).sum(axis=1)
    assert misfit(world.coordinates, mass) == pytest.approx(objective, rel=1e-4, abs=1e-4)
    visited, policy = jaxhom.empirical_policy(mdp, demonstrations)
    np.testing.assert_allclose(found.policy[visited], policy[visited], atol=1e-6)
    np.testing.assert_allclose(found.policy.sum(axis=1), 1.0, atol=1e-9)


def test_wrong_coordinates(problem):
    world, demonstrations = problem
    with pytest.raises(ValueError, match="coordinates must have shape"):
        jaxhom.occupancy_regression(world.mdp, demonstrations, np.zeros((5, 2)))
