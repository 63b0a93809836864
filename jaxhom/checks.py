"""Host-side checks of user input: each failure is one `ValueError` that names the first offending index.

The checks run in NumPy on concrete arrays, in the constructors and at the doors of the library; jitted
code never checks values. Shapes are reported as expected against actual.
"""

import jax
import numpy as np


def as_host_array(name: str, value) -> np.ndarray:
    """Returns `value` as a NumPy array; explains itself if called on a traced value."""
    if isinstance(value, jax.core.Tracer):
        raise ValueError(
            f"{name} is a traced value: build models and demonstrations outside jit, vmap and grad, "
            "and exchange their arrays inside with `.replace(...)`"
        )
    try:
        return np.asarray(value)
    except ValueError as error:  # ragged nested lists
        raise ValueError(f"{name} is not a rectangular array: {error}") from None


def is_traced(*trees) -> bool:
    """True if any leaf of the given pytrees is a traced value (host checks are then impossible)."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(trees))


def require_shape(name: str, array, expected: str, condition: bool) -> None:
    """Raises unless `condition`; `expected` describes the shape in words."""
    if not condition:
        raise ValueError(f"{name} must have shape {expected}, got {tuple(np.shape(array))}")


def require_all(name: str, array: np.ndarray, good: np.ndarray, message: str) -> None:
    """Raises with the first index where `good` (same leading axes as `array`) is false."""
    if not np.all(good):
        index = tuple(int(i) for i in np.argwhere(~good)[0])
        value = array[index]
        where = list(index) if index else ""  # a scalar has no index to name
        raise ValueError(f"{name}{where} {message}, got {value}")


def require_floats(name: str, array: np.ndarray) -> np.ndarray:
    """Returns `array` as floating point (integers and booleans are converted); rejects NaN, infinity, text."""
    if array.dtype.kind in "iub":
        array = array.astype(np.float64)
    if array.dtype.kind != "f":
        raise ValueError(f"{name} must hold real numbers, got dtype {array.dtype}")
    require_all(name, array, np.isfinite(array), "must be finite")
    return array


def require_integers(name: str, array: np.ndarray, upper: int | None = None) -> np.ndarray:
    """Returns `array` as int64 with every entry in [0, upper); floats that are whole numbers are accepted."""
    if array.dtype.kind == "f":
        require_all(name, array, np.isfinite(array) & (array == np.floor(array)), "must be whole")
        require_all(name, array, np.abs(array) < 2**53, "is too large for an index")
    elif array.dtype.kind not in "iu":
        raise ValueError(f"{name} must hold integers, got dtype {array.dtype}")
    require_all(name, array, array >= 0, "must not be negative")
    if upper is not None:
        require_all(name, array, array < upper, f"must be below {upper}")
    return array.astype(np.int64)


def require_distribution(name: str, array: np.ndarray) -> np.ndarray:
    """Returns `array` as floats whose last axis is a probability distribution, to the dtype's rounding."""
    array = require_floats(name, array)
    require_all(name, array, array >= 0, "must not be negative")
    total = array.sum(axis=-1, dtype=np.float64)
    tolerance = 1e-6 if array.dtype == np.float64 else 1e-4
    require_all(f"sum of {name}", total, np.abs(total - 1.0) <= tolerance, "must be 1")
    return array


def require_discount(discount) -> np.ndarray:
    """Returns `discount` as a scalar strictly between 0 and 1."""
    discount = require_floats("discount", as_host_array("discount", discount))
    require_shape("discount", discount, "()", discount.ndim == 0)
    if not 0.0 < discount < 1.0:
        raise ValueError(f"discount must lie strictly between 0 and 1, got {discount}")
    return discount


def require_model_pair(source, target) -> None:
    """Raises unless two transition tensors are [n, A, n] and [m, A, m] with one A."""
    for name, array in (("source", source), ("target", target)):
        good = array.ndim == 3 and array.shape[0] == array.shape[2]
        require_shape(name, array, "[n, A, n]", good)
    same = source.shape[1] == target.shape[1]
    require_shape("target", target, f"[m, {source.shape[1]}, m]", same)
