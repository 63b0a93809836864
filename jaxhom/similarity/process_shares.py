"""Pairs of classes shared out to all processes of `jax.distributed`, each of which ends up with all of their bounds.

Every process runs the same program and comes here with the same pairs. Each solves every n-th of them on its own
devices or in NumPy; pairs come sorted by size, so shares take about as long. Then bounds are exchanged, bit by bit.
What goes wrong in one process ends the call in all of them.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import TYPE_CHECKING

import jax
import numpy as np
from jax.experimental import multihost_utils

from jaxhom.similarity.brackets import LocalSimilarity

if TYPE_CHECKING:
    from jaxtyping import Int, UInt8

_MESSAGE = 400  # bytes of a message that is passed on
_FINE, _FAILED, _INTERRUPTED = 0, 1, 2


def solved_in_shares(
    solve: Callable[[Int[np.ndarray, "B 2"]], LocalSimilarity], pairs: Int[np.ndarray, "Q 2"], question: bytes
) -> LocalSimilarity:
    """Bounds of pairs of classes [Q, 2], of which this process solves its share.

    Args:
      solve: bounds of some of the pairs.
      pairs: the same in all processes.
      question: all that is asked about them, by which processes are told that were asked something else.

    Raises:
      RuntimeError: if another process failed, with its message.
      KeyboardInterrupt: if another was interrupted.
      ValueError: if another was asked something else.
    """
    count, number = jax.process_count(), jax.process_index()
    found, error = None, None
    try:
        found = solve(pairs[number::count])
    except BaseException as caught:  # Ctrl-C too: the others must not wait for it
        error = caught
    _raise_what_went_wrong(_gather(_report(question, error)), error)
    rows = _gather(_rows_of(found, -(-len(pairs) // count)))
    result = np.empty(len(pairs), rows.dtype)
    for process, own in enumerate(rows):
        result[process::count] = own[: len(result[process::count])]
    return LocalSimilarity(**{name: np.ascontiguousarray(result[name]) for name in result.dtype.names})


def _report(question: bytes, error: BaseException | None) -> UInt8[np.ndarray, " bytes"]:
    """What this process was asked, and how that ended."""
    asked = hashlib.sha256(question).digest()
    kind = _FINE if error is None else _INTERRUPTED if isinstance(error, KeyboardInterrupt) else _FAILED
    message = "" if error is None else f"{type(error).__name__}: {error}"
    text = message.encode()[:_MESSAGE].ljust(_MESSAGE, b"\0")
    return np.frombuffer(asked + bytes([kind]) + text, np.uint8)


def _raise_what_went_wrong(reports: UInt8[np.ndarray, "processes bytes"], own: BaseException | None) -> None:
    if own is not None:
        raise own
    asked, kinds, texts = reports[:, :32], reports[:, 32], reports[:, 33:]
    for process in np.flatnonzero(kinds != _FINE):
        text = texts[process].tobytes().rstrip(b"\0").decode(errors="ignore")
        if kinds[process] == _INTERRUPTED:
            raise KeyboardInterrupt(f"process {process} was interrupted")
        raise RuntimeError(f"process {process} failed: {text}")
    if (asked != asked[0]).any():
        raise ValueError("the processes that share a table of similarities have asked it different things")


def _rows_of(found: LocalSimilarity, count: int) -> np.ndarray:
    """Bounds as an array of `count` rows, the last ones of which may mean nothing."""
    fields = {name: np.asarray(leaf) for name, leaf in dict(found).items()}
    rows = np.zeros(count, [(name, leaf.dtype) for name, leaf in fields.items()])
    for name, leaf in fields.items():
        rows[name][: len(leaf)] = leaf
    return rows


def _gather(array: np.ndarray) -> np.ndarray:
    """The arrays [N] of all processes, as [processes, N]; as bytes, which no setting of JAX's rounds."""
    data = np.zeros(2 ** int(np.ceil(np.log2(max(array.nbytes, 1)))), np.uint8)  # few sizes, few programs
    data[: array.nbytes] = np.frombuffer(array.tobytes(), np.uint8)
    everywhere = np.asarray(multihost_utils.process_allgather(data)).reshape(-1, len(data))
    return np.stack([np.frombuffer(own[: array.nbytes].tobytes(), array.dtype) for own in everywhere])
