"""Pairs of classes a block at a time: an interruption loses the block that is under way and no other.

A block takes seconds, and more only where models are large. It is as large as it has to be for batches to be full,
and for programs to be compiled where they pay.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from jaxhom.similarity.brackets import Goal
from jaxhom.similarity.host_interior_point import seconds_on_host

if TYPE_CHECKING:
    from jaxtyping import Int

_SECONDS = 2.5  # that the host would take for a block: just enough for programs to pay (`programs.pays`)
_MOST, _LEAST = 2**14, 2**7  # pairs of a block
_UNDECIDED = 1 / 8  # most of the pairs that are to be decided need no iterations


def pair_blocks(
    pairs: Int[np.ndarray, "Q 2"], size: Int[np.ndarray, " C"], goal: Goal, num_shares: int = 1
) -> Iterator[Int[np.ndarray, "B 2"]]:
    """Pairs of classes in blocks, the small ones first; those that are padded to one size are side by side.

    Args:
      pairs: of classes.
      size: of the classes' models.
      goal: what they are to be settled for.
      num_shares: how many processes share a block out.
    """
    sizes = size[pairs].astype(float)
    padded = np.ceil(np.log2(sizes))
    order = np.lexsort([sizes.prod(axis=1), *padded.T, padded.max(axis=1)])
    seconds = seconds_on_host(*sizes[order].T)
    share = np.clip(seconds / _SECONDS, 1 / _MOST, 1 / _LEAST) * (_UNDECIDED if goal.decides else 1.0) / num_shares
    number = (np.cumsum(share) - share).astype(int)
    for index in np.split(order, np.flatnonzero(np.diff(number)) + 1):
        yield pairs[index]
