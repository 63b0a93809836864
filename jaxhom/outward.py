"""Certified numbers as people read them: rounded outward, to the digits that hold on every machine."""

import math

_SLACK = 1e-9  # of a last digit: 0.25 is not rounded up because 0.25 / 1e-6 is not a whole number of doubles


def bracket(lower: float, upper: float) -> str:
    """`lower <= e <= upper` in six decimals."""
    low, high = math.floor(lower * 1e6 + _SLACK) / 1e6, math.ceil(upper * 1e6 - _SLACK) / 1e6
    return f"{low:.6g} <= e <= {high:.6g}"


def at_most(bound: float) -> str:
    """An upper bound that should be small, in two digits; below 1e-5 the digits are rounding's."""
    if not math.isfinite(bound):
        return format(bound, ".1e")
    last = max(10.0 ** (math.floor(math.log10(abs(bound))) - 1), 1e-5) if bound else 1e-5
    return format(math.ceil(bound / last - _SLACK) * last, ".1e")
