"""What is said of an answer: its form, how its iterations ended, and its bounds, rounded outward to digits that hold.

Every result of the library is a `Record`: frozen, a pytree, short when printed, with a `status` where it iterates.
"""

from __future__ import annotations

import dataclasses
import enum
import html
import math
import reprlib
from collections.abc import Mapping, Sequence
from typing import Any, Self, dataclass_transform

import jax
import numpy as np

_SLACK = 1e-9  # of a last digit: 0.25 is not rounded up because 0.25 / 1e-6 is not a whole number of doubles
_LINE = 120  # characters of a line of a `repr`
_ENTRIES = 6  # of a mapping that are shown
_LONGEST = 60  # characters of what is shown as Python has it

_shortened = reprlib.Repr()
_shortened.maxstring = _shortened.maxother = _LONGEST


class Status(enum.IntEnum):
    """How a lane, one problem of a batch or the only one, ended. Bounds are valid whatever the status."""

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


@dataclass_transform(frozen_default=True, kw_only_default=True, eq_default=False, field_specifiers=(dataclasses.field,))
class Record:
    """The one kind of result: a frozen dataclass with keywords, a pytree, with a `replace` and a short `repr`.

    Deriving from it is all there is to do. Arrays, `None` and other pytrees are the fields' values; what else a field
    can be is said in its metadata:

        size: int = dataclasses.field(metadata={"static": True})                                 # part of the type
        explainer: Callable | None = dataclasses.field(default=None, metadata={"dropped": True})  # not in the pytree

    What is not a field, such as what an instance remembers in its `__dict__`, is neither in the pytree nor in pickles.
    """

    def __init_subclass__(cls) -> None:
        # Both work in place. Records are compared by identity: comparing arrays would be an array.
        dataclasses.dataclass(frozen=True, kw_only=True, eq=False, repr=False)(cls)
        kinds: dict[str, list[str]] = {"data": [], "static": [], "dropped": []}
        for field in dataclasses.fields(cls):
            kinds[next((kind for kind in kinds if field.metadata.get(kind)), "data")].append(field.name)
        if kinds["dropped"]:
            _register_without(cls, kinds["data"], kinds["static"])
        else:
            jax.tree_util.register_dataclass(cls, kinds["data"], kinds["static"])

    def replace(self, **changes: Any) -> Self:
        """Returns the record with the given fields exchanged."""
        return dataclasses.replace(self, **changes)

    def keys(self) -> list[str]:
        """The names of the fields: `dict(record)` has them all."""
        return [field.name for field in dataclasses.fields(self)]

    def __getitem__(self, name: str) -> Any:
        if name in self.keys():
            return getattr(self, name)
        raise KeyError(name)

    def __contains__(self, name: object) -> bool:
        return name in self.keys()

    __iter__: Any = None  # or Python would try numbers as names

    def _figures(self) -> dict[str, Any]:
        """What `repr` shows, by name: the fields, unless a class knows better."""
        return {name: getattr(self, name) for name in self.keys()}

    def __repr__(self) -> str:
        return summary(type(self).__name__, _figures_of(self))

    def _repr_html_(self) -> str:
        return html_summary(type(self).__name__, _figures_of(self))

    def __getstate__(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in self.keys()}


def _register_without(cls: type, data: list[str], static: list[str]) -> None:
    """Makes a class a pytree that forgets its other fields (`drop_fields` of jax 0.6.0 takes no field's name)."""

    def flatten(record):
        children = tuple((jax.tree_util.GetAttrKey(name), getattr(record, name)) for name in data)
        return children, tuple(getattr(record, name) for name in static)

    def unflatten(values, children):
        return cls(**dict(zip(data, children, strict=True)), **dict(zip(static, values, strict=True)))

    def flatten_at_once(record):  # what every call of a jitted function does
        return [getattr(record, name) for name in data], tuple(getattr(record, name) for name in static)

    jax.tree_util.register_pytree_with_keys(cls, flatten, unflatten, flatten_at_once)


