"""Euclidean projections without sorting, over leading axes of batch-last arrays.

Each finds a threshold by Newton's method on a convex piecewise linear function, from the larger of two lower bounds
(all entries above the threshold; the largest entry alone), which is exact after a few steps. On XLA's CPU backend this is several times faster than the usual sort, if the steps stand in a loop of their
own: outside one, XLA fuses whatever produced the argument into every step and computes it again.
"""

import jax
import jax.numpy as jnp


def project_simplex(point: jax.Array, total: jax.Array | float = 1.0, *, axis: int = 0) -> jax.Array:
    """argmin_x |x - point|^2 subject to x >= 0, sum(x, axis) = total; `total` broadcasts against the sum."""
    count = point.shape[axis]
    mean_excess = (point.sum(axis=axis, keepdims=True) - total) / count
    threshold = jnp.maximum(mean_excess, point.max(axis=axis, keepdims=True) - total)

    def newton(_, threshold):
        above = point > threshold
        number = jnp.maximum(above.sum(axis=axis, keepdims=True), 1).astype(point.dtype)
        mass = jnp.where(above, point - threshold, 0.0).sum(axis=axis, keepdims=True)
        return threshold + (mass - total) / number

    threshold = jax.lax.fori_loop(0, _newton_steps(count), newton, threshold)
    return jnp.maximum(point - threshold, 0.0)


def project_l1_ball(point: jax.Array, *, axes: tuple[int, ...]) -> jax.Array:
    """argmin_y |y - point|^2 subject to sum(|y|, axes) <= 1."""
    size = jnp.abs(point)
    count = 1
    for axis in axes:
        count *= point.shape[axis]
    norm = size.sum(axis=axes, keepdims=True)
    threshold = jnp.maximum((norm - 1.0) / count, size.max(axis=axes, keepdims=True) - 1.0)
    threshold = jnp.maximum(threshold, 0.0)

    def newton(_, threshold):
        above = size > threshold
        number = jnp.maximum(above.sum(axis=axes, keepdims=True), 1).astype(point.dtype)
        mass = jnp.where(above, size - threshold, 0.0).sum(axis=axes, keepdims=True)
        return jnp.maximum(threshold + (mass - 1.0) / number, 0.0)

    threshold = jax.lax.fori_loop(0, _newton_steps(count), newton, threshold)
    return jnp.sign(point) * jnp.maximum(size - threshold, 0.0)


def _newton_steps(count: int) -> int:
    """Steps that reach rounding in practice; the exact worst case is `count`, what is left over is a short step."""
    return min(count, 4 + count.bit_length())
