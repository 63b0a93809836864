"""Numbers rounded to a side, against the neighbours that the type has."""

import numpy as np
import pytest

from jaxhom.solvers.outward import rounded_down, rounded_up


@pytest.mark.parametrize("number", [0.1, -0.1, 1000.01, -7669.289551, 1e30, -1e30, 0.0, 0.5])
def test_the_nearest_number_of_the_type_on_that_side(number):
    below, above = rounded_down(number, np.float32), rounded_up(number, np.float32)
    assert below.dtype == above.dtype == np.float32
    assert float(below) <= number < float(np.nextafter(below, np.float32(np.inf)))
    assert float(np.nextafter(above, np.float32(-np.inf))) < number <= float(above)


def test_what_the_type_has_no_numbers_for():
    numbers = np.array([np.inf, -np.inf, 1e300, -1e300])
    largest = np.finfo(np.float32).max
    np.testing.assert_array_equal(rounded_down(numbers, np.float32), [np.inf, -np.inf, largest, -np.inf])
    np.testing.assert_array_equal(rounded_up(numbers, np.float32), [np.inf, -np.inf, np.inf, -largest])
