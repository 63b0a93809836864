"""Sparse rows of transitions, one per state-action pair, as lists of successors: the one way from entries to a model.

Rows are those of a SciPy CSR array, s * A + a. They are never made dense: they become lists of successors, padded to
the longest. A model whose rows are all short is small; one row with successors everywhere makes all of them long.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy

from jaxhom import checks
from jaxhom.models.mdp import MDP
from jaxhom.models.padded_rows import rows_and_places


def checked_rows(matrix: Any, exists: np.ndarray, row_name: Callable[[int], str]) -> Any:
    """A copy with duplicates added up and no zeros, or a `ValueError` if a row that exists is no distribution.

    Args:
      matrix: SciPy CSR array.
      exists: bool, one per row; the others are emptied.
      row_name: what to call a row in messages.
    """
    if matrix.dtype.kind not in "iubf":
        raise ValueError(f"{row_name(0).split()[0]} must hold real numbers, got dtype {matrix.dtype}")
    keeps_type = matrix.dtype.kind == "f" and matrix.dtype.itemsize <= 8
    matrix = matrix.astype(matrix.dtype if keeps_type else np.float64, copy=True)
    matrix.data[~np.repeat(exists, np.diff(matrix.indptr))] = 0
    matrix.sum_duplicates()
    matrix.eliminate_zeros()
    for bad, message in ((~np.isfinite(matrix.data), "be finite"), (matrix.data < 0, "not be negative")):
        if np.any(bad):
            entry = int(np.flatnonzero(bad)[0])
            row = int(np.searchsorted(matrix.indptr, entry, side="right")) - 1
            column = matrix.indices[entry]
            raise ValueError(f"{row_name(row)}, column {column} must {message}, got {matrix.data[entry]}")
    total = row_sums(matrix)
    wrong = np.flatnonzero(exists & ~checks.sums_to_one(total, matrix.dtype))
    if wrong.size:
        raise ValueError(f"{row_name(int(wrong[0]))} must sum to 1, got {total[wrong[0]]}")
    return matrix


def row_sums(matrix: Any) -> np.ndarray:
    """float64, one per row."""
    return np.asarray(matrix.sum(axis=1, dtype=np.float64))


def rows_of_entries(
    pair: np.ndarray, next_state: np.ndarray, probability: np.ndarray, num_states: int, num_actions: int
) -> Any:
    """The CSR array of entries (s * A + a, z, p), which add up where they meet."""
    shape = (num_states * num_actions, num_states)
    return scipy.sparse.coo_array((probability, (pair, next_state)), shape=shape).tocsr()


def model_of_rows(rows: Any, num_actions: int, **options: Any) -> MDP:
    """A model from a CSR array with rows s * A + a; the options are those of `MDP.from_successors`."""
    num_states = rows.shape[1]
    lengths = np.diff(rows.indptr)
    width = max(1, int(lengths.max()))
    checks.require_slots(num_states, num_actions, width)
    pair, slot = rows_and_places(lengths)
    next_state = np.zeros((len(lengths), width), np.int64)
    probability = np.zeros((len(lengths), width), rows.dtype)
    next_state[pair, slot], probability[pair, slot] = rows.indices, rows.data
    shape = (num_states, num_actions, width)
    return MDP.from_successors(next_state.reshape(shape), probability.reshape(shape), **options)
