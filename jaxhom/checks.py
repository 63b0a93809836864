"""Host-side checks of user input: each failure is one `ValueError` that names the first offending index.

The checks run in NumPy on concrete arrays, in the constructors and at the doors of the library; jitted
code never checks values. Shapes are reported as expected against actual.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import math
import operator
import reprlib
import sys
import warnings
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import TYPE_CHECKING, Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

if TYPE_CHECKING:
    from jax.typing import DTypeLike
    from jaxtyping import Array, ArrayLike, Bool, Float, Int, Num, Shaped

F = TypeVar("F", bound=Callable)
Axes = Sequence[Sequence[Any] | None]  # names of the indices along each axis of an array, where they have some

LARGEST_INDEX = 2**31 - 1  # states, actions and flat indices are int32
MAX_SLOTS = LARGEST_INDEX - 1  # one is the padding's


def as_host_array(name: str, value: Any) -> np.ndarray:
    """Returns `value` as a NumPy array; explains itself if called on a traced value."""
    if isinstance(value, jax.core.Tracer):
        raise ValueError(
            f"{name} is a traced value: build models and demonstrations outside jit, vmap and grad, "
            "and exchange their arrays inside with `.replace(...)`"
        )
    try:
        return np.asarray(value)
    except (TypeError, ValueError) as error:  # ragged nested lists, keys and other objects
        raise ValueError(f"{name} is not a rectangular array: {first_line(error)}") from None


def to_device(array: Any, dtype: DTypeLike | None = None) -> Array:
    """A JAX array of its own memory; float64 is float32 unless x64 is on.

    `jnp.asarray` compiles a program for every new shape of NumPy arrays, which takes longer than most of what is done
    with them; arrays of JAX and traced ones it takes as they are, and so does this.
    """
    if isinstance(array, jax.Array):
        return array if dtype is None else array.astype(dtype)
    return jax.device_put(np.array(array, dtype))


def is_traced(*trees: Any) -> bool:
    """True if any leaf of the given pytrees is a traced value (host checks are then impossible)."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(trees))


def is_at_hand(*trees: Any) -> bool:
    """Whether work on these arrays can be done on the host: they are concrete, and JAX computes on this CPU."""
    return not is_traced(*trees) and jax.default_backend() == "cpu"


def arrays_of(*trees: Any) -> ModuleType:
    """What to compute with: NumPy on values at hand, where XLA would compile a program per operation; else `jax.numpy`.

    Callers pass arrays through the module's `asarray`, and what they return through `to_device` where it leaves the
    library.
    """
    return np if is_at_hand(*trees) else jnp


def eager_where_concrete(function: F) -> F:
    """A door whose calls with concrete values alone run at once, under `jit` and `vmap` too, and give constants there.

    Without it whatever such a function computes on the way would be traced, and its work on the host fail.
    """

    @functools.wraps(function)
    def call(*args, **keywords):
        if is_traced(args, keywords):
            return function(*args, **keywords)
        with at_once():
            return function(*args, **keywords)

    return call


def at_once() -> contextlib.AbstractContextManager:
    """Within it, what is concrete is computed at once, inside a program too, where it becomes a constant.

    Elsewhere nothing is changed: JAX would compute the constants of programs one by one, each a program of its own.
    """
    is_inside = isinstance(jax.device_put(0), jax.core.Tracer)
    return jax.ensure_compile_time_eval() if is_inside else contextlib.nullcontext()


def refuse_traced(**options: Any) -> None:
    """Raises if an option, given by its name, is traced."""
    for name, value in options.items():
        if is_traced(value):
            raise ValueError(f"{name} is a traced value: inside jit, vmap and grad it must be a constant")


def warn(message: str, category: type[Warning]) -> None:
    """Warns of the line that called the library, from however deep within it."""
    library, frame, level = __name__.partition(".")[0], sys._getframe(1), 2
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] == library:
        frame, level = frame.f_back, level + 1
    warnings.warn(message, category, stacklevel=level)


def in_one_line(value: Any) -> str:
    """`repr` for messages: without line breaks, and cut off where it is long."""
    return " ".join(reprlib.repr(value).split())


def first_line(error: BaseException) -> str:
    """The first line of what an error says; the name of its type where it says nothing."""
    return str(error).strip().partition("\n")[0] or type(error).__name__


def require_shape(name: str, array: Any, expected: str, condition: bool) -> None:
    """Raises unless `condition`; `expected` describes the shape in words."""
    if not condition:
        raise ValueError(f"{name} must have shape {expected}, got {tuple(np.shape(array))}")


def require_all(
    name: str,
    array: Shaped[np.ndarray, "*N *X"],
    good: Bool[np.ndarray, "*N"],
    message: str,
    remark: str = "",
    axes: Axes = (),
) -> None:
    """Raises with the first index where `good` (same leading axes as `array`) is false; `remark` ends the message."""
    if not np.all(good):
        index = tuple(int(i) for i in np.argwhere(~good)[0])
        named = [
            str(i) if names is None else f"{i} {in_one_line(names[i])}"
            for i, names in itertools.zip_longest(index, axes[: len(index)])
        ]
        where = f"[{', '.join(named)}]" if index else ""  # a scalar has no index to name
        raise ValueError(f"{name}{where} {message}, got {array[index]}{remark}")


