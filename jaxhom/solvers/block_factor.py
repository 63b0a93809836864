"""Cholesky factors of block tridiagonal matrices with a border, for a batch of matrices, inside a compiled program.

    N = [ T   C ]      T block tridiagonal, nb blocks of n: diagonal blocks D_i, blocks left of them E_i;
        [ C^T Q ],     C a dense border of q columns.

Lanes come first in every product, and a scan goes over the blocks: on a CPU and on a GPU alike the work is in batched
matrix products. Triangular factors are inverted block by block (`inverse_factor`), which turns the solves into products.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from jaxhom.solvers.inverse_factor import inverse_factor
from jaxhom.status import Record

if TYPE_CHECKING:
    from jaxtyping import Array, Float


class BlockFactor(Record):
    """L L^T = N. Block row i of L is (..., `left[i]`, inverse of `inverse[i]`), its last rows are the border's.

    Attributes:
      left: [nb, lanes, n, n], 0 in the first. inverse: [nb, lanes, n, n], lower triangular.
      border: [nb, lanes, n, q], L^-1 C. corner: [lanes, q, q], the inverse factor of Q - border^T border.
    """

    left: Float[Array, "nb lanes n n"]
    inverse: Float[Array, "nb lanes n n"]
    border: Float[Array, "nb lanes n q"]
    corner: Float[Array, "lanes q q"]


def factor_blocks(
    block: Callable[[Any], tuple[Array, Array | None, Array]], rows: Any, corner: Float[Array, "lanes q q"]
) -> BlockFactor:
    """Factorises N; NaN in the lanes whose matrix is not positive definite in floating point.

    Args:
      block: makes D_i [lanes, n, n], E_i [lanes, n, n] (None where there is one row; not used in the first) and C_i [lanes, n, q] of an entry of
        `rows`. Blocks are made when it is their turn: they are large, and used while they are at hand.
      rows: pytree with a leading axis [nb].
      corner: Q.
    """

    def eliminate(carry, row):
        inverse, half, corner = carry
        diagonal, left, border = block(row)
        left = jnp.zeros_like(diagonal) if left is None else left @ _transposed(inverse)
        inverse = jax.vmap(inverse_factor)(diagonal - left @ _transposed(left))
        half = inverse @ (border - left @ half)
        return (inverse, half, corner - _transposed(half) @ half), (left, inverse, half)

    diagonal, _, border = jax.eval_shape(block, jax.tree.map(lambda leaf: leaf[0], rows))
    nothing = jnp.zeros(diagonal.shape, corner.dtype), jnp.zeros(border.shape, corner.dtype)  # before the first row
    (_, _, corner), (left, inverse, border) = jax.lax.scan(eliminate, (*nothing, corner), rows)
    return BlockFactor(left=left, inverse=inverse, border=border, corner=jax.vmap(inverse_factor)(corner))


def solve_blocks(
    factor: BlockFactor, right: Float[Array, "lanes nb*n"], border_right: Float[Array, "lanes q"]
) -> tuple[Float[Array, "lanes nb*n"], Float[Array, "lanes q"]]:
    """N^-1 of right-hand sides."""
    count, lanes, size, _ = factor.left.shape
    parts = jnp.swapaxes(right.reshape(lanes, count, size), 0, 1)

    def forwards(before, block):
        left, inverse, part = block
        half = _times(inverse, part - _times(left, before))
        return half, half

    def backwards(known, block):
        left, inverse, part = block
        found = _transposed_times(inverse, part - known)
        return _transposed_times(left, found), found

    nothing = jnp.zeros_like(parts[0])
    _, half = jax.lax.scan(forwards, nothing, (factor.left, factor.inverse, parts))
    on_border = border_right - jnp.einsum("blnq,bln->lq", factor.border, half)
    on_border = _transposed_times(factor.corner, _times(factor.corner, on_border))
    half = half - jnp.einsum("blnq,lq->bln", factor.border, on_border)
    _, found = jax.lax.scan(backwards, nothing, (factor.left, factor.inverse, half), reverse=True)
    return jnp.swapaxes(found, 0, 1).reshape(lanes, count * size), on_border


def _transposed(matrix):
    return jnp.swapaxes(matrix, -1, -2)


def _times(matrix, vector):
    return (matrix @ vector[..., None])[..., 0]


def _transposed_times(matrix, vector):
    return (vector[..., None, :] @ matrix)[..., 0, :]
