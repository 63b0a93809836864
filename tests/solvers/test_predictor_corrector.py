"""The rules of interior-point steps, in NumPy and in JAX, against their definitions."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxhom.solvers.predictor_corrector import longest_step, mehrotra_target, towards_centre


@pytest.fixture(params=[np.asarray, jnp.asarray], ids=["NumPy", "JAX"])
def array(request):
    return request.param


def test_the_longest_step_ends_at_the_first_boundary(array):
    value, other = array([1.0, 2.0, 3.0]), array([1.0, 4.0])
    change, other_change = array([-0.5, 1.0, -3.0]), array([-2.0, 0.0])
    assert longest_step((value, change)) == 1.0
    assert longest_step((value, change), (other, other_change)) == 0.5
    assert longest_step((value, change), (other, other_change), to_boundary=0.9) == pytest.approx(0.45)
    assert longest_step((value, 0.125 * change), most=100.0) == 8.0


def test_where_nothing_is_in_the_way_the_step_is_the_longest_that_is_allowed(array):
    growing = array([1.0, 2.0]), array([0.0, 3.0])
    assert longest_step(growing) == longest_step(growing, to_boundary=0.9) == 1.0
    assert longest_step(growing, most=100.0) == 100.0


@pytest.mark.parametrize(
    ("left", "limits", "factor"),
    [(0.5, (), 0.125), (1e-3, (), 1e-9), (1e-3, (0.02,), 0.02), (2.0, (), 1.0), (2.0, (0.0, np.inf), 8.0)],
)
def test_the_target_falls_with_the_cube_of_what_the_predictor_leaves(array, left, limits, factor):
    np.testing.assert_allclose(mehrotra_target(array(2.0), array(left), *limits), 2.0 * factor, rtol=1e-12)


def test_products_are_pulled_towards_the_target_and_never_by_more_than_the_largest_wanted(array):
    found = towards_centre(array([1e-6, 0.1, 1.0, 9.0, 15.0, 1e3]), array(1.0), 0.1)
    np.testing.assert_allclose(found, [0.1 - 1e-6, 0.0, 0.0, 0.0, -5.0, -10.0], rtol=0, atol=1e-12)
