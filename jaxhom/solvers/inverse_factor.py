"""The inverse of a Cholesky factor, out of matrix products alone.

For batches (`vmap`) of systems of some hundred unknowns on a CPU, where the batched factorisation of `jax.numpy.linalg`
hands one matrix at a time to LAPACK: its threads and those of XLA get into each other's way (30 ms instead of 0.2 for
169 unknowns were measured), and two such programs at a time can wait for each other for ever.
"""

import jax
import jax.numpy as jnp

_MIN_LEAF = 10  # cutting smaller blocks makes more programs than it saves products


def inverse_factor(matrix: jax.Array, leaf: int | None = None) -> jax.Array:
    """W = L^-1 with N = L L^T, so that N^-1 = W^T W.

    Args:
      matrix: N [D, D], symmetric positive definite.
      leaf: sizes up to this one (by default a twelfth, 10 at least) are eliminated column by column; larger ones are
        cut in two:

            [ N11  N21^T ]    L21 = N21 W11^T,         W = [ W11             0   ]
            [ N21  N22   ],   S = N22 - L21 L21^T,         [ -W22 L21 W11    W22 ].

    Returns:
      W [D, D], lower triangular; NaN where the matrix is not positive definite.
    """
    size = len(matrix)
    if not size:
        return matrix
    leaf = leaf or max(_MIN_LEAF, -(-size // 12))
    if size <= leaf:
        return _eliminate(matrix)
    half = leaf * -(-size // (2 * leaf))
    first = inverse_factor(matrix[:half, :half], leaf)
    below = matrix[half:, :half] @ first.T
    last = inverse_factor(matrix[half:, half:] - below @ below.T, leaf)
    corner = -last @ (below @ first)
    return jnp.block([[first, jnp.zeros((half, size - half), matrix.dtype)], [corner, last]])


def _eliminate(matrix: jax.Array) -> jax.Array:
    """Gaussian elimination of a small matrix, beside the identity."""
    index = jnp.arange(len(matrix))[:, None]

    def column(k, carry):
        rest, inverse = carry
        scale = jax.lax.rsqrt(rest[k, k])
        row, inverse_row = rest[k] * scale, inverse[k] * scale
        below = jnp.where(index > k, row[:, None], 0.0)  # column k of L
        return rest - below * row, jnp.where(index == k, inverse_row, inverse - below * inverse_row)

    identity = jnp.eye(len(matrix), dtype=matrix.dtype)
    return jax.lax.fori_loop(0, len(matrix), column, (matrix, identity))[1]
