"""What states and actions are called, beside their numbers.

Names are hashable values, all different: texts, tuples such as (row, column), whatever the maker of a model has; those
of NumPy's types become Python's. All work is done on numbers; names are for people, and for finding a number again.
They are kept on the host and take no part in `jit`, `vmap` and `grad`: a model that comes out of a program has none.
"""

from __future__ import annotations

import difflib
from collections.abc import Hashable, Iterable, Mapping
from typing import Any

import numpy as np

from jaxhom import checks

Names = tuple[Hashable, ...]
_PLAIN = (int, str)  # what most names are made of


def check_names(argument: str, names: Iterable[Hashable] | None, count: int) -> Names | None:
    """The names as a tuple; rows of an array [count, D] as tuples.

    Raises:
      ValueError: if there are not `count` of them, or naming the first one that is not hashable or stands twice.
    """
    if names is None:
        return None
    listed = names.tolist() if isinstance(names, np.ndarray) else names
    if isinstance(listed, str) or not isinstance(listed, Iterable):
        raise ValueError(f"{argument} must be a sequence of names, got {checks.in_one_line(names)}")
    is_array = isinstance(names, np.ndarray)
    found = tuple(_of_python(tuple(name) if is_array and isinstance(name, list) else name) for name in listed)
    if len(found) != count:
        raise ValueError(f"{argument} must be {count} names, got {len(found)}")
    numbers_of(argument, found)
    return found


def _of_python(name: Any) -> Any:
    """A name without NumPy's types, which nobody writes and no file gives back: `3` for `np.int64(3)`."""
    if type(name) is tuple:
        return tuple([part if type(part) in _PLAIN else _of_python(part) for part in name])
    is_scalar = isinstance(name, np.generic) and isinstance(name, np.number | np.bool_ | np.str_ | np.bytes_)
    return name.item() if is_scalar else name


def numbers_of(argument: str, names: Names) -> dict[Hashable, int]:
    """The number of every name.

    Raises:
      ValueError: naming the first one that is not hashable or stands twice.
    """
    numbers: dict[Hashable, int] = {}
    for number, name in enumerate(names):
        try:
            first = numbers.setdefault(name, number)
        except TypeError:
            raise ValueError(f"{argument}[{number}] must be hashable, got {checks.in_one_line(name)}") from None
        if first != number:
            raise ValueError(f"{argument}[{number}] must be new, got {checks.in_one_line(name)} again, as [{first}]")
    return numbers


def look_up(kind: str, numbers: Mapping[Hashable, int] | None, name: Any) -> int:
    """The number of a name.

    Args:
      kind: "state" or "action", for messages.
      numbers: by name; None if the model has no names.
      name: one of them.

    Raises:
      ValueError: if there is no such name, with the ones that look most like it.
    """
    if numbers is None:
        raise ValueError(f"this model's {kind}s have no names: build it with {kind}_names=[...]")
    try:
        return numbers[name]
    except (KeyError, TypeError):  # TypeError: a list, say, which is the name of nothing
        texts = {str(known): known for known in numbers} if len(numbers) <= _SEARCHED else {}
        close = [repr(texts[text]) for text in difflib.get_close_matches(str(name), texts, cutoff=0.5)]
        remedy = f"; did you mean {' or '.join(close)}?" if close else ""
        raise ValueError(f"there is no {kind} {checks.in_one_line(name)}{remedy}") from None


def described(number: int, names: Names | None) -> str:
    """A number for people, with its name where there is one: `3`, `3 'door'`, `3 (0, 1)`."""
    return str(int(number)) if names is None else f"{int(number)} {checks.in_one_line(names[int(number)])}"


_SEARCHED = 100_000  # names, to look for similar ones
