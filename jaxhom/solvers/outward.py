"""Bounds that stay bounds in a shorter type: rounded down where they are lower, up where they are upper."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import ArrayLike, Float


def rounded_down(numbers: Float[ArrayLike, "..."], dtype: np.dtype | type) -> Float[np.ndarray, "..."]:
    """The largest numbers of the type that are not above the given ones."""
    numbers = np.asarray(numbers, np.float64)
    with np.errstate(over="ignore"):
        rounded = numbers.astype(dtype)
    # In float64: Python numbers would be compared in the shorter type, where the two are equal.
    is_above = rounded.astype(np.float64) > numbers
    return np.where(is_above, np.nextafter(rounded, np.array(-np.inf, dtype)), rounded)


def rounded_up(numbers: Float[ArrayLike, "..."], dtype: np.dtype | type) -> Float[np.ndarray, "..."]:
    """The smallest numbers of the type that are not below the given ones."""
    return -rounded_down(-np.asarray(numbers, np.float64), dtype)
