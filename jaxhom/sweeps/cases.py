"""Cases and results: mappings of names to plain values, which a file gives back as they were."""

from __future__ import annotations

import dataclasses
import enum
import json
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from typing import Any

from jaxhom import checks

Plain = str | int | float | bool | None
OURS = ("case", "error", "seconds", "time", "host", "x64", "commit", "versions")
"""The columns that every row has beside those of its case and its result."""
_MOST_BITS = 10_000  # Python neither writes nor reads numbers of more than 4300 digits


@dataclasses.dataclass(frozen=True, slots=True)
class Case:
    """A case as it was given, its columns, and what tells it from others."""

    given: Any
    columns: dict[str, Plain]

    @property
    def key(self) -> str:
        """Equal for equal cases, whatever the order of their columns; 1, 1.0 and True are three values."""
        return key_of(self.columns)


@dataclasses.dataclass(frozen=True, slots=True)
class Job:
    """What `work` is called with at a time: a case, or a batch of them."""

    cases: tuple[Case, ...]
    is_batch: bool

    @property
    def given(self) -> Any:
        """What `work` gets."""
        return [case.given for case in self.cases] if self.is_batch else self.cases[0].given

    def only(self, keep: Callable[[Case], bool]) -> Job:
        """The same with fewer cases, none perhaps."""
        return dataclasses.replace(self, cases=tuple(case for case in self.cases if keep(case)))

    def split(self) -> list[Job]:
        """A batch of one for each of its cases."""
        return [Job((case,), self.is_batch) for case in self.cases]


def key_of(columns: Mapping[str, Plain]) -> str:
    """See `Case.key`."""
    return json.dumps(columns, sort_keys=True)


def checked_jobs(cases: Iterable[Any]) -> list[Job]:
    """The cases as jobs: mappings and dataclasses as they are, lists of those as batches.

    Raises:
      ValueError: naming the first case that is none, or that is there twice.
    """
    if isinstance(cases, (str, bytes, Mapping)) or not isinstance(cases, Iterable):
        raise ValueError(f"cases must be a sequence of mappings, got {checks.in_one_line(cases)}")
    jobs: list[Job] = []
    seen: dict[str, str] = {}
    for index, item in enumerate(cases):
        is_batch = isinstance(item, (list, tuple))
        if is_batch and not item:
            raise ValueError(f"cases[{index}] is a batch without cases")
        places = [f"cases[{index}][{lane}]" for lane in range(len(item))] if is_batch else [f"cases[{index}]"]
        made = tuple(_checked_case(*pair) for pair in zip(places, item if is_batch else [item], strict=True))
        for place, case in zip(places, made, strict=True):
            first = seen.setdefault(case.key, place)
            if first != place:
                raise ValueError(f"{place} is {first} once more: {checks.in_one_line(case.columns)}")
        jobs.append(Job(made, is_batch))
    return jobs


def checked_group(group: Callable[[Any], Hashable] | None, job: Job) -> Hashable:
    """What the first case of a job shares with others; nothing if it is None."""
    name = None if group is None else group(job.cases[0].given)
    try:
        hash(name)
    except TypeError:
        raise ValueError(f"group(case) must be hashable, got {checks.in_one_line(name)}") from None
    return name


def checked_result(result: Any, case: Mapping[str, Plain]) -> dict[str, Plain]:
    """The columns of a result: its own, not those of its case; "error" among them says that the case failed.

    Raises:
      ValueError: naming what no row can hold.
    """
    columns = _plain_columns("the result", result)
    for name in columns:
        if name in case:
            raise ValueError(f"the result has a column {name!r}, and so has the case")
        if name in OURS and name != "error":
            raise ValueError(f"the result has a column {name!r}, which every row has already")
    if not isinstance(columns.get("error"), str | None):
        raise ValueError(f"the result's error must be text or None, got {columns['error']!r}")
    return columns


def as_columns(given: Any) -> Any:
    """A dataclass as a mapping of its fields; everything else as it is."""
    if dataclasses.is_dataclass(given) and not isinstance(given, type):
        return {field.name: getattr(given, field.name) for field in dataclasses.fields(given)}
    return given


def _checked_case(place: str, given: Any) -> Case:
    columns = _plain_columns(place, as_columns(given))
    for name in columns:
        if name in OURS:
            raise ValueError(f"{place} has a column {name!r}, which every row has already")
    return Case(given, columns)


def _plain_columns(place: str, columns: Any) -> dict[str, Plain]:
    if not isinstance(columns, Mapping):
        raise ValueError(f"{place} must be a mapping of names to values, got {checks.in_one_line(columns)}")
    for name in columns:
        if not isinstance(name, str):
            raise ValueError(f"{place} must have names as keys, got {checks.in_one_line(name)}")
    return {str(name): _plain(f"{place}[{name!r}]", value) for name, value in columns.items()}


def _plain(place: str, value: Any) -> Plain:
    """A scalar of Python; statuses and other enumerations by their name."""
    if isinstance(value, enum.Enum):
        return value.name
    if value is None or isinstance(value, bool):
        return value
    if isinstance(value, int) and value.bit_length() > _MOST_BITS:
        raise ValueError(f"{place} is a whole number of {value.bit_length()} bits, more than a row holds")
    for kind in (str, int, float):
        if isinstance(value, kind):
            return kind(value)
    if hasattr(value, "item") and getattr(value, "shape", None) == ():  # of NumPy and JAX
        scalar = value.item()
        if isinstance(scalar, (str, int, float)):
            return scalar
    shape = getattr(value, "shape", ())
    what = f"an array of shape {tuple(shape)}" if shape else checks.in_one_line(value)
    raise ValueError(f"{place} must be text, a number, a truth value or None, got {what}")


def batched(results: Any, count: int) -> Sequence[Any]:
    """What `work` returns for a batch.

    Raises:
      ValueError: if it is not one result per case.
    """
    if not isinstance(results, Sequence) or isinstance(results, (str, bytes)):
        raise ValueError(f"work must return a list for a batch, got {checks.in_one_line(results)}")
    if len(results) != count:
        raise ValueError(f"work returned {len(results)} results for a batch of {count}")
    return results
