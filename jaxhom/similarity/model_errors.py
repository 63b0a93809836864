"""The error of LP (9) between two small models as a differentiable function of both.

For pairs of states of one model `local_pairs` is the way. Here models are arrays.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from jaxhom import checks
from jaxhom.similarity.bounds_in_programs import differentiable_bounds, lanes_last, not_negative
from jaxhom.similarity.brackets import Goal, choose_method

if TYPE_CHECKING:
    from jaxtyping import Array, ArrayLike, Float

_MAX_ITERATIONS = 100_000  # then the error is NaN


def homomorphism_error(
    source: Float[ArrayLike, "n A n"],
    target: Float[ArrayLike, "m A m"],
    *,
    source_labels: Float[ArrayLike, "n A L"] | None = None,
    target_labels: Float[ArrayLike, "m A L"] | None = None,
    anchored: bool = True,
) -> Float[Array, ""]:
    """The optimal error e of LP (9) between two small models, as a differentiable function of both.

    Args:
      source: [n, A, n], transition tensor with the centre as state 0; rows sum to 1, or to 0 where an action leads
        nowhere.
      target: [m, A, m], likewise.
      source_labels: [n, A, L], what the map has to keep besides the transitions, as given: e also bounds
        |l(i,a) - sum_k f(i,k) l'(k,a)|. Labels in [0, 1] weigh like probabilities. None, or for both models.
      target_labels: [m, A, L], likewise.
      anchored: require that the centre is mapped to the centre; False is the program as printed.

    Returns:
      Scalar e, to 1e-6 in float64 (1e-4 in float32); NaN, derivatives included, where 100,000 iterations do not bring
      the bounds that close. Works under `jit`, `vmap`, `grad` and `jvp`.

    Raises:
      ValueError: if the shapes do not fit, a concrete row is no distribution and not zero, or on a second derivative.

    The derivative is the envelope theorem's, <y, (dT) f - f (dT')> at an optimal map f and an optimal dual y. Where
    either is not unique, e is only directionally differentiable and what is returned is the slope for the pair that
    the solver found; at e = 0 the dual y = 0 is optimal and the slope may be zero.

    Example:
      >>> import jax, jaxhom, numpy as np
      >>> swap = np.array([[[0.0, 1.0]], [[1.0, 0.0]]])  # two states that change places
      >>> stay = np.ones((1, 1, 1))
      >>> float(jaxhom.homomorphism_error(swap, stay)) < 1e-5  # both can be the one that stays
      True
      >>> round(float(jaxhom.homomorphism_error(stay, swap)), 3)
      1.0
      >>> jax.grad(jaxhom.homomorphism_error)(stay, swap).shape
      (1, 1, 1)

    Source: Boularias and Chaib-draa 2010, eq. (9).
    """
    source, target = checks.require_model_pair(source, target)
    anchored = checks.require_switch("anchored", anchored)
    if (source_labels is None) != (target_labels is None):
        raise ValueError("source_labels and target_labels must be given together")
    labels = () if source_labels is None else _checked_labels(source, target, source_labels, target_labels)
    dtype = jnp.promote_types(jnp.result_type(source, target, *labels), jnp.float32)
    models = jax.tree.map(lambda array: array.astype(dtype)[None], (source, target, labels))
    return _error(models, anchored)[0]


def _error(models, anchored: bool) -> jax.Array:
    """The middle of the bounds without their widening, which in float32 would be most of the gap; or NaN, [1]."""
    source, target, _ = models
    gap = 0.5 * (1e-6 if source.dtype == jnp.float64 else 1e-4)
    n, m = source.shape[1], target.shape[1]
    method = choose_method(n, m, source.dtype, Goal(2.0 * gap))
    goal = Goal(gap, method=method, max_iterations=_MAX_ITERATIONS)
    sizes = jnp.full(1, n, jnp.int32), jnp.full(1, m, jnp.int32)
    found = differentiable_bounds(models, sizes, goal, anchored, "homomorphism_error")
    for_lower, for_upper = lanes_last(models, sizes, anchored).rounding()
    error = 0.5 * (not_negative(found.lower + for_lower) + found.upper - for_upper)
    is_found = found.upper - found.lower <= gap + for_lower + for_upper
    return error * jnp.where(is_found, 1.0, jnp.nan).astype(error.dtype)


def _checked_labels(source, target, source_labels, target_labels) -> tuple[jax.Array, jax.Array]:
    source_labels, target_labels = jnp.asarray(source_labels), jnp.asarray(target_labels)
    expected = f"[{source.shape[0]}, {source.shape[1]}, L]"
    fits = source_labels.ndim == 3 and source_labels.shape[:2] == source.shape[:2]
    checks.require_shape("source_labels", source_labels, expected, fits)
    expected = (*target.shape[:2], source_labels.shape[2])
    checks.require_shape("target_labels", target_labels, str(expected), target_labels.shape == expected)
    return source_labels, target_labels
