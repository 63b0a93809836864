"""How states and actions that others wrote down become indices: as whole numbers, or by the names of a model.

A name is whatever a model calls a state by: a text, a number, a tuple of them. Arrays and lists count as tuples, and
NumPy's numbers as Python's, so that an observation finds its state in whatever form it was kept; in a text file a name
stands as Python writes it, `(3, 4)`, `[3, 4]` or `Place(x=3)`. Where a model names its states, a whole number means a
name if one of the names is a whole number, and else an index.
"""

from __future__ import annotations

import ast
import contextlib
import functools
import math
import re
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from typing import Any, NoReturn

import numpy as np

from jaxhom import checks
from jaxhom.models.mdp import MDP
from jaxhom.models.names import look_up

NO_ACTION = frozenset(("", "nan", "none", "null", "na", "n/a", "<na>"))  # what stands for no index
_OF_NUMPY = re.compile(r"\bnp\.\w+\(([^()]*)\)")  # its scalars, as they stand in tuples
_MOST_CHARACTERS = 100_000  # of a cell that is looked at as a Python literal


class Numbering:
    """The states or actions of a model, or of no model in particular, by number or name.

    Attributes:
      kind: "state" or "action", for messages.
      limit: indices lie in [0, limit).
      names: what a model calls them, or None.
    """

    def __init__(self, kind: str, limit: int = checks.LARGEST_INDEX, names: Sequence[Hashable] | None = None):
        self.kind, self.limit, self.names = kind, limit, names
        self._remedy = "; to_states turns other observations into state indices" if kind == "state" else ""

    def index_of_text(self, text: str) -> int:
        """The index that a text means.

        Raises:
          ValueError: if it means none, with what was expected.
        """
        if self.names is not None:
            for name in (text, literal(text)):
                if name in self._by_name:
                    return self._by_name[name]
            if (index := self._by_text.get(text)) is not None:
                return index
        number = whole_number(text)
        if number is None or self._has_numbers:
            self._refuse(text)
        if not 0 <= number < self.limit:
            raise ValueError(f"must lie in [0, {self.limit}), got {text}")
        return number

    def text_of(self, index: int) -> str:
        """A text that means this index: the number itself, unless that is somebody's name."""
        for text in (str(index), *(map(str, self.names[index : index + 1]) if self.names is not None else ())):
            with contextlib.suppress(ValueError):
                if self.index_of_text(text) == index:
                    return text
        raise ValueError(f"no text says {self.kind} {index}, which has the name of another")

    def indices(self, name: str, values: Any) -> np.ndarray:
        """The indices [H] of states or actions as arrays, lists, texts or names; `name` is what messages call them.

        Raises:
          ValueError: naming the first that is none.
        """
        if self.names is not None or _is_text(values):
            found = self._named(name, values)
            if found is not None:
                return found
        array = checks.as_host_array(name, values)
        if array.ndim == 2 and array.shape[1] == 1:
            array = array[:, 0]
        if array.ndim != 1:
            raise ValueError(f"{name} must have shape [H] or [H, 1], got {array.shape}{self._remedy}")
        if not array.size:  # an empty list has no type of its own
            return np.zeros(0, np.int64)
        if array.dtype.kind not in "iuf":
            raise ValueError(f"{name} must be whole numbers, got dtype {array.dtype}{self._remedy}")
        return checks.require_integers(name, array, self.limit)

    def _named(self, name: str, values: Any) -> np.ndarray | None:
        """The indices of texts and names; None where the values are indices rather than names."""
        if np.ndim(values) == 0 if isinstance(values, np.ndarray) else not isinstance(values, Iterable):
            return None
        keys = keys_of(values)
        if not self._has_numbers and all(isinstance(key, int | float) for key in keys):
            return None
        found = dict.fromkeys(keys, 0)
        for key in found:
            try:
                found[key] = self.index_of_text(key) if isinstance(key, str) else look_up(self.kind, self._by_name, key)
            except ValueError as error:
                remedy = "" if self.names else self._remedy
                raise ValueError(f"{name}[{keys.index(key)}]: {error}{remedy}") from None
        return np.fromiter((found[key] for key in keys), np.int64, len(keys))

    @functools.cached_property
    def _by_name(self) -> Mapping[Hashable, int]:
        return {key_of(name): index for index, name in enumerate(self.names or ())}

    @functools.cached_property
    def _by_text(self) -> Mapping[str, int | None]:
        """By what Python writes for each name, perhaps an object; None where that is the same for several."""
        found: dict[str, int | None] = {}
        for index, name in enumerate(self.names or ()):
            found[str(name)] = None if str(name) in found else index
        return found

    @functools.cached_property
    def _has_numbers(self) -> bool:
        return any(isinstance(name, int | float) for name in self._by_name)

    def _refuse(self, given: Hashable) -> NoReturn:
        """Raises about what is no name, or no whole number if there are no names."""
        if self.names is not None:
            look_up(self.kind, self._by_name, given)
        raise ValueError(f"must be a whole number, got {given!r}")


