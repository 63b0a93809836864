"""What is said of an answer: how its iterations ended, and its bounds, rounded outward to digits that hold."""

import enum
import math

_SLACK = 1e-9  # of a last digit: 0.25 is not rounded up because 0.25 / 1e-6 is not a whole number of doubles


class Status(enum.IntEnum):
    """How a lane ended. Bounds are valid whatever the status."""

    SOLVED = 0
    ITERATION_LIMIT = 1
    STALLED = 2

    @property
    def message(self) -> str:
        """What happened, and what to do about it."""
        return {
            Status.SOLVED: "the bounds are as close as asked for",
            Status.ITERATION_LIMIT: (
                "the iteration limit came first: the bounds hold but are further apart than asked for; "
                "raise max_iterations or tolerance"
            ),
            Status.STALLED: (
                "rounding stopped progress before the tolerance was reached: the bounds hold; "
                "work in float64 (jax_enable_x64) or raise tolerance"
            ),
        }[self]


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
