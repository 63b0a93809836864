"""Brackets of arrays of models: both methods against HiGHS, and the bounds that cost no iteration."""

import numpy as np
import oracles
import pytest

from jaxhom.brackets import METHODS, bracket_errors, lower_bounds_without_iterations

PAIRS = 24


def models(seed, n, m, num_actions=2, concentration=1.0):
    rng = np.random.default_rng(seed)
    return tuple(rng.dirichlet(np.full(k, concentration), (PAIRS, k, num_actions)) for k in (n, m))


def errors(source, target, anchored=True):
    return np.array([oracles.homomorphism_lp(s, t, anchored)[0] for s, t in zip(source, target, strict=True)])


@pytest.mark.parametrize("anchored", [True, False])
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("tolerance", [1e-4, 1e-6])
def test_brackets_hold_the_optimum(method, tolerance, anchored):
    source, target = models(0, 4, 3)
    found = bracket_errors(source, target, method=method, tolerance=tolerance, anchored=anchored)
    optimum = errors(source, target, anchored)
    assert (found.upper - found.lower <= tolerance).all() and (found.status == 0).all()
    assert (found.lower <= optimum + 1e-9).all() and (optimum <= found.upper + 1e-9).all()


@pytest.mark.parametrize("method", ["pdhg", "interior_point"])
def test_padding_changes_nothing(method):
    source, target = models(1, 4, 3)
    size = np.full(PAIRS, 4), np.full(PAIRS, 3)
    wide = np.zeros((PAIRS, 6, 2, 6)), np.zeros((PAIRS, 5, 2, 5))
    wide[0][:, :4, :, :4], wide[1][:, :3, :, :3] = source, target
    found = bracket_errors(*wide, source_size=size[0], target_size=size[1], method=method, tolerance=1e-6)
    optimum = errors(source, target)
    assert (found.lower <= optimum + 1e-9).all() and (optimum <= found.upper + 1e-9).all()


def test_interior_point_is_finished_by_pdhg_where_it_stalls():
    """Tolerances at the edge of rounding: no lane may be left open without saying so."""
    source, target = models(2, 4, 3)
    found = bracket_errors(source, target, method="interior_point", tolerance=1e-9, max_iterations=2000)
    gap = found.upper - found.lower
    optimum = errors(source, target)
    assert ((gap <= 1e-9) == (found.status == 0)).all()
    assert (found.lower <= optimum + 1e-9).all() and (optimum <= found.upper + 1e-9).all()


@pytest.mark.parametrize("concentration", [0.1, 1.0])
def test_bounds_without_iterations(concentration):
    source, target = models(3, 4, 3, concentration=concentration)
    bound = lower_bounds_without_iterations(source, target)
    assert (bound <= errors(source, target) + 1e-9).all()
    assert (bound > 0.01).any()


@pytest.mark.parametrize("method", METHODS)
def test_decisions(method):
    source, target = models(4, 4, 3, concentration=0.3)
    optimum = errors(source, target)
    for threshold in np.quantile(optimum, [0.2, 0.6]) + 1e-3:
        found = bracket_errors(source, target, threshold=threshold, method=method)
        np.testing.assert_array_equal(found.upper <= threshold + 1e-4, optimum <= threshold)
        assert (found.lower <= optimum + 1e-9).all() and (optimum <= found.upper + 1e-9).all()
        assert (found.iterations == 0).any()


def test_no_pairs():
    found = bracket_errors(np.zeros((0, 3, 2, 3)), np.zeros((0, 3, 2, 3)))
    assert found.lower.shape == found.status.shape == (0,)


def test_one_state_models():
    ones = np.ones((2, 1, 2, 1))
    found = bracket_errors(ones, ones, threshold=0.0)
    assert (found.upper <= 1e-4).all()
