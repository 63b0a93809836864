"""Certified bounds on the errors of LP (9) inside programs: under jit, vmap, grad and jvp, for P pairs of small models.

By the envelope theorem the optimal error e changes with the models T, T' and their labels l, l' as

    <y, (dT) f - f (dT')> + <y_l, dl - f dl'>

does at an optimal map f and an optimal dual point y (`homomorphism_lp` has the notation). Both bounds carry this slope,
with the best points that were found; nothing of the iteration is differentiated.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom.similarity import interior_point
from jaxhom.similarity.brackets import NOISE, Goal, LocalSimilarity
from jaxhom.similarity.homomorphism_lp import HomomorphismProblem
from jaxhom.solvers import pdhg
from jaxhom.solvers.first_order import first_order_only
from jaxhom.solvers.lane_queue import run_lanes
from jaxhom.status import Status

_CHUNK_LANES = 32  # they fit into the cache, and wait for the slowest of the few


@functools.partial(jax.custom_jvp, nondiff_argnums=(2, 3, 4))
def differentiable_bounds(models, sizes, goal: Goal, anchored: bool, name: str) -> LocalSimilarity:
    """Bounds [P] on the optimal errors, as close as asked for where the dtype allows it.

    Args:
      models: [P, n, A, n], [P, m, A, m], and a tuple: empty, or the labels [P, n, A, L] and [P, m, A, L]. One dtype.
      sizes: int32 [P] and [P], how many of the n and m states are real.
      goal: what to settle for; its method is "pdhg" or "interior_point", which hands what it leaves open to PDHG.
      anchored: require that the centre is mapped to the centre.
      name: of the function that refuses second derivatives.

    Returns:
      `LocalSimilarity` [P] of JAX arrays, widened by the rounding, so that `lower` may be below 0. A pair that is not
      finite is STALLED, between infinities.
    """
    del name
    return _solve(models, sizes, goal, anchored)[0]


@differentiable_bounds.defjvp
def _(goal, anchored, name, primals, tangents):
    (models, sizes), ((source_dot, target_dot, labels_dot), _) = primals, tangents
    message = f"{name} has first derivatives only: the map and the dual point carry none"
    found, f, y = _solve(first_order_only(models, models, message), sizes, goal, anchored)
    m = f.shape[2]
    slope = jnp.einsum("piak,piaj,pjk->p", y[..., :m], source_dot, f)
    slope -= jnp.einsum("piak,pil,plak->p", y[..., :m], f, target_dot)
    if labels_dot:
        own_dot, other_dot = labels_dot
        slope += jnp.einsum("pial,pial->p", y[..., m:], own_dot)
        slope -= jnp.einsum("pial,pik,pkal->p", y[..., m:], f, other_dot)
    none = np.zeros(slope.shape, jax.dtypes.float0)
    return found, found.replace(lower=slope, upper=slope, iterations=none, status=none)


def not_negative(bound: jax.Array) -> jax.Array:
    """The bound, 0 where it is below; with the derivatives of the bound."""
    return bound + jax.lax.stop_gradient(jnp.maximum(bound, 0.0) - bound)


def lanes_last(models, sizes, anchored: bool) -> HomomorphismProblem:
    """The programs of P pairs of models, constants to differentiation."""
    source, target, labels = jax.tree.map(lambda leaf: jnp.moveaxis(jax.lax.stop_gradient(leaf), 0, -1), models)
    return HomomorphismProblem(
        source=source,
        target=target,
        source_size=sizes[0],
        target_size=sizes[1],
        anchored=anchored,
        **dict(zip(("source_labels", "target_labels"), labels, strict=False)),
    )


@functools.partial(jax.jit, static_argnums=(2, 3))
def _solve(models, sizes, goal: Goal, anchored: bool) -> tuple[LocalSimilarity, jax.Array, jax.Array]:
    """Bounds [P], f [P, n, m] and y [P, n, A, m + L]; under vmap all instances share one batch."""

    @jax.custom_batching.custom_vmap
    def solve_batch(problem):
        return _solve_in_chunks(problem, goal, anchored)

    @solve_batch.def_vmap
    def _merge_axes(axis_size, in_batched, problem):
        def with_axis(array, is_batched):
            return array if is_batched else jnp.broadcast_to(array, (axis_size, *array.shape))

        problem = jax.tree.map(with_axis, problem, in_batched[0])
        lanes = problem[0][0].shape[1]
        merged = solve_batch(jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), problem))
        split = jax.tree.map(lambda a: a.reshape(axis_size, lanes, *a.shape[1:]), merged)
        return split, jax.tree.map(lambda _: True, split)

    return solve_batch((models, sizes))


def _solve_in_chunks(problem, goal: Goal, anchored: bool):
    """`_solve_batch` a few instances at a time: they fit into the cache, and wait for the slowest of the few."""
    lanes = len(problem[0][0])
    if lanes <= _CHUNK_LANES:
        return _solve_batch(problem, goal, anchored)
    order = jnp.arange(-(-lanes // _CHUNK_LANES) * _CHUNK_LANES) % lanes  # the surplus repeats the first
    chunks = jax.tree.map(lambda array: array[order].reshape(-1, _CHUNK_LANES, *array.shape[1:]), problem)
    found = jax.lax.map(lambda chunk: _solve_batch(chunk, goal, anchored), chunks)
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[:lanes], found)


def _solve_batch(problem, goal: Goal, anchored: bool):
    problem = lanes_last(*problem, anchored)
    gap, limit = _within_reach(problem, goal)
    if goal.method == "interior_point":
        found = _by_interior_point(problem, goal, gap, limit)
    else:
        found = _by_pdhg(problem, goal, gap, limit)
    lower, upper, steps, f, y = found
    unsettled = jnp.where(steps < goal.max_iterations, Status.STALLED, Status.ITERATION_LIMIT)
    status = jnp.where(goal.is_met(jnp.maximum(lower, 0.0), upper), Status.SOLVED, unsettled).astype(jnp.int32)
    bounds: dict = {"lower": lower, "upper": upper, "iterations": steps, "status": status}
    return LocalSimilarity(**bounds), jnp.moveaxis(f, -1, 0), jnp.moveaxis(y, -1, 0)


def _within_reach(problem: HomomorphismProblem, goal: Goal):
    """The gap and the threshold to run to: where rounding takes up the tolerance, what leaves half of it beside that.

    No iteration comes closer than that, and bounds that it has brought there are as good as they get.
    """
    eps = jnp.finfo(problem.source.dtype).eps
    for_lower, for_upper = problem.rounding()
    gap = jnp.maximum(goal.tolerance, max(0.5 * goal.tolerance, NOISE * eps) + for_lower + for_upper)
    return gap, goal.threshold - jnp.where(gap > goal.tolerance, for_lower - NOISE * eps, 0.0)


def _by_pdhg(problem: HomomorphismProblem, goal: Goal, gap, limit, start=None):
    state, limits = pdhg.init(problem, start), {"threshold": limit, "max_iterations": goal.max_iterations}
    state, _ = run_lanes(pdhg.SOLVER, problem, state, tolerance=gap, **limits)
    return state.lower, state.upper, state.steps, state.best_primal, state.best_dual


def _by_interior_point(problem: HomomorphismProblem, goal: Goal, gap, limit):
    """The interior point's answers; PDHG finishes the lanes that it leaves open, all others staying as they are."""
    near = interior_point.solve(problem, tolerance=gap)
    found = near.lower, near.upper, near.steps, near.f, near.plus - near.minus
    is_found = near.upper - near.lower <= gap

    def finish():
        others = _by_pdhg(problem, goal, gap, limit, found[3:])
        return jax.tree.map(lambda one, other: jnp.where(is_found, one, other), found, others)

    return jax.lax.cond(is_found.all(), lambda: found, finish)
