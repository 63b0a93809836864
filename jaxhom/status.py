"""How an iterative answer ended."""

import enum


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
