"""Bounds are shown rounded outward, and never by more than a digit."""

import math

import pytest

from jaxhom.status import at_most, bracket


def test_brackets_by_hand():
    assert bracket(0.0, 9.1e-13) == "0 <= e <= 1e-06"
    assert bracket(0.25, 0.25) == "0.25 <= e <= 0.25"
    assert bracket(0.1249999, 0.1250001) == "0.124999 <= e <= 0.125001"


@pytest.mark.parametrize(
    ("bound", "text"),
    [(0.0, "0.0e+00"), (4e-11, "1.0e-05"), (0.0321, "3.3e-02"), (5.1, "5.1e+00"), (math.inf, "inf"), (math.nan, "nan")],
)
def test_small_bounds_by_hand(bound, text):
    assert at_most(bound) == text


def test_no_bound_is_shown_smaller_than_it_is(rng):
    for bound in 10.0 ** rng.uniform(-12, 6, size=500):
        assert bound * (1 - 1e-6) <= float(at_most(bound)) <= bound + max(1.001e-5, 0.1001 * bound)
