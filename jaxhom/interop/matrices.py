"""Models from matrices: the layout of the MDP toolboxes, and SciPy's sparse matrices.

MDP toolboxes (Python, R, MATLAB) keep transitions action first, one S x S matrix per action. Sparse matrices are never
made dense (see `successor_rows`).

Rewards of a toolbox: [S] and [S, A] are what `optimal_policy` and `policy_value` take; [A, S, S], a reward per
transition, becomes [S, A] by `numpy.einsum("asz,asz->sa", transitions, reward)`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TypeGuard

import numpy as np
import scipy

from jaxhom import checks
from jaxhom.interop.successor_rows import checked_rows, model_of_rows
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
    rows = checked_rows(stacked, exists, lambda row: f"transitions[{row // num_states}] row {row % num_states}")
    order = np.arange(num_actions * num_states).reshape(num_actions, num_states).T.ravel()
    options = {"initial": initial, "features": features, "allowed": allowed}
    return model_of_rows(rows[order], num_actions, discount=discount, **options)


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
    rows = checked_rows(scipy.sparse.csr_array(matrix), exists, row_name)
    options = {"initial": initial, "features": features, "allowed": allowed}
    return model_of_rows(rows, num_actions, discount=discount, **options)
