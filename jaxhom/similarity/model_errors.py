"""The error of LP (9) between two small models as a differentiable function of both.

For pairs of states of one model, outside of programs, `local_pairs` and the `table` behind it are the way. Here models
are arrays, and everything is one program: it works under jit, vmap and grad.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from jaxhom import checks
from jaxhom.similarity import interior_point
from jaxhom.similarity.brackets import Goal, choose_method
from jaxhom.similarity.homomorphism_lp import HomomorphismProblem
from jaxhom.solvers import pdhg
from jaxhom.solvers.first_order import first_order_only

if TYPE_CHECKING:
    from jaxtyping import Array, ArrayLike, Float

_CHUNK_LANES = 32  # under vmap: they fit into the cache, and wait for the slowest of the few
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
      ValueError: if the shapes do not fit, or on a second derivative.

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
    source, target = jnp.asarray(source), jnp.asarray(target)
    checks.require_model_pair(source, target)
    if (source_labels is None) != (target_labels is None):
        raise ValueError("source_labels and target_labels must be given together")
    labels = () if source_labels is None else _checked_labels(source, target, source_labels, target_labels)
    dtype = jnp.promote_types(jnp.result_type(source, target, *labels), jnp.float32)
    models = jax.tree.map(lambda array: array.astype(dtype), (source, target, labels))
    return _error(models, anchored)


def _checked_labels(source, target, source_labels, target_labels) -> tuple[jax.Array, jax.Array]:
    source_labels, target_labels = jnp.asarray(source_labels), jnp.asarray(target_labels)
    expected = f"[{source.shape[0]}, {source.shape[1]}, L]"
    fits = source_labels.ndim == 3 and source_labels.shape[:2] == source.shape[:2]
    checks.require_shape("source_labels", source_labels, expected, fits)
    expected = (*target.shape[:2], source_labels.shape[2])
    checks.require_shape("target_labels", target_labels, str(expected), target_labels.shape == expected)
    return source_labels, target_labels


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def _error(models, anchored):
    return _optimal_pair(models, anchored)[0]


@_error.defjvp
def _(anchored, primals, tangents):
    (models,), ((source_dot, target_dot, labels_dot),) = primals, tangents
    message = "homomorphism_error has first derivatives only: the map and the dual point carry none"
    error, f, y = _optimal_pair(first_order_only(models, models, message), anchored)
    m = f.shape[1]
    change = jnp.einsum("iak,iaj,jk->", y[..., :m], source_dot, f)
    change -= jnp.einsum("iak,il,lak->", y[..., :m], f, target_dot)
    if labels_dot:
        own_dot, other_dot = labels_dot
        change += jnp.einsum("ial,ial->", y[..., m:], own_dot)
        change -= jnp.einsum("ial,ik,kal->", y[..., m:], f, other_dot)
    return error, change


@functools.partial(jax.jit, static_argnums=1)
def _optimal_pair(models, anchored) -> tuple[jax.Array, jax.Array, jax.Array]:
    """e, f [n, m] and y [n, A, m + L] of one instance; under vmap all instances share one batch."""

    @jax.custom_batching.custom_vmap
    def solve_batch(models):
        return _solve_in_chunks(models, anchored)

    @solve_batch.def_vmap
    def _merge_axes(axis_size, in_batched, models):
        def with_axis(array, is_batched):
            return array if is_batched else jnp.broadcast_to(array, (axis_size, *array.shape))

        models = jax.tree.map(with_axis, models, in_batched[0])
        lanes = models[0].shape[1]
        merged = solve_batch(jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), models))
        split = jax.tree.map(lambda a: a.reshape(axis_size, lanes, *a.shape[1:]), merged)
        return split, (True, True, True)

    return jax.tree.map(lambda leaf: leaf[0], solve_batch(jax.tree.map(lambda leaf: leaf[None], models)))


def _solve_in_chunks(models, anchored):
    """`_solve_batch` a few instances at a time: they fit into the cache, and wait for the slowest of the few."""
    lanes = len(models[0])
    if lanes <= _CHUNK_LANES:
        return _solve_batch(models, anchored)
    order = jnp.arange(-(-lanes // _CHUNK_LANES) * _CHUNK_LANES) % lanes  # the surplus repeats the first
    chunks = jax.tree.map(lambda array: array[order].reshape(-1, _CHUNK_LANES, *array.shape[1:]), models)
    found = jax.lax.map(lambda chunk: _solve_batch(chunk, anchored), chunks)
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[:lanes], found)


def _solve_batch(models, anchored):
    """[B, n, A, n], [B, m, A, m] and labels -> e [B], f [B, n, m], y [B, n, A, m + L]; NaN where it is not found."""
    source, target, labels = jax.tree.map(lambda leaf: jnp.moveaxis(jax.lax.stop_gradient(leaf), 0, -1), models)
    lanes = source.shape[-1]
    problem = HomomorphismProblem(
        source=source,
        target=target,
        source_size=jnp.full(lanes, len(source), jnp.int32),
        target_size=jnp.full(lanes, len(target), jnp.int32),
        anchored=anchored,
        **dict(zip(("source_labels", "target_labels"), labels, strict=False)),
    )
    for_lower, for_upper = problem.rounding()
    tolerance = 1e-6 if source.dtype == jnp.float64 else 1e-4
    # The bounds without their widening, which in float32 would be most of the gap.
    gap = 0.5 * tolerance + for_lower + for_upper

    def read(state, f, y):
        error = 0.5 * (jnp.maximum(state.lower + for_lower, 0.0) + state.upper - for_upper)
        found = (error, f, y)
        is_found = state.upper - state.lower <= gap
        return is_found, jax.tree.map(lambda leaf: jnp.where(is_found, leaf, jnp.nan), found)

    def by_pdhg(start=None):
        state = pdhg.solve(problem, pdhg.init(problem, start), tolerance=gap, max_iterations=_MAX_ITERATIONS)
        return read(state, state.best_primal, state.best_dual)[1]

    if choose_method(len(source), len(target), source.dtype, Goal(tolerance)) == "interior_point":
        near = interior_point.solve(problem, tolerance=gap)
        point = near.f, near.plus - near.minus
        is_found, found = read(near, *point)

        def finish():
            return jax.tree.map(lambda one, other: jnp.where(is_found, one, other), found, by_pdhg(point))

        error, f, y = jax.lax.cond(is_found.all(), lambda: found, finish)
    else:
        error, f, y = by_pdhg()
    return error, jnp.moveaxis(f, -1, 0), jnp.moveaxis(y, -1, 0)
