"""Soft homomorphisms between small models as saddle-point problems, lanes last.

LP (9) of Boularias and Chaib-draa 2010 minimises a max-norm over row-stochastic maps f [n, m] from a source model
T [n, A, n] to a target model T' [m, A, m],

    e = min_f max_{i,a,k} |(K f)(i,a,k)|,   (K f)(i,a,k) = sum_j T(i,a,j) f(j,k) - sum_l f(i,l) T'(l,a,k),

which is min over f of the max over |y|_1 <= 1 of <y, K f>. Any f gives the upper bound |K f|_inf, any y the lower
bound sum_i min_k (K^T y)(i,k). In the anchored problem f(0,0) = 1: the centre goes to the centre, and row 0
contributes (K^T y)(0,0) alone.

The products are written out over j and l while models are small, so that XLA fuses each into one pass over the
lanes; `plain_forward` and `plain_adjoint` say the same with einsum, for one instance, and hold them to it in tests.
"""

import dataclasses

import jax
import jax.numpy as jnp

from jaxhom.pdhg.projections import project_l1_ball, project_simplex

_MAX_UNROLL = 32


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class HomomorphismProblem:
    """A batch of LPs (9).

    Attributes:
      source: [n, A, n, lanes], centre first, padding zero.
      target: [m, A, m, lanes], likewise.
      source_size, target_size: int32 [lanes], how many of the n and m states are real.
      anchored: whether f(0, 0) = 1 is required.
    """

    source: jax.Array
    target: jax.Array
    source_size: jax.Array
    target_size: jax.Array
    anchored: bool = dataclasses.field(metadata={"static": True})

    def start(self) -> tuple[jax.Array, jax.Array]:
        """Rows uniform over the target (the centre on the centre, if anchored), and y = 0."""
        n, num_actions, _, lanes = self.source.shape
        m = self.target.shape[0]
        zeros = jnp.zeros((n, m, lanes), self.source.dtype)
        dual = jnp.zeros((n, num_actions, m, lanes), self.source.dtype)
        return self.project_primal(zeros, None), dual

    def forward(self, f: jax.Array) -> jax.Array:
        """K f, [n, m, lanes] -> [n, A, m, lanes]."""
        source, target = self.source, self.target
        n, m = f.shape[:2]
        if n + m > _MAX_UNROLL:
            moved = jnp.einsum("biaj,bjk->iakb", _lanes_first(source), _lanes_first(f))
            return moved - jnp.einsum("bil,blak->iakb", _lanes_first(f), _lanes_first(target))
        total = sum(source[:, :, j, None] * f[j] for j in range(n))
        return total - sum(f[:, None, None, k] * target[k] for k in range(m))

    def adjoint(self, y: jax.Array) -> jax.Array:
        """K^T y, [n, A, m, lanes] -> [n, m, lanes]."""
        source, target = self.source, self.target
        n, num_actions, m = y.shape[:3]
        if n + m > _MAX_UNROLL:
            moved = jnp.einsum("biaj,biak->jkb", _lanes_first(source), _lanes_first(y))
            return moved - jnp.einsum("blak,biak->ilb", _lanes_first(target), _lanes_first(y))
        pairs = [(i, a) for i in range(n) for a in range(num_actions)]
        total = sum(source[i, a, :, None] * y[i, a] for i, a in pairs)
        pairs = [(a, k) for a in range(num_actions) for k in range(m)]
        return total - sum(target[:, a, k] * y[:, a, k, None] for a, k in pairs)

    def project_primal(self, point: jax.Array, step) -> jax.Array:
        """Onto the maps: real rows on the simplex over real columns, the rest zero."""
        del step
        rows, columns = self.masks(point.shape)
        masked = jnp.where(columns, point, -1e30)  # below any threshold
        f = jnp.where(rows & columns, project_simplex(masked, axis=1), 0.0)
        if not self.anchored:
            return f
        centre = jnp.zeros(point.shape[1], point.dtype).at[0].set(1.0)
        return f.at[0].set(jnp.broadcast_to(centre[:, None], f.shape[1:]))

    def project_dual(self, point: jax.Array, step) -> jax.Array:
        """Onto the ball |y|_1 <= 1. Padding has no gradient, so it stays zero."""
        del step
        return project_l1_ball(point, axes=(0, 1, 2))

    def bounds(self, f, y, forward, adjoint) -> tuple[jax.Array, jax.Array]:
        """Certified bounds, widened by the rounding of the sums that make them."""
        n, num_actions, m, _ = forward.shape
        eps = jnp.finfo(forward.dtype).eps
        rows, columns = self.masks(f.shape)
        row_sum = f.sum(axis=1)
        defect = jnp.abs(row_sum - 1.0)
        defect = jnp.where(rows[:, 0], defect, 0.0).max(axis=0)
        upper = jnp.abs(forward).max(axis=(0, 1, 2)) + 2.0 * defect + (n + m + 2) * eps
        lowest = jnp.where(columns, adjoint, jnp.inf).min(axis=1)
        if self.anchored:
            lowest = lowest.at[0].set(adjoint[0, 0])
        value = jnp.where(rows[:, 0], lowest, 0.0).sum(axis=0)
        size = jnp.abs(y).sum(axis=(0, 1, 2))
        value = value / jnp.maximum(size, 1.0)  # the bound is homogeneous in y
        lower = jnp.maximum(value - (n + 2) * (num_actions * (n + m) + 4) * eps, 0.0)
        return lower, upper

    def norm_bound(self) -> jax.Array:
        """sqrt(|K|_1 |K|_inf), from the row and column sums of |T| and |T'|."""
        into_source = self.source.sum(axis=(0, 1)).max(axis=0)
        into_target = self.target.sum(axis=0).max(axis=(0, 1))
        num_actions = self.source.shape[1]
        return jnp.sqrt((into_source + num_actions) * (1.0 + into_target))

    def masks(self, shape) -> tuple[jax.Array, jax.Array]:
        """Which rows [n, 1, lanes] and columns [1, m, lanes] of f are real."""
        rows = jnp.arange(shape[0])[:, None, None] < self.source_size
        columns = jnp.arange(shape[1])[None, :, None] < self.target_size
        return rows, columns


def _lanes_first(array: jax.Array) -> jax.Array:
    return jnp.moveaxis(array, -1, 0)


def plain_forward(source: jax.Array, target: jax.Array, f: jax.Array) -> jax.Array:
    """K f of one instance: [n, A, n], [m, A, m], [n, m] -> [n, A, m]."""
    return jnp.einsum("iaj,jk->iak", source, f) - jnp.einsum("il,lak->iak", f, target)


def plain_adjoint(source: jax.Array, target: jax.Array, y: jax.Array) -> jax.Array:
    """K^T y of one instance: [n, A, n], [m, A, m], [n, A, m] -> [n, m]."""
    return jnp.einsum("iaj,iak->jk", source, y) - jnp.einsum("lak,iak->il", target, y)
