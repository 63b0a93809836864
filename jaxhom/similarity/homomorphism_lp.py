"""Soft homomorphisms between small models as saddle-point problems, lanes last.

LP (9) of Boularias and Chaib-draa 2010 minimises a max-norm over row-stochastic maps f [n, m] from a source model
T [n, A, n] to a target model T' [m, A, m],

    e = min_f max_{i,a,k} |(K f)(i,a,k)|,   (K f)(i,a,k) = sum_j T(i,a,j) f(j,k) - sum_l f(i,l) T'(l,a,k),

which is min over f of the max over |y|_1 <= 1 of <y, K f>. Any f gives the upper bound |K f|_inf, any y the lower
bound sum_i min_k (K^T y)(i,k). In the anchored problem f(0,0) = 1: the centre goes to the centre, and row 0
contributes (K^T y)(0,0) alone.

Models may carry labels, l(i,a,.) of the source and l'(k,a,.) of the target, which the map has to keep within e as well:
the entries |l(i,a) - sum_k f(i,k) l'(k,a)| <= e stand behind the columns of K f. As rows of f sum to 1 they are linear
in f, sum_k f(i,k) (l(i,a) - l'(k,a)). A row of T or T' that is all zero is an action without successors: its part of
K f is zero.

The products are written out over j and l while models are small, so that XLA fuses each into one pass over the
lanes; what would take more than `_MAX_UNROLL` terms for the states, or `_MAX_TERMS` in all, is a loop or an einsum, so
that compiling takes as long whatever the number of actions. `plain_forward` and `plain_adjoint` say the same with
einsum, for one instance, and hold them to it in tests.
"""

import dataclasses

import jax
import jax.numpy as jnp

from jaxhom.solvers.projections import project_l1_ball, project_simplex

