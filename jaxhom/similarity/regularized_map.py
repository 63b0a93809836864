"""A differentiable soft homomorphism: the map of a regularised LP (9), and its derivatives.

The map f of LP (9) need not be unique, so it has no derivative. With a quadratic term on either side of the
saddle point,

    min_f max_{|y|_1 <= 1}  <y, K f> + rho / 2 |f|^2 - rho / 2 |y|^2,

f in the maps of the program, both points are unique, and Lipschitz in the models. The regularised f makes an error
at most rho / 2 (n + 1) larger than the optimum. The solution is the fixed point of the PDHG operator with
proximal steps; its derivative is implicit, one linear system of the fixed point's equation (jaxopt's
`custom_fixed_point`), whatever the number of iterations. On the boundary between two faces of the constraints, where f
is not differentiable, one of the one-sided derivatives comes back.

jaxopt is no longer maintained; this is the one module that uses it, and loads it when a map is asked for.
"""

from __future__ import annotations

import functools
import warnings
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from jaxhom import checks
from jaxhom.similarity.homomorphism_lp import HomomorphismProblem
from jaxhom.solvers import pdhg

if TYPE_CHECKING:
    from jaxtyping import Array, ArrayLike, Float

_MAX_ITERATIONS = 100_000  # some 1 / regularization are usual


def homomorphism_map(
    source: Float[ArrayLike, "n A n"],
    target: Float[ArrayLike, "m A m"],
    *,
    regularization: float = 1e-2,
    anchored: bool = True,
) -> Float[Array, "n m"]:
    """The map f of the regularised program, as a differentiable function of both models.

    Args:
      source: [n, A, n], transition tensor with the centre as state 0; rows sum to 1.
      target: [m, A, m], likewise.
      regularization: rho > 0. Smaller values are nearer to LP (9) and take longer, about 1 / rho iterations.
      anchored: require that the centre is mapped to the centre.

    Returns:
      f [n, m], rows sum to 1; NaN where 100,000 iterations do not find it. Works under `jit`, `vmap` and `grad` of the
      two models; the options must be concrete.

    Raises:
      ValueError: if the shapes do not fit, or `regularization` is traced or not positive.

    Example:
      >>> import jaxhom, numpy as np
      >>> swap = np.array([[[0.0, 1.0]], [[1.0, 0.0]]])  # two states that change places
      >>> jaxhom.homomorphism_map(swap, swap).round(2).tolist()
      [[1.0, 0.0], [0.0, 1.0]]

    Source: Boularias and Chaib-draa 2010, eq. (9), regularised.
    """
    source, target = checks.require_model_pair(source, target)
    checks.refuse_traced(regularization=regularization, anchored=anchored)
    regularization = checks.require_number("regularization", regularization)
    if not regularization > 0:
        raise ValueError(f"regularization must be positive, got {regularization}")
    dtype = jnp.promote_types(jnp.result_type(source, target), jnp.float32)
    return _map(source.astype(dtype), target.astype(dtype), regularization, checks.require_switch("anchored", anchored))


@functools.partial(jax.jit, static_argnums=(2, 3))
def _map(source, target, regularization, anchored):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        from jaxopt import implicit_diff, linear_solve
    n, num_actions, _ = source.shape
    m = target.shape[0]
    size = n * m
    problem = _problem(jax.lax.stop_gradient(source), jax.lax.stop_gradient(target), anchored)
    step = pdhg.init(problem).eta[0]  # just below 1 / |K|; the fixed point does not depend on it
    eps = jnp.finfo(source.dtype).eps

    def operator(z, parameters):
        """PDHG with proximal steps on z, f and y stacked."""
        *models, step = parameters
        shrink = 1.0 / (1.0 + step * regularization)
        problem = _problem(*models, anchored)
        f, y = z[:size].reshape(n, m, 1), z[size:].reshape(n, num_actions, m, 1)
        moved = problem.project_primal(shrink * (f - step * problem.adjoint(y)), None)
        climbed = problem.project_dual(shrink * (y + step * problem.forward(2.0 * moved - f)), None)
        return jnp.concatenate([moved.ravel(), climbed.ravel()])

    @implicit_diff.custom_fixed_point(operator, solve=linear_solve.solve_lu)
    def solve(z, parameters):
        step = parameters[-1]
        contraction = step * regularization  # the distance that is left is about the last change divided by this
        tolerance = eps * jnp.maximum(32.0 * contraction, 0.125)

        def keep_going(state):
            _, change, count = state
            return (change > tolerance) & (count < _MAX_ITERATIONS)

        def advance(state):
            z, _, count = state
            moved = operator(z, parameters)
            return moved, jnp.abs(moved - z).max(), count + 1

        z, change, _ = jax.lax.while_loop(keep_going, advance, (z, jnp.full_like(step, jnp.inf), 0))
        return jnp.where(change <= jnp.maximum(tolerance, eps**0.5 * contraction), z, jnp.nan)

    f, y = problem.start()
    found = solve(jnp.concatenate([f.ravel(), y.ravel()]), (source, target, step))
    return found[:size].reshape(n, m)


def _problem(source, target, anchored) -> HomomorphismProblem:
    return HomomorphismProblem(
        source=source[..., None],
        target=target[..., None],
        source_size=jnp.full(1, source.shape[0], jnp.int32),
        target_size=jnp.full(1, target.shape[0], jnp.int32),
        anchored=anchored,
    )
