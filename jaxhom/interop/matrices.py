"""Models from matrices: the layout of the MDP toolboxes, and SciPy's sparse matrices.

MDP toolboxes (Python, R, MATLAB) keep transitions action first, one S x S matrix per action. Sparse matrices are never
made dense: their rows become lists of successors, padded to the longest. A model whose rows are all short is small; one
row with successors everywhere makes all of them long.

Rewards of a toolbox: [S] and [S, A] are what `optimal_policy` and `policy_value` take; [A, S, S], a reward per
transition, becomes [S, A] by `numpy.einsum("asz,asz->sa", transitions, reward)`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, TypeGuard

import numpy as np
import scipy

from jaxhom import checks
from jaxhom.models.mdp import MDP

if TYPE_CHECKING:
    from jaxtyping import ArrayLike, Bool, Float


def from_mdptoolbox(
    transitions: Float[ArrayLike, "A S S"] | Sequence[Any],
    *,
    discount: Float[ArrayLike, ""],
    initial: Float[ArrayLike, "S"] | None = None,
    features: Float[ArrayLike, "S *A K"] | None = None,
    allowed: Bool[ArrayLike, "S A"] | None = None,
) -> MDP:
    """Builds a model from transitions in the layout of the MDP toolboxes.

    Args:
      transitions: [A, S, S], transitions[a, s, z] = T(s, a, z); or a sequence (list, tuple, object array) of A
        matrices [S, S], SciPy sparse ones or arrays.
      discount: scalar, strictly between 0 and 1.
      initial: [S] distribution of the first state; uniform if None.
      features: [S, A, K] or [S, K]; no features (K = 0) if None.
      allowed: bool [S, A], the actions that exist; rows of the others are not looked at. All if None.

    Returns:
      The model, in the dtype of `transitions`.

    Raises:
      ValueError: on a wrong shape, naming action, state and next state of the first entry that is not finite or
        negative, or action and state of the first row that does not sum to 1; and as `MDP.from_successors`.

    Outside jit, vmap and grad only: what is read is checked on the host.

    Example:
      >>> stay, change = [[1.0, 0.0], [0.0, 1.0]], [[0.0, 1.0], [1.0, 0.0]]
      >>> mdp = from_mdptoolbox([stay, change], discount=0.9)
      >>> mdp.transition[0].tolist()  # of state 0, one row per action
      [[1.0, 0.0], [0.0, 1.0]]
    """
    if scipy.sparse.issparse(transitions):
        raise ValueError(
            "transitions must be [A, S, S] or a sequence of A matrices; one sparse matrix is for from_scipy"
        )
    matrices = list(transitions) if _is_sequence(transitions) else None
    if matrices is not None and any(scipy.sparse.issparse(matrix) for matrix in matrices):
        return _from_sparse(matrices, discount, initial, features, allowed)
    array = checks.as_host_array("transitions", transitions if matrices is None else matrices)
    good = array.ndim == 3 and array.shape[1] == array.shape[2] and min(array.shape) > 0
    checks.require_shape("transitions", array, "[A, S, S] with A, S >= 1", good)
    rows = None if allowed is None else _flags(allowed, array.shape[1], len(array))
    array = checks.require_distribution("transitions", array, None if rows is None else rows.T)
    dense = np.moveaxis(array, 0, 1)
    return MDP.from_dense(dense, discount=discount, initial=initial, features=features, allowed=rows)


def _is_sequence(transitions) -> TypeGuard[Sequence[Any]]:
    """Whether something is a sequence of matrices rather than one array."""
    is_object_array = isinstance(transitions, np.ndarray) and transitions.dtype.hasobject and transitions.ndim == 1
    return isinstance(transitions, list | tuple) or is_object_array


def _flags(allowed, num_states: int, num_actions: int) -> np.ndarray:
    """Which actions exist, bool [S, A], or raises."""
    allowed = checks.as_host_array("allowed", allowed)
    checks.require_shape(
        "allowed", allowed, f"({num_states}, {num_actions})", allowed.shape == (num_states, num_actions)
    )
    if allowed.dtype != bool:
        raise ValueError(f"allowed must be bool, got dtype {allowed.dtype}")
    return allowed


def _from_sparse(matrices: list, discount, initial, features, allowed) -> MDP:
    num_states, num_actions = max(np.shape(matrices[0]), default=0), len(matrices)
    for a, matrix in enumerate(matrices):
        expected = f"({num_states}, {num_states}) with at least one state"
        good = np.shape(matrix) == (num_states, num_states) and num_states > 0
        checks.require_shape(f"transitions[{a}]", matrix, expected, good)
    stacked = scipy.sparse.vstack([scipy.sparse.csr_array(matrix) for matrix in matrices], format="csr")
    allowed = None if allowed is None else _flags(allowed, num_states, num_actions)
    exists = np.ones(len(matrices) * num_states, bool) if allowed is None else allowed.T.ravel()
    rows = _checked_rows(stacked, exists, lambda row: f"transitions[{row // num_states}] row {row % num_states}")
    order = np.arange(num_actions * num_states).reshape(num_actions, num_states).T.ravel()
    return _from_rows(rows[order], num_actions, discount, initial, features, allowed)


def from_scipy(
    matrix: scipy.sparse.sparray | scipy.sparse.spmatrix,
    *,
    discount: Float[ArrayLike, ""],
    initial: Float[ArrayLike, "S"] | None = None,
    features: Float[ArrayLike, "S *A K"] | None = None,
    allowed: Bool[ArrayLike, "S A"] | None = None,
) -> MDP:
    """Builds a model from one sparse matrix with a row per state-action pair.

    Args:
      matrix: SciPy sparse, (S * A) x S; row s * A + a holds T(s, a, .): the actions of state 0 first, then those of
        state 1. A is the number of rows divided by S.
      discount: scalar, strictly between 0 and 1.
      initial: [S] distribution of the first state; uniform if None.
      features: [S, A, K] or [S, K]; no features (K = 0) if None.
      allowed: bool [S, A], the actions that exist; rows of the others are not looked at. All if None.

    Returns:
      The model, in the dtype of `matrix`.

    Raises:
      ValueError: on a matrix that is not sparse or has another shape, naming row and column of the first entry that is
        not finite or negative, or the first row that does not sum to 1; and as `MDP.from_successors`.

    Outside jit, vmap and grad only: what is read is checked on the host.

    Example:
      >>> rows = scipy.sparse.csr_array([[1.0, 0.0], [0.0, 1.0], [0.5, 0.5], [0.0, 1.0]])
      >>> mdp = from_scipy(rows, discount=0.9)
      >>> mdp.num_states, mdp.num_actions
      (2, 2)
    """
    if not scipy.sparse.issparse(matrix):
        raise ValueError(f"matrix must be a SciPy sparse matrix, got {type(matrix).__name__}")
    good = matrix.ndim == 2 and min(matrix.shape) > 0 and matrix.shape[0] % matrix.shape[1] == 0
    checks.require_shape("matrix", matrix, "(S * A, S) with S, A >= 1", good)
    num_actions = matrix.shape[0] // matrix.shape[1]

    def row_name(row):
        return f"matrix row {row} (state {row // num_actions}, action {row % num_actions})"

    allowed = None if allowed is None else _flags(allowed, matrix.shape[1], num_actions)
    exists = np.ones(matrix.shape[0], bool) if allowed is None else allowed.ravel()
    rows = _checked_rows(scipy.sparse.csr_array(matrix), exists, row_name)
    return _from_rows(rows, num_actions, discount, initial, features, allowed)


def _checked_rows(matrix, exists: np.ndarray, row_name: Callable[[int], str]):
    """A copy with duplicates added up and no zeros, or a `ValueError` if a row that exists is no distribution."""
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
    total = np.asarray(matrix.sum(axis=1, dtype=np.float64))
    wrong = np.flatnonzero(exists & ~checks.sums_to_one(total, matrix.dtype))
    if wrong.size:
        raise ValueError(f"{row_name(int(wrong[0]))} must sum to 1, got {total[wrong[0]]}")
    return matrix


def _from_rows(rows, num_actions: int, discount, initial, features, allowed) -> MDP:
    """A model from a CSR array with rows s * A + a."""
    num_states = rows.shape[1]
    lengths = np.diff(rows.indptr)
    width = max(1, int(lengths.max()))
    checks.require_slots(num_states, num_actions, width)
    pair = np.repeat(np.arange(len(lengths)), lengths)
    slot = np.arange(rows.nnz) - np.repeat(rows.indptr[:-1], lengths)
    next_state = np.zeros((len(lengths), width), np.int64)
    probability = np.zeros((len(lengths), width), rows.dtype)
    next_state[pair, slot], probability[pair, slot] = rows.indices, rows.data
    shape = (num_states, num_actions, width)
    return MDP.from_successors(
        next_state.reshape(shape),
        probability.reshape(shape),
        discount=discount,
        initial=initial,
        features=features,
        allowed=allowed,
    )