_MAX_UNROLL = 32  # states of both models; more take XLA longer than they save
_MAX_TERMS = 64  # of one sum


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class HomomorphismProblem:
    """A batch of LPs (9).

    Attributes:
      source: [n, A, n, lanes], centre first, padding zero.
      target: [m, A, m, lanes], likewise.
      source_size, target_size: int32 [lanes], how many of the n and m states are real.
      anchored: whether f(0, 0) = 1 is required.
      source_labels: [n, A, L, lanes], padding zero, or None: no labels, L = 0 below.
      target_labels: [m, A, L, lanes], or None, as `source_labels`.
    """

    source: jax.Array
    target: jax.Array
    source_size: jax.Array
    target_size: jax.Array
    anchored: bool = dataclasses.field(metadata={"static": True})
    source_labels: jax.Array | None = None
    target_labels: jax.Array | None = None

    def start(self) -> tuple[jax.Array, jax.Array]:
        """Rows uniform over the target (the centre on the centre, if anchored), and y = 0."""
        n, num_actions, _, lanes = self.source.shape
        m = self.target.shape[0]
        zeros = jnp.zeros((n, m, lanes), self.source.dtype)
        dual = jnp.zeros((n, num_actions, m + self.num_labels, lanes), self.source.dtype)
        return self.project_primal(zeros, None), dual

    @property
    def num_labels(self) -> int:
        """L."""
        return 0 if self.source_labels is None else self.source_labels.shape[2]

    def forward(self, f: jax.Array) -> jax.Array:
        """K f, [n, m, lanes] -> [n, A, m + L, lanes]."""
        source, target = self.source, self.target
        n, m = f.shape[:2]
        if n + m > _MAX_UNROLL:
            moved = jnp.einsum("biaj,bjk->iakb", _lanes_first(source), _lanes_first(f))
            product = moved - jnp.einsum("bil,blak->iakb", _lanes_first(f), _lanes_first(target))
        else:
            product = sum(source[:, :, j, None] * f[j] for j in range(n))
            product -= sum(f[:, None, None, k] * target[k] for k in range(m))
        return product if self.source_labels is None else jnp.concatenate([product, self._label_errors(f)], axis=2)

    def adjoint(self, y: jax.Array) -> jax.Array:
        """K^T y, [n, A, m + L, lanes] -> [n, m, lanes]."""
        m = self.target.shape[0]
        product = self._transition_adjoint(y[:, :, :m])
        return product if self.source_labels is None else product + self._label_adjoint(y[:, :, m:])

    def _transition_adjoint(self, y: jax.Array) -> jax.Array:
        source, target = self.source, self.target
        n, num_actions, m, lanes = y.shape
        if n + m > _MAX_UNROLL:
            moved = jnp.einsum("biaj,biak->jkb", _lanes_first(source), _lanes_first(y))
            return moved - jnp.einsum("blak,biak->ilb", _lanes_first(target), _lanes_first(y))

        def add_actions(actions, total):
            total += sum(source[i, a, :, None] * y[i, a] for i in range(n) for a in actions)
            return total - sum(target[:, a, k] * y[:, a, k, None] for a in actions for k in range(m))

        zeros = jnp.zeros((n, m, lanes), y.dtype)
        if num_actions * (n + m) <= _MAX_TERMS:
            return add_actions(range(num_actions), zeros)
        return jax.lax.fori_loop(0, num_actions, lambda a, total: add_actions([a], total), zeros)

    def _label_errors(self, f: jax.Array) -> jax.Array:
        """sum_k f(i,k) (l(i,a) - l'(k,a)), [n, A, L, lanes]."""
        row_sum = f.sum(axis=1)[:, None, None]
        return row_sum * self.source_labels - jnp.einsum("ikb,kalb->ialb", f, self.target_labels)

    def _label_adjoint(self, y: jax.Array) -> jax.Array:
        kept = (self.source_labels * y).sum(axis=(1, 2))[:, None]
        return kept - jnp.einsum("kalb,ialb->ikb", self.target_labels, y)

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
        """Certified bounds, widened by the rounding of the sums that make them (so the lower one may be below 0)."""
        rows, columns = self.masks(f.shape)
        for_lower, for_upper = self.rounding()
        defect = jnp.where(rows[:, 0], jnp.abs(f.sum(axis=1) - 1.0), 0.0).max(axis=0)
        upper = jnp.abs(forward).max(axis=(0, 1, 2)) + 2.0 * self.largest() * defect + for_upper
        lowest = jnp.where(columns, adjoint, jnp.inf).min(axis=1)
        if self.anchored:
            lowest = lowest.at[0].set(adjoint[0, 0])
        value = jnp.where(rows[:, 0], lowest, 0.0).sum(axis=0)
        size = jnp.abs(y).sum(axis=(0, 1, 2))
        value = value / jnp.maximum(size, 1.0)  # the bound is homogeneous in y
        return value - for_lower, upper

    def rounding(self) -> tuple[jax.Array, jax.Array]:
        """What the sums behind the lower and the upper bound can be off by: [lanes] or scalars, known beforehand.

        An entry of K f is a sum of n and one of m terms that are at most 1 in all. The rounding of an entry of K^T y
        is relative to what is summed, at most |y|_1 = 1 for each of the two models over all rows together, whichever
        column is the lowest in each; times the number of terms, and half an eps for each.
        """
        n, num_actions = self.source.shape[:2]
        m = self.target.shape[0]
        eps = jnp.finfo(self.source.dtype).eps
        terms = num_actions * (n + m + 2 * self.num_labels) + 2 * n + 8
        return terms * eps * self.largest(), (n + m + 2) * eps * self.largest()

    def largest(self):
        """What |K f| is at most, whatever the map: 1, or where labels differ by more, that; [lanes]."""
        if self.source_labels is None:
            return 1.0
        size = (jnp.abs(labels).max(axis=(0, 1, 2), initial=0.0) for labels in (self.source_labels, self.target_labels))
        return jnp.maximum(sum(size), 1.0)

    def norm_bound(self) -> jax.Array:
        """sqrt(|K|_1 |K|_inf), from the row and column sums of |T| and |T'|, and of the labels."""
        into_source = self.source.sum(axis=(0, 1)).max(axis=0)
        into_target = self.target.sum(axis=0).max(axis=(0, 1))
        num_actions, m = self.source.shape[1], self.target.shape[0]
        labels = self.largest() if self.source_labels is not None else 0.0
        columns = into_source + num_actions * (1.0 + self.num_labels * labels)
        return jnp.sqrt(columns * jnp.maximum(1.0 + into_target, m * labels))

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
