"""The normal matrices of the host's interior points for LP (9), lanes first, and the inverses of their factors.

Products of stacked matrices throughout: these leave Python's lock to other threads, so that batches run side by side.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float

_REGULARISATIONS = (0.0, 1e-14, 1e-12, 1e-10, 1e-8)  # shares of the diagonal, to be tried in turn
_SMALL_TRIANGLE = 16  # rows


def inverse_factors(normal: Float[np.ndarray, "P D D"]) -> Float[np.ndarray, "P D D"]:
    """W with N^-1 = W^T W; NaN where a matrix is not positive definite in float64, nearly singular as it may be.

    Each is scaled to the diagonal 1 first: as the products y s vanish, its entries spread over many orders.
    """
    index = np.arange(normal.shape[1])
    scale = 1.0 / np.sqrt(normal[:, index, index])
    scaled = normal * scale[:, :, None]
    scaled *= scale[:, None]
    for share in _REGULARISATIONS:
        scaled[:, index, index] = 1.0 + share
        try:
            inverse = _inverse_triangles(np.linalg.cholesky(scaled))
            inverse *= scale[:, None]
            return inverse
        except np.linalg.LinAlgError:
            continue
    if len(normal) == 1:
        return np.full_like(normal, np.nan)
    return np.concatenate([inverse_factors(one[None]) for one in normal])


def _inverse_triangles(lower: Float[np.ndarray, "P D D"]) -> Float[np.ndarray, "P D D"]:
    """The inverses of lower triangular matrices, by halves."""
    size = lower.shape[1]
    if size <= _SMALL_TRIANGLE:
        return np.linalg.inv(lower)
    half = size // 2
    inverse = np.zeros_like(lower)
    inverse[:, :half, :half] = first = _inverse_triangles(lower[:, :half, :half])
    inverse[:, half:, half:] = second = _inverse_triangles(lower[:, half:, half:])
    inverse[:, half:, :half] = -second @ (lower[:, half:, :half] @ first)
    return inverse


def normal_matrices(source, target, weight, first: int, source_labels=None, target_labels=None) -> np.ndarray:
    """As `newton.normal_matrix`, of P programs: K^T diag(weight) K over the rows of f from `first` on."""
    lanes, m, num_actions = target.shape[:3]
    into, own = source[:, :, :, first:], weight[:, first:]
    n, pairs, width = into.shape[3], source.shape[1] * num_actions, num_actions * m
    # sum_ia w(i,a,k) T(i,a,j) T(i,a,p), for each column k: [k, j, p].
    flat = into.reshape(lanes, pairs, n)
    scaled = weight[..., :m].reshape(lanes, pairs, m).transpose(0, 2, 1)[:, :, None] * flat.transpose(0, 2, 1)[:, None]
    same_column = scaled @ flat[:, None]
    # sum_ak w(j,a,k) T'(l,a,k) T'(q,a,k), for each row j: [j, l, q].
    flat = target.reshape(lanes, 1, m, width)
    same_row = (own[..., :m].reshape(lanes, n, 1, width) * flat) @ flat.transpose(0, 1, 3, 2)
    if source_labels is not None:
        width = num_actions * source_labels.shape[3]
        apart = (source_labels[:, first:, None] - target_labels[:, None]).reshape(lanes, n, m, width)
        same_row += (own[..., m:].reshape(lanes, n, 1, width) * apart) @ apart.transpose(0, 1, 3, 2)
    # Row (p, a, k) of K meets f(j, k) with T(p,a,j) and f(p, q) with -T'(q,a,k): [k, p, j, q].
    scaled = own[..., :m].transpose(0, 3, 1, 2)[:, :, :, None] * into[:, first:].transpose(0, 1, 3, 2)[:, None]
    cross = scaled.reshape(lanes, m, n * n, num_actions) @ target.transpose(0, 3, 2, 1)
    cross = cross.reshape(lanes, m, n, n, m).transpose(0, 3, 1, 2, 4)  # [j, k, p, q]
    matrix = np.empty(cross.shape)
    np.add(cross, cross.transpose(0, 3, 4, 1, 2), out=matrix)
    np.negative(matrix, out=matrix)
    k, j = np.arange(m), np.arange(n)
    matrix[:, :, k, :, k] += same_column.transpose(1, 0, 2, 3)
    matrix[:, j, :, j] += same_row.transpose(1, 0, 2, 3)
    return matrix.reshape(lanes, n * m, n * m)
