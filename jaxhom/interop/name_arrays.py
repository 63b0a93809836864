"""Names of states and actions as plain arrays, for files.

texts [N]             names that are texts
integers [N]          whole numbers
integers [N, D]       tuples of D whole numbers, such as (row, column)
texts [N, 1]          literals of Python: ("kitchen", 2), None, 0.5, True; other names as literals of their texts
"""

from __future__ import annotations

import ast
from collections.abc import Hashable

import numpy as np

from jaxhom import checks
from jaxhom.models.names import Names


def names_as_array(names: Names) -> np.ndarray:
    """The names in the first of the module's forms that holds them.

    Raises:
      ValueError: if two of them would come back as the same text.
    """
    if all(type(name) is str and not name.endswith("\0") for name in names):  # NumPy pads texts with NUL
        return np.array(names)
    if all(_is_index(name) for name in names):
        return np.array(names, np.int64)
    is_place = all(type(name) is tuple and name and all(map(_is_index, name)) for name in names)
    if is_place and len({len(name) for name in names if isinstance(name, tuple)}) == 1:
        return np.array(names, np.int64)
    literals = [repr(name) if _literal(repr(name)) == name else repr(str(name)) for name in names]
    first: dict[str, int] = {}
    for number, text in enumerate(literals):
        if first.setdefault(text, number) != number:
            twins = f"{checks.in_one_line(names[first[text]])} and {checks.in_one_line(names[number])}"
            raise ValueError(f"a file cannot tell the names {twins} apart: both would be {text}")
    return np.array(literals)[:, None]


def names_of(argument: str, array: np.ndarray) -> list[Hashable]:
    """The names that an array holds.

    Raises:
      ValueError: if it has none of the module's forms.
    """
    if array.dtype.kind == "U" and array.ndim == 2 and array.shape[1] == 1:
        return [_literal(text) for text in array[:, 0].tolist()]
    if (array.dtype.kind == "U" and array.ndim == 1) or (array.dtype.kind in "iu" and array.ndim in (1, 2)):
        return [tuple(name) if isinstance(name, list) else name for name in array.tolist()]
    checks.require_shape(argument, array, "[N] or [N, D]", array.ndim in (1, 2))
    raise ValueError(f"{argument} must be texts [N] or whole numbers [N] or [N, D], got dtype {array.dtype}")


def _is_index(name) -> bool:
    return type(name) is int and abs(name) < 2**63


def _literal(text: str) -> Hashable:
    """What a text stands for; the text itself if it is no literal."""
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError, MemoryError, RecursionError):
        return text