def require_floats(name: str, array: Shaped[np.ndarray, "*N"], axes: Axes = ()) -> Float[np.ndarray, "*N"]:
    """Returns `array` as floating point of at most 64 bits; rejects NaN, infinity, text."""
    if array.dtype.kind not in "iubf":
        raise ValueError(f"{name} must hold real numbers, got dtype {array.dtype}")
    if array.dtype.kind != "f" or array.dtype.itemsize > 8:
        array = array.astype(np.float64)
    require_all(name, array, np.isfinite(array), "must be finite", axes=axes)
    return array


def require_floats_in(
    dtype: DTypeLike, name: str, array: Shaped[np.ndarray, "*N"], axes: Axes = ()
) -> Float[np.ndarray, "*N"]:
    """Returns `array` as floats of the given type; rejects, beside NaN and so on, what overflows there."""
    array = require_floats(name, array, axes)
    with np.errstate(over="ignore"):
        converted = array.astype(dtype, copy=False)
    require_all(name, array, np.isfinite(converted), f"is too large for {np.dtype(dtype)}", axes=axes)
    return converted


def require_integers(name: str, array: Shaped[np.ndarray, "*N"], upper: int | None = None) -> Int[np.ndarray, "*N"]:
    """Returns `array` as int64 with every entry in [0, upper); floats that are whole numbers are accepted."""
    if array.dtype.kind == "f":
        require_all(name, array, np.isfinite(array) & (array == np.floor(array)), "must be whole")
        require_all(name, array, np.abs(array.astype(np.float64)) < 2**53, "is too large for an index")
    elif array.dtype.kind not in "iu":
        raise ValueError(f"{name} must hold integers, got dtype {array.dtype}")
    require_all(name, array, array >= 0, "must not be negative")
    if upper is not None:
        require_all(name, array, array < upper, f"must be below {upper}")
    return array.astype(np.int64)


def require_distribution(
    name: str, array: Shaped[np.ndarray, "*M N"], rows: Bool[np.ndarray, "*M"] | None = None, axes: Axes = ()
) -> Float[np.ndarray, "*M N"]:
    """Returns `array` as floats whose last axis sums to 1; what people have is brought there.

    Tables with six decimals (1/3, 1/6, 1/7) or once kept in float32 miss 1 in the last digits. Sums within
    `row_tolerance` of 1 are accepted, and those rows divided by their sum; what is below 0 by rounding alone is 0.

    Args:
      name: what to call it in messages.
      array: [..., N].
      rows: bool [...], the rows that have to be distributions; the others come back as zeros. All if None.
      axes: what messages call the indices along each axis, beside their numbers.

    Raises:
      ValueError: naming the first entry that is not finite or negative, or the first row whose sum is not 1.
    """
    if rows is not None:
        array = np.where(rows[..., None], array, 0)
    array = require_floats(name, array, axes)
    is_negative = array < 0
    if is_negative.any():
        is_rounding = is_negative & (array >= -8.0 * np.finfo(array.dtype).eps)  # as 1 - 0.9 - 0.1
        require_all(name, array, ~is_negative | is_rounding, "must not be negative", axes=axes)
        array = np.where(is_rounding, 0, array)
    with np.errstate(over="ignore"):
        total = array.sum(axis=-1, dtype=np.float64)
    if rows is not None:
        total = np.where(rows, total, 1.0)
    remark = f" (what is within {row_tolerance(array.dtype):.0e} of 1 is brought to 1)"
    require_all(f"sum of {name}", total, sums_to_one(total, array.dtype), "must be 1", remark, axes)
    is_off = np.abs(total - 1.0) > 8.0 * np.finfo(array.dtype).eps  # others stay as they are, to the bit
    if is_off.any():
        array = np.array(array)
        array[is_off] = array[is_off] / total[is_off][..., None]
    return array


def sums_to_one(total: Float[np.ndarray, "*M"], dtype: DTypeLike) -> Bool[np.ndarray, "*M"]:
    """Whether totals of rows of the given type are 1, up to `row_tolerance`."""
    return np.abs(total - 1.0) <= row_tolerance(dtype)


def row_tolerance(dtype: DTypeLike) -> float:
    """By how much a row of probabilities may miss the sum 1: 1e-5 in float64, 1e-4 in float32, 4e-3 in float16."""
    return 1e-5 if dtype == np.float64 else max(1e-4, 4.0 * float(np.finfo(dtype).eps))


def require_discount(discount: Any, dtype: DTypeLike = np.float64) -> Float[np.ndarray, ""]:
    """Returns `discount` as a scalar of the given type, strictly between 0 and 1 there too."""
    discount = require_floats("discount", as_host_array("discount", discount))
    require_shape("discount", discount, "()", discount.ndim == 0)
    if not 0.0 < discount < 1.0:
        raise ValueError(f"discount must lie strictly between 0 and 1, got {discount}")
    rounded = discount.astype(dtype)
    if not 0.0 < rounded < 1.0:
        raise ValueError(f"discount must lie strictly between 0 and 1, got {discount}: that is {rounded} in {dtype}")
    return rounded


