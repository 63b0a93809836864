"""What lets one text of a method serve arrays of JAX, in programs, and of NumPy, on the host.

Small problems are solved on the host long before XLA has compiled a program, and inside a program NumPy cannot be. A
method that is written with `module_of` and these loops does both.
"""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def module_of(array: Any) -> ModuleType:
    """`numpy` for its arrays and numbers, else `jax.numpy`."""
    return np if isinstance(array, np.ndarray | np.generic | float) else jnp


def while_loop(numpy: ModuleType, keep_going: Callable, advance: Callable, carry: Any) -> Any:
    """`jax.lax.while_loop`, or the same in Python."""
    if numpy is jnp:
        return jax.lax.while_loop(keep_going, advance, carry)
    while keep_going(carry):
        carry = advance(carry)
    return carry


def fori_loop(numpy: ModuleType, count: int, body: Callable, carry: Any) -> Any:
    """`jax.lax.fori_loop` from 0 on, or the same in Python."""
    if numpy is jnp:
        return jax.lax.fori_loop(0, count, body, carry)
    for number in range(count):
        carry = body(number, carry)
    return carry