def numberings(mdp: MDP | None) -> tuple[Numbering, Numbering]:
    """Of the states and of the actions of a model; of all whole numbers without one."""
    if mdp is None:
        return Numbering("state"), Numbering("action")
    names = (mdp.state_names, mdp.action_names)
    sizes = (mdp.num_states, mdp.num_actions)
    states, actions = (Numbering(*each) for each in zip(("state", "action"), sizes, names, strict=True))
    return states, actions


def parsed(cells: Any) -> np.ndarray:
    """A column of texts as what they write in Python: [T, D] where all are D numbers each, else objects [T].

    Columns of something else stay as they are.
    """
    if not _is_text(cells):
        return np.asarray(cells)
    values = [literal(cell) if isinstance(cell, str) else cell for cell in cells]
    try:
        array = np.array(values)
    except ValueError:
        array = np.array(None)
    if array.dtype.kind not in "iuf" or len(array) != len(values):
        array = np.empty(len(values), object)
        array[:] = values
    return array


def _is_text(values: Any) -> bool:
    """Whether a sequence holds texts: by its type, or that of its first entry."""
    if isinstance(values, np.ndarray) and values.dtype != object:
        return values.dtype.kind == "U"
    return isinstance(values, list | tuple | np.ndarray) and len(values) > 0 and isinstance(values[0], str)


def number_in_order(columns: Iterable[Sequence[Hashable]]) -> tuple[list[np.ndarray], tuple[Hashable, ...]]:
    """Numbers keys in the order in which they first appear, and gives them in that order."""
    place: dict[Hashable, int] = {}
    numbered = [
        np.fromiter((place.setdefault(key, len(place)) for key in keys), np.int64, len(keys)) for keys in columns
    ]
    return numbered, tuple(place)


def keys_of(values: Any) -> list[Hashable]:
    """What each of a sequence of observations is called by, see the module's text."""
    if isinstance(values, np.ndarray) and values.dtype.kind in "biufUS":
        if values.ndim == 2 and values.shape[1] == 1:
            values = values[:, 0]
        if values.ndim <= 1:
            return np.atleast_1d(values).tolist()
        if values.ndim == 2:
            return list(map(tuple, values.tolist()))
    return [key_of(value) for value in values]


def key_of(value: Any) -> Hashable:
    """One observation as something that compares and hashes by its value.

    Raises:
      ValueError: if it is of no type that can be told apart by value.
    """
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return tuple(map(key_of, value))
    if isinstance(value, Mapping):
        return tuple((key, key_of(part)) for key, part in sorted(value.items(), key=lambda item: str(item[0])))
    try:
        hash(value)
    except TypeError:
        raise ValueError(f"no name can be made of an observation of type {type(value).__name__}") from None
    return value


def literal(text: str) -> Hashable:
    """The number, tuple or text that a cell writes as Python or NumPy do: `[0 1]`, `(np.int64(3),)`; else the cell."""
    if len(text) <= _MOST_CHARACTERS and text[:1] in "([{'\"-+.0123456789" and text:
        if text[0] == "[" and "," not in text:
            text = re.sub(r"(?<=[^\s\[])\s+(?=[^\s\]])", ", ", text)
        try:
            return key_of(ast.literal_eval(_OF_NUMPY.sub(r"\1", text) if "np." in text else text))
        except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
            return text
    return text


def whole_number(text: str) -> int | None:
    """3, and 3.0 as programs write the integers of a column with empty fields; None for anything else."""
    if text.isascii() and text.isdigit() and len(text) < 16:
        return int(text)
    try:
        number = float(text)
    except ValueError:
        return None
    return int(number) if number.is_integer() and "_" not in text else None


def whole_of(text: str | int) -> int:
    """The whole number that a text is; Python's underscores are no digits, as in names like 1_12.

    Raises:
      ValueError: if it is none.
    """
    if "_" in str(text):
        raise ValueError(f"not a whole number: {text!r}")
    return int(text)


def real_of(value: object) -> float:
    """The finite number that a text, or whatever has a float, is; underscores are no digits there either.

    Raises:
      ValueError: if it is none.
    """
    try:
        number = math.nan if "_" in str(value) else float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"not a number: {value!r}")
    return number


def indices_by_cell(cells: Sequence[str], index: Callable[[str], int]) -> np.ndarray:
    """The indices of many cells of few kinds; -1 where there is none, which the caller explains."""
    found = dict.fromkeys(cells, -1)
    for cell in found:
        try:
            found[cell] = index(cell)
        except ValueError:
            continue
    return np.fromiter(map(found.__getitem__, cells), np.int64, len(cells))
