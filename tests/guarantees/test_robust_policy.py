"""The policy of least worst loss, against the linear program over occupancies."""

import numpy as np
import oracles
import pytest
from test_loss_bound import KINDS, problem

import jaxhom
from jaxhom import Demonstrations, Status, loss_bound, robust_policy


@pytest.mark.parametrize("kind", KINDS)
def test_it_is_the_optimum_of_the_linear_program(kind, rng):
    for number in range(10):
        given = problem(rng, kind, num_features=1 + number % 3)
        transition, discount, initial, features = given.arrays
        allowed = given.allowed[..., None]
        best, _ = given.best
        # An action that is missing does what the first one does.
        arrays = np.where(allowed, transition, transition[:, :1]), discount, initial
        margin, _, _ = oracles.lpal(*arrays, np.where(allowed, features, features[:, :1]), best)
        found = robust_policy(given.mdp, given.demonstrations, tolerance=1e-7)
        assert found.status == Status.SOLVED
        assert found.least_loss <= -margin + 1e-8
        assert found.loss.bound >= -margin - 1e-8
        assert found.loss.bound - found.least_loss <= 1.1e-7
        own = oracles.feature_expectations(*given.arrays, np.asarray(found.policy, float))
        assert found.loss.bound == pytest.approx((best - own).max(), abs=1e-8)
        assert found.weights.sum() == pytest.approx(1.0)


def test_no_policy_has_a_smaller_bound(rng):
    given = problem(rng)
    found = robust_policy(given.mdp, given.demonstrations)
    policies = np.concatenate([rng.dirichlet(np.ones(2), (50, 6)), given.policy[None], given.expert[None]])
    assert (loss_bound(given.mdp, given.demonstrations, policies).bound >= found.least_loss).all()


def test_one_feature_is_planned_for(rng):
    """With the reward known nothing is to be hedged: the best policy is at least as good as any expert."""
    given = problem(rng, num_features=1)
    found = robust_policy(given.mdp, given.demonstrations)
    best = jaxhom.optimal_policy(given.mdp, given.mdp.features[..., 0])
    assert found.loss.bound == pytest.approx(float(loss_bound(given.mdp, given.demonstrations, best).bound), abs=1e-3)
    assert found.loss.bound <= 1e-3


def test_an_early_stop_says_so_and_its_bounds_hold():
    grid = jaxhom.gridworld(8, num_regions=16)
    walks = Demonstrations.from_trajectories([([0, 1, 2, 3], [2, 2, 2, 1])])
    early = robust_policy(grid, walks, method="columns", max_iterations=2)
    late = robust_policy(grid, walks)
    assert early.status == Status.ITERATION_LIMIT
    assert late.status == Status.SOLVED
    assert early.least_loss <= late.loss.bound
    assert late.least_loss <= early.loss.bound


def test_float32_bounds_hold(rng):
    grid = jaxhom.gridworld(4, num_regions=4, discount=0.9)
    walks = Demonstrations.from_trajectories([([0, 1, 2, 3, 7], [2, 2, 2, 1, 1])])
    mdp = grid.mdp
    short = jaxhom.MDP.from_dense(
        np.asarray(mdp.transition, np.float32), discount=0.9, initial=mdp.initial, features=mdp.features
    )
    found, exact = robust_policy(short, walks), robust_policy(grid, walks, tolerance=1e-8)
    assert found.loss.bound.dtype == np.float32
    assert float(found.least_loss) <= float(exact.loss.bound) + 1e-4
    assert float(found.loss.bound) >= float(exact.least_loss) - 1e-7
    assert found.loss.bound == pytest.approx(float(exact.loss.bound), abs=1e-2)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "guess"}, "method must be one of"),
        ({"tolerance": -1.0}, "tolerance must be positive"),
        ({"max_iterations": 0}, "max_iterations must be at least 1"),
    ],
)
def test_refuses(options, message, rng):
    given = problem(rng)
    with pytest.raises(ValueError, match=message):
        robust_policy(given.mdp, given.demonstrations, **options)


def test_a_model_without_features_is_refused(rng):
    given = problem(rng)
    with pytest.raises(ValueError, match="the model has no features"):
        robust_policy(given.mdp.replace(features=np.zeros((6, 2, 0))), given.demonstrations)