def require_number(name: str, value: Any) -> float:
    """Returns `value`, one real number or a scalar array of one, as a float; NaN is none."""
    host = as_host_array(name, value)
    if host.shape != () or host.dtype.kind not in "fiu" or np.isnan(host):
        raise ValueError(f"{name} must be a number, got {in_one_line(value)}")
    return float(host)


def require_count(name: str, value: Any, least: int = 1) -> int:
    """Returns `value` as an int of at least `least`."""
    try:
        value = operator.index(None if isinstance(value, bool) else value)
    except TypeError:
        raise ValueError(f"{name} must be a whole number, got {in_one_line(value)}") from None
    if value < least:
        raise ValueError(f"{name} must be at least {least}, got {value}")
    return value


def require_switch(name: str, value: Any) -> bool:
    """Returns `value` if it is True or False; a text such as "no" is neither."""
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{name} must be True or False, got {in_one_line(value)}")
    return bool(value)


def require_function(name: str, value: Any) -> None:
    """Raises unless `value` can be called."""
    if not callable(value):
        raise ValueError(f"{name} must be a function, got {in_one_line(value)}")


def require_float_type(name: str, dtype: DTypeLike | None) -> None:
    """Raises unless `dtype` is a floating-point type, or None."""
    try:
        is_float = dtype is None or jnp.issubdtype(jnp.dtype(dtype), jnp.floating)
    except TypeError:
        is_float = False
    if not is_float:
        raise ValueError(f"{name} must be a floating-point type such as jax.numpy.float32, got {in_one_line(dtype)}")


def require_cell(name: str, cell: Any) -> tuple[int, int]:
    """Returns `cell` as the numbers of a row and a column."""
    try:
        row, column = cell
        return operator.index(row), operator.index(column)
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be two whole numbers (row, column), got {in_one_line(cell)}") from None


def require_flags(name: str, array: Any, count: int) -> Any:
    """Returns `array`, traced or not, if it is bool [count]; raises otherwise."""
    require_shape(name, array, f"({count},)", array.shape == (count,))
    if array.dtype != bool:
        raise ValueError(f"{name} must be bool, got dtype {array.dtype}")
    return array


def require_positive(name: str, value: Any, *, or_zero: bool = False) -> None:
    """Raises unless a number, or every number of an array, is positive where it is concrete."""
    if not is_traced(value):
        numbers = require_floats(name, as_host_array(name, value))
        good = (numbers > 0) | ((numbers == 0) & or_zero)
        require_all(name, numbers, good, "must not be negative" if or_zero else "must be positive")


def require_key(key: Any) -> None:
    """Raises unless `key` is a key of `jax.random`, or several."""
    dtype = getattr(key, "dtype", None)
    is_key = dtype is not None and (jnp.issubdtype(dtype, jax.dtypes.prng_key) or (dtype == np.uint32 and key.ndim > 0))
    if not is_key:
        raise ValueError(f"key must be a key of jax.random, such as jax.random.key(0), got {in_one_line(key)}")


def require_slots(num_states: int, num_actions: int, width: int) -> None:
    """Raises if the successor slots of a model are too many for 32-bit indices; before they are allocated."""
    if num_states * num_actions * width > MAX_SLOTS:
        raise ValueError(
            f"the model has {num_states} x {num_actions} x {width} successor slots (states, actions, widest row), "
            f"more than 2^31 - 2"
        )


def require_dense(what: str, *shape: int) -> None:
    """Raises if a dense array is too large for 32-bit indices, saying how large it would be; before it is allocated."""
    count = math.prod(shape)
    if count > MAX_SLOTS:
        size = " x ".join(map(str, shape))
        raise ValueError(
            f"{what} would hold {size} numbers, {8 * count / 2**30:,.0f} GiB in float64: work on its successors "
            "(mdp.next_state, mdp.probability), or on fewer states"
        )


def require_model_pair(
    source: Num[ArrayLike, "n A n"], target: Num[ArrayLike, "m A m"]
) -> tuple[Num[Array, "n A n"], Num[Array, "m A m"]]:
    """Returns two transition tensors with one A; where they are concrete, rows sum to 1, or are zero."""
    given = {
        name: array if is_traced(array) else require_floats(name, as_host_array(name, array))
        for name, array in (("source", source), ("target", target))
    }
    for name, array in given.items():
        shape = array.shape
        require_shape(name, array, "[n, A, n]", len(shape) == 3 and shape[0] == shape[2] and 0 not in shape)
    num_actions = given["source"].shape[1]
    require_shape("target", given["target"], f"[m, {num_actions}, m]", given["target"].shape[1] == num_actions)
    for name, array in given.items():
        if not is_traced(array):
            require_distribution(name, array, rows=array.any(axis=2))
    return jnp.asarray(source), jnp.asarray(target)
