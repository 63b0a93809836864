"""The inverse of a Cholesky factor, out of matrix products alone.

For batches (`vmap`) of systems of some hundred unknowns on a CPU, where the batched factorisation of `jax.numpy.linalg`
hands one matrix at a time to LAPACK: its threads and those of XLA get into each other's way (30 ms instead of 0.2 for
169 unknowns were measured), and two such programs at a time can wait for each other for ever.
"""

import jax
import jax.numpy as jnp

_PANEL = 16  # columns at a time, in loops: 96 x 96 of grid48 takes 0.15 ms, and two seconds to compile
_MOST_IN_LOOPS = 64  # larger matrices are cut in two: loops do three times the products
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


def inverse_factor_in_loops(matrix: jax.Array) -> jax.Array:
    """W = L^-1 of each matrix [L, D, D] as `inverse_factor`, in a third of its programs: for other programs' loops."""
    lanes, size = len(matrix), matrix.shape[-1]
    if size > _MOST_IN_LOOPS:
        half = _PANEL * -(-size // (2 * _PANEL))
        first = inverse_factor_in_loops(matrix[:, :half, :half])
        below = matrix[:, half:, :half] @ first.mT
        last = inverse_factor_in_loops(matrix[:, half:, half:] - below @ below.mT)
        corner = -last @ (below @ first)
        nothing = jnp.zeros((lanes, half, size - half), matrix.dtype)
        return jnp.concatenate([jnp.concatenate([first, nothing], -1), jnp.concatenate([corner, last], -1)], -2)
    filling = -size % _PANEL
    if filling:
        matrix = jnp.pad(matrix, ((0, 0), (0, filling), (0, filling))) + jnp.diag(
            (jnp.arange(size + filling) >= size).astype(matrix.dtype)
        )
    return _eliminate_panels(matrix)[:, :size, :size]


def _eliminate_panels(matrix: jax.Array) -> jax.Array:
    """Some columns at a time, beside the identity; the size is a multiple of theirs."""
    lanes, size = len(matrix), matrix.shape[-1]
    index = jnp.arange(size)

    def panel(k, rest):
        first = k * _PANEL
        rows = jax.lax.dynamic_slice(rest, (0, first, 0), (lanes, _PANEL, 2 * size))
        corner = jax.lax.dynamic_slice(rows, (0, 0, first), (lanes, _PANEL, _PANEL))
        rows = jax.vmap(_eliminate)(corner) @ rows
        below = jnp.where(index >= first + _PANEL, rows[..., :size], 0.0)
        return jax.lax.dynamic_update_slice(rest - below.mT @ rows, rows, (0, first, 0))

    identity = jnp.broadcast_to(jnp.eye(size, dtype=matrix.dtype), matrix.shape)
    return jax.lax.fori_loop(0, size // _PANEL, panel, jnp.concatenate([matrix, identity], axis=-1))[..., size:]


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
