"""The checks of user input that no other test file meets through a constructor."""

import jax
import numpy as np
import pytest

from jaxhom import checks


@pytest.mark.parametrize(
    "value", [[0, 2], np.array([0.0, 2.0]), np.array([0, 2], np.uint8), np.array([0, 2], np.float16)]
)
def test_whole_numbers_of_any_type_are_integers(value):
    result = checks.require_integers("states", np.asarray(value), upper=3)
    assert result.dtype == np.int64
    np.testing.assert_array_equal(result, [0, 2])


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ([0, 1.5], r"states\[1\] must be whole, got 1.5"),
        ([np.nan], r"states\[0\] must be whole, got nan"),
        ([2.0**60], r"states\[0\] is too large for an index"),
        ([[0, 1], [-2, 0]], r"states\[1, 0\] must not be negative, got -2"),
        ([0, 3], r"states\[1\] must be below 3, got 3"),
        (["a"], "states must hold integers, got dtype <U1"),
        ([True], "states must hold integers, got dtype bool"),
    ],
)
def test_require_integers_rejects(value, message):
    with pytest.raises(ValueError, match=message):
        checks.require_integers("states", np.asarray(value), upper=3)


@pytest.mark.parametrize("dtype", [np.int32, np.uint8, bool])
def test_integers_and_booleans_become_floats(dtype):
    assert checks.require_floats("x", np.ones(2, dtype)).dtype == np.float64


def test_float32_keeps_its_type_and_has_its_own_tolerance():
    row = np.array([0.5, 0.50001], np.float32)
    assert checks.require_distribution("row", row).dtype == np.float32
    with pytest.raises(ValueError, match=r"sum of row must be 1, got 1\.00001"):
        checks.require_distribution("row", row.astype(np.float64))


@pytest.mark.parametrize("value", [np.eye(3), "x" * 1000, ["a\nb"] * 50, object()])
def test_values_in_messages_are_short_and_have_no_line_breaks(value):
    text = checks.in_one_line(value)
    assert 0 < len(text) < 200 and "\n" not in text


@pytest.mark.parametrize("value", ["no", None, 1, np.ones(1, bool)])
def test_only_true_and_false_are_switches(value):
    assert [checks.require_switch("mutual", given) for given in (True, np.False_)] == [True, False]
    with pytest.raises(ValueError, match="mutual must be True or False, got"):
        checks.require_switch("mutual", value)


def test_the_first_line_of_an_error():
    assert checks.first_line(ValueError("\n one\n two")) == "one"
    assert checks.first_line(KeyboardInterrupt()) == "KeyboardInterrupt"


def test_is_traced_sees_one_traced_leaf():
    seen = []
    jax.jit(lambda x: seen.append(checks.is_traced({"a": np.ones(2)}, (x, 3))))(1.0)
    assert seen == [True]
    assert not checks.is_traced({"a": np.ones(2)}, 1.0)


def test_what_is_below_zero_by_rounding_is_zero():
    rows = checks.require_distribution("rows", np.array([[1 - 0.9 - 0.1, 0.9, 0.1], [0.0, 0.5, 0.5]]))
    np.testing.assert_array_equal(rows[0, 0], 0.0)
    np.testing.assert_allclose(rows.sum(axis=1), 1.0, rtol=0, atol=1e-15)
    with pytest.raises(ValueError, match=r"rows\[0\] must not be negative"):
        checks.require_distribution("rows", np.array([-1e-9, 1.0]))


def test_thirds_in_float16_are_a_distribution():
    np.testing.assert_allclose(checks.require_distribution("row", np.full(3, 1 / 3, np.float16)).sum(), 1.0, atol=1e-3)
