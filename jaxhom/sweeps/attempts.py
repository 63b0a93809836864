"""What happens where the work is done: a job is tried, timed, and whatever comes of it becomes plain columns.

`work` travels as bytes, made once, and each worker process unpickles it once, so that what it keeps between calls (a
model, compiled programs) is kept. cloudpickle, where it is installed, as Dask has it, takes functions of notebooks too.
"""

from __future__ import annotations

import dataclasses
import functools
import pickle
import platform
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax

from jaxhom.sweeps.cases import Plain, as_columns, batched, checked_result
from jaxhom.sweeps.provenance import LIBRARIES, versions

_LONGEST = 300  # characters of an error


@dataclasses.dataclass(frozen=True)
class Shipped:
    """A callable as bytes, and whether JAX is to compute in float64, as it does where the bytes were made."""

    pickled: bytes
    x64: bool

    def __call__(self, given: Any) -> Any:
        """Calls it; floats are as wide as those of the caller."""
        return self.load()(given)

    def load(self) -> Callable:
        """The callable, the same one in every call of a process; arrays in it keep their width."""
        if jax.config.jax_enable_x64 != self.x64:  # type: ignore[attr-defined]
            jax.config.update("jax_enable_x64", self.x64)
        return _load(self.pickled)


@functools.lru_cache(maxsize=4)
def _load(pickled: bytes) -> Callable:
    return pickle.loads(pickled)


def ship(work: Callable) -> Shipped:
    """Makes a callable ready for other processes.

    Raises:
      ValueError: if it cannot be pickled.
    """
    try:
        import cloudpickle as pickler
    except ImportError:
        pickler = pickle  # type: ignore[misc]
    try:
        return Shipped(pickler.dumps(work), jax.config.jax_enable_x64)  # type: ignore[attr-defined]
    except Exception as error:  # whatever the objects in it raise
        remark = "" if pickler is not pickle else " (with cloudpickle installed, functions of any place can)"
        reason = _in_one_line(str(error))
        raise ValueError(f"work cannot be sent to other processes: {reason}{remark}") from None


def attempt(work: Callable | Shipped, given: Any, is_batch: bool) -> list[dict[str, Plain]]:
    """Calls `work`; if a batch fails, on each of its cases, so that the one at fault alone has an error.

    Returns:
      For each case the columns of its result and of its provenance.
    """
    if isinstance(work, Shipped):
        work.load()  # what fails here is no fault of the case
    cases = given if is_batch else [given]
    start = time.perf_counter()
    results = _results(work, cases, is_batch)
    seconds = (time.perf_counter() - start) / len(cases)
    of_worker: dict[str, Plain] = {"seconds": seconds, "host": platform.node(), "x64": bool(jax.config.jax_enable_x64)}  # type: ignore[attr-defined]
    return [{**result, **of_worker, "versions": versions(*LIBRARIES)} for result in results]


def _results(work: Callable, cases: Sequence[Any], is_batch: bool) -> list[dict[str, Plain]]:
    """Per case the columns of its result, or its error."""
    try:
        found = batched(work(cases), len(cases)) if is_batch else [work(cases[0])]
    except (Exception, SystemExit) as error:
        if len(cases) == 1:
            return [_failed(error)]
        return [result for case in cases for result in _results(work, [case], is_batch)]
    return [_checked(result, case) for result, case in zip(found, cases, strict=True)]


def _checked(result: Any, case: Any) -> dict[str, Plain]:
    try:
        return checked_result(result, as_columns(case))
    except ValueError as error:
        return _failed(error)


def _failed(error: BaseException) -> dict[str, Plain]:
    try:
        text = str(error)
    except Exception:  # of classes whose texts cannot be made
        text = "its text cannot be made"
    return {"error": _in_one_line(f"{type(error).__name__}: {text}")}


def _in_one_line(text: str) -> str:
    return " ".join(text.split())[:_LONGEST]
