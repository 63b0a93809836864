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


def test_actions_that_are_missing(problem):
    """HiGHS on the program without their variables: transitions that may lead anywhere, and are not allowed."""
    from scipy.optimize import linprog

    world, demonstrations = problem
    allowed = np.random.default_rng(0).random((36, 4)) < 0.6
    expert = np.asarray(jaxhom.optimal_policy(world.mdp, world.mdp.features[..., 3]).policy)
    allowed |= expert > 0
    mdp = world.mdp.replace(allowed=allowed)
    found = jaxhom.occupancy_regression(mdp, demonstrations, world.coordinates)
    np.testing.assert_array_equal(np.asarray(found.policy)[~allowed], 0.0)
    np.testing.assert_allclose(found.policy.sum(axis=1), 1.0, atol=1e-9)
    # x of allowed pairs, b, and both signs of the errors
    visited, empirical = (np.asarray(array) for array in jaxhom.empirical_policy(mdp, demonstrations))
    total = np.repeat(np.eye(36), 4, axis=1)
    flow = total - 0.99 * np.asarray(world.mdp.transition).reshape(144, 36).T
    p, q = (np.asarray(world.coordinates) / 5.0).T
    basis = np.stack([np.ones(36), p, q, p * p, q * q, p * q], axis=1)
    fixed = np.concatenate([np.kron(np.eye(36)[s], np.eye(4) - empirical[s][:, None]) for s in np.flatnonzero(visited)])
    pairs, zeros = np.flatnonzero(allowed), np.zeros
    rows = [
        np.hstack([flow[:, pairs], zeros((36, 78))]),
        np.hstack([fixed[:, pairs], zeros((len(fixed), 78))]),
        np.hstack([total[:, pairs], -basis, -np.eye(36), np.eye(36)]),
    ]
    objective = linprog(
        np.concatenate([zeros(len(pairs) + 6), np.ones(72)]),
        A_eq=np.concatenate(rows),
        b_eq=np.concatenate([np.asarray(mdp.initial), zeros(len(fixed) + 36)]),
        bounds=[(0, None)] * len(pairs) + [(None, None)] * 6 + [(0, None)] * 72,
    ).fun
    mass = np.asarray(jaxhom.occupancy(mdp, found.policy)).sum(axis=1)
    assert misfit(world.coordinates, mass) == pytest.approx(objective, rel=1e-4, abs=1e-4)
