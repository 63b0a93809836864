"""The judge of LPAL's rows: both sides hold and are close, by factors and by sweeps; none of our solvers is asked."""

import dataclasses

import numpy as np
import oracles
import pytest

import jaxhom
from bench import instances, lpal_speed, models, ours
from bench.models import Model

SWEEPS = pytest.mark.parametrize("by_sweeps", [False, True])


@pytest.fixture
def case(by_sweeps, monkeypatch, rng):
    """A small grid with features uniform on [0, 1]: the model, its arrays in NumPy, and a policy."""
    if by_sweeps:
        monkeypatch.setattr(models, "_TOO_LARGE", 1)
    mdp = instances.grid(4)
    mdp = mdp.replace(features=rng.random((mdp.num_states, mdp.num_actions, 3)))
    model = Model.of(mdp)
    transition = model.transition.toarray().reshape(*model.shape, -1)
    features = model.features.toarray().reshape(*model.shape, -1)
    policy = rng.dirichlet(np.ones(model.shape[1]), model.shape[0])
    return mdp, model, (transition, model.discount, model.initial, features), policy


@SWEEPS
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_no_policy_is_worth_more_than_the_bound(case, sign):
    _, model, (transition, discount, initial, features), _ = case
    reward = sign * features @ np.array([0.5, 0.2, 0.3])
    best, action_value = oracles.optimal_value(transition, discount, reward)
    bound, actions = model.most_value(reward, 1e-4)
    assert best @ initial <= bound <= best @ initial + 1.1e-4
    own = np.take_along_axis(action_value, actions[:, None], axis=1)[:, 0]
    np.testing.assert_allclose(own, action_value.max(axis=1), rtol=0, atol=1e-3)


@SWEEPS
def test_expectations_are_not_overstated(case):
    _, model, arrays, policy = case
    exact = oracles.feature_expectations(*arrays, policy)
    found = model.least_expectations(policy, 1e-4)
    assert np.all(found <= exact + 1e-11) and np.all(found >= exact - 2.2e-4)


@SWEEPS
def test_the_judge_says_what_the_certificate_says(case):
    mdp, model, arrays, policy = case
    expectations = oracles.feature_expectations(*arrays, policy) * [1.1, 0.9, 1.0]
    found = jaxhom.lpal(mdp, expectations, tolerance=1e-3)
    answer = np.asarray(found.occupancy), np.asarray(found.weights)
    gap = lpal_speed.certified_gap(model, answer, expectations, 1e-3)
    assert 0.0 <= gap <= float(found.margin_bound - found.margin) + 1e-5
    worse = lpal_speed.certified_gap(model, (np.ones_like(answer[0]), answer[1]), expectations, 1e-3)
    assert worse > 10 * gap
    assert lpal_speed.certified_gap(model, (np.nan * answer[0], answer[1]), expectations, 1e-3) == np.inf


def test_the_library_names_the_status_and_the_method_that_decided(monkeypatch):
    small = dataclasses.replace(instances.LPAL["grid16"], build=lambda: instances.regions(4, 4))
    monkeypatch.setitem(instances.LPAL, "small", small)
    solver = ours.lpal("small", "columns", tolerance=0.5)
    _, expectations = small.draw(0, 2)
    solver.load(list(expectations))
    for (x, w), words, iterations in solver.read(solver.solve(60.0)):
        assert x.shape == (16, 4) and w.shape == (4,) and iterations > 0
        assert words in ("SOLVED", "SOLVED by columns")


def test_the_largest_instance_is_small_enough_to_be_measured():
    largest = instances.LPAL["grid1000"]
    assert (largest.gap, largest.most_lanes, largest.has_peers) == (0.01, 1, False)
    assert all(instance.gap is None for name, instance in instances.LPAL.items() if name != "grid1000")