def summary(name: str, figures: Mapping[str, Any]) -> str:
    """A `repr` of a line or a few: numbers as they are, arrays as type and shape, statuses by name; no None.

    Traced arrays and descriptions of shapes are shown too; nothing is compiled, and nothing raises.

    Args:
      name: of the class.
      figures: what to show, by name; the one called "status" holds the numbers of `Status`.

    Example:
      >>> summary("Answer", {"policy": np.zeros((3, 2)), "gap": np.float32(0.25), "status": np.array([0, 0, 2])})
      'Answer(policy=float64[3,2], gap=0.25, status=[2 SOLVED, 1 STALLED])'
    """
    parts = [f"{key}={_shown(key, value)}" for key, value in figures.items() if value is not None]
    lines = [f"{name}("]
    for number, part in enumerate(parts):
        part += ")" if number == len(parts) - 1 else ","
        is_first = number == 0 or lines[-1].isspace()
        if not is_first and len(lines[-1]) + len(part) + 1 > _LINE:
            lines.append(" " * (len(name) + 1) + part)
        else:
            lines[-1] += part if is_first else " " + part
    return "\n".join(lines) if parts else f"{name}()"


def html_summary(name: str, figures: Mapping[str, Any]) -> str:
    """What `summary` says as a table, for notebooks."""
    rows = "".join(
        f'<tr><th style="text-align: left">{html.escape(key)}</th>'
        f'<td style="text-align: left">{html.escape(_shown(key, value))}</td></tr>'
        for key, value in figures.items()
        if value is not None
    )
    return f"<table><caption>{html.escape(name)}</caption><tbody>{rows}</tbody></table>"


def _figures_of(record: Record) -> dict[str, Any]:
    """The figures; the fields where these are no arrays but a description of arrays, such as the axes of a vmap."""
    try:
        return record._figures()
    except Exception:  # whatever a description holds, it has to be printed
        return Record._figures(record)


def _shown(key: str, value) -> str:
    """One figure in few words."""
    try:
        if hasattr(value, "shape") and hasattr(value, "dtype"):
            return _shown_array(key, value)
        if isinstance(value, Record):
            figures = ((k, v) for k, v in _figures_of(value).items() if v is not None)
            return f"{type(value).__name__}({', '.join(f'{k}={_shown(k, v)}' for k, v in figures)})"
        if isinstance(value, Mapping):
            entries = [f"{k}: {_shown('', v)}" for k, v in list(value.items())[:_ENTRIES]]
            return "{" + ", ".join(entries + ["..."] * (len(value) > _ENTRIES)) + "}"
        if isinstance(value, float):
            return format(value, ".6g")
        if callable(value):
            return getattr(value, "__qualname__", type(value).__name__)
        text = " ".join(_shortened.repr(value).split())
        is_long = isinstance(value, Sequence) and not isinstance(value, str) and len(text) > _LONGEST
        return f"{type(value).__name__}[{len(value)}]" if is_long else text
    except Exception:  # a `repr` that raises hides the error that it is to explain
        return type(value).__name__


def _shown_array(key: str, array) -> str:
    """A number, the names of statuses, or type and shape."""
    described = f"{array.dtype}[{','.join(map(str, array.shape))}]"
    is_status = key == "status" and np.issubdtype(array.dtype, np.integer)
    if (array.shape and not is_status) or isinstance(array, jax.core.Tracer | jax.ShapeDtypeStruct):
        return described
    try:
        host = np.asarray(array)
    except Exception:  # a random key, or an array that was given away or lies on other machines
        return described
    if is_status:
        return _shown_status(host)
    return format(host.item(), ".6g") if host.dtype.kind == "f" else str(host)


def _shown_status(status: np.ndarray) -> str:
    """`SOLVED`, or how many lanes ended in which way."""
    names = {member.value: member.name for member in Status}
    numbers, counts = np.unique(status, return_counts=True)
    found = [(names.get(int(number), str(number)), count) for number, count in zip(numbers, counts, strict=True)]
    return "[" + ", ".join(f"{count} {name}" for name, count in found) + "]" if status.ndim else found[0][0]


def bracket(lower: float, upper: float) -> str:
    """`lower <= e <= upper` in six decimals."""
    low = math.floor(lower * 1e6 + _SLACK) / 1e6 if math.isfinite(lower) else lower
    high = math.ceil(upper * 1e6 - _SLACK) / 1e6 if math.isfinite(upper) else upper
    return f"{low:.6g} <= e <= {high:.6g}"


def at_most(bound: float) -> str:
    """An upper bound that should be small, in two digits; below 1e-5 the digits are rounding's."""
    if not math.isfinite(bound):
        return format(bound, ".1e")
    last = max(10.0 ** (math.floor(math.log10(abs(bound))) - 1), 1e-5) if bound else 1e-5
    return format(math.ceil(bound / last - _SLACK) * last, ".1e")
