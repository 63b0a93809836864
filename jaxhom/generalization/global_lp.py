"""One soft homomorphism for all states of a model as a saddle-point problem.

Maps f [S, E] from the states of a model T to the E states of a target T', rows summing to 1,

    min_f max_{s,a,k} |sum_s'' T(s,a,s'') f(s'',k) - sum_l f(s,l) T'(l,a,k)|:

eq. (7) of Boularias and Chaib-draa 2010 with the least error, and LP (8) where the target is the model restricted to
the E demonstrated states. As for the local program, e = min_f max_{|y|_1 <= 1} <y, K f>, any f gives an upper and any y
a lower bound. The products with T are the model's own sweeps with the E columns as their batch; T' is a dense tensor.
`HostProblem` is the same in NumPy, for what is solved before a program is compiled.

Labels, l(s,a,.) of the model and l'(k,a,.) of the target, are kept within e as well: the entries
|l(s,a) - sum_k f(s,k) l'(k,a)| <= e stand behind the columns of K f, as in `homomorphism_lp`.

Inside programs the demonstrated states are a list of static length that is padded: the columns of its padding stay 0
in f and y.
"""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import scipy

from jaxhom.models.mdp import MDP, expected_next_value, push_forward
from jaxhom.solvers.arrays import module_of
from jaxhom.solvers.projections import project_l1_ball, project_simplex


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class GlobalHomomorphismProblem:
    """One program, as a batch of a single lane: points are [S, E, 1] and [S, A, E + L, 1].

    Attributes:
      mdp: the model.
      target: [E, A, E], T'.
      pinned: bool [S, E]; a row with a True is fixed to that entry. All False in the program as printed.
      exists: bool [E]; False on padding, where T' is zero.
      labels: [S, A, L], or None: no labels, L = 0.
      target_labels: [E, A, L], zero on padding; or None, as `labels`.
    """

    mdp: MDP
    target: jax.Array
    pinned: jax.Array
    exists: jax.Array
    labels: jax.Array | None
    target_labels: jax.Array | None

    @property
    def num_labels(self) -> int:
        """L."""
        return 0 if self.labels is None else self.labels.shape[-1]

    def start(self) -> tuple[jax.Array, jax.Array]:
        """Uniform rows, and y = 0."""
        numpy, (num_states, num_targets) = module_of(self.pinned), self.pinned.shape
        f = self.project_primal(numpy.zeros((num_states, num_targets, 1), self.mdp.dtype), None)
        dual_shape = (num_states, self.mdp.num_actions, num_targets + self.num_labels, 1)
        return f, numpy.zeros(dual_shape, self.mdp.dtype)

    def forward(self, f: jax.Array) -> jax.Array:
        """K f."""
        numpy = module_of(f)
        f = numpy.where(self.exists, f[..., 0], 0.0)
        product = self._expected(f) - self._mapped(f)
        if self.labels is not None:
            product = numpy.concatenate([product, self._label_errors(f)], axis=2)
        return product[..., None]

    def adjoint(self, y: jax.Array) -> jax.Array:
        """K^T y."""
        num_targets = len(self.exists)
        moved, kept = y[:, :, :num_targets, 0], y[:, :, num_targets:, 0]
        product = self._pushed(moved) - self._mapped_back(moved)
        return (product if self.labels is None else product + self._label_adjoint(kept))[..., None]

    def _expected(self, f: jax.Array) -> jax.Array:
        """sum_s'' T(s, a, s'') f(s'', k), [S, A, E]."""
        return expected_next_value(self.mdp, f)

    def _pushed(self, y: jax.Array) -> jax.Array:
        """sum_{s, a} T(s, a, s'') y(s, a, k), [S, E]."""
        return push_forward(self.mdp, y)

    def _mapped(self, f: jax.Array) -> jax.Array:
        """sum_l f(s, l) T'(l, a, k), [S, A, E]."""
        return jnp.einsum("sl,lak->sak", f, self.target)

    def _mapped_back(self, y: jax.Array) -> jax.Array:
        """sum_{a, k} y(s, a, k) T'(l, a, k), [S, E]."""
        return jnp.einsum("sak,lak->sl", y, self.target)

    def _label_errors(self, f: jax.Array) -> jax.Array:
        """sum_k f(s, k) (l(s, a) - l'(k, a)), [S, A, L]: linear, as rows of f sum to 1."""
        mapped = f @ self.target_labels.reshape(len(self.exists), -1)
        return f.sum(axis=1)[:, None, None] * self.labels - mapped.reshape(self.labels.shape)

    def _label_adjoint(self, y: jax.Array) -> jax.Array:
        """sum_a y(s, a, .) (l(s, a, .) - l'(k, a, .)), [S, E]; 0 on padding."""
        kept = (self.labels * y).sum(axis=(1, 2))[:, None]
        mapped = y.reshape(len(y), -1) @ self.target_labels.reshape(len(self.exists), -1).T
        return module_of(y).where(self.exists, kept - mapped, 0.0)

    def project_primal(self, point: jax.Array, step) -> jax.Array:
        """Rows onto the simplex; pinned rows to their entry."""
        del step
        numpy, point = module_of(point), point[..., 0]
        largest = numpy.max(point, axis=1, keepdims=True, where=self.exists, initial=numpy.finfo(point.dtype).min)
        f = project_simplex(numpy.where(self.exists, point, largest - 2.0), axis=1)  # 0 where 1 below the largest
        is_pinned = self.pinned.any(axis=1, keepdims=True)
        return numpy.where(is_pinned, self.pinned.astype(f.dtype), f)[..., None]

    def project_dual(self, point: jax.Array, step) -> jax.Array:
        """Onto the ball |y|_1 <= 1."""
        del step
        return project_l1_ball(point.reshape(1, -1), axes=(1,)).reshape(point.shape)

    def bounds(self, f, y, forward, adjoint) -> tuple[jax.Array, jax.Array]:
        """Certified bounds, widened by the rounding of the sums that make them."""
        numpy = module_of(f)
        f, y, forward, adjoint = (array[..., 0] for array in (f, y, forward, adjoint))
        (num_states, num_actions, _), num_targets = forward.shape, len(self.exists)
        eps, slots, largest = numpy.finfo(forward.dtype).eps, self.mdp.probability.shape[-1], self.largest()
        defect = numpy.abs(f.sum(axis=1) - 1.0).max()
        upper = numpy.abs(forward).max() + (2.0 * defect + (slots + num_targets + 2) * eps) * largest
        lowest = numpy.where(self.pinned.any(axis=1), (self.pinned * adjoint).sum(axis=1), self._least(adjoint))
        value = lowest.sum() / numpy.maximum(numpy.abs(y).sum(), 1.0)
        # Rounding in K^T y is relative to the |y| that is summed, whose total is 1, spread over the chains of sums.
        terms = 4.0 * (num_actions * (num_targets + 2 * self.num_labels) + slots) + numpy.sqrt(num_states)
        lower = numpy.maximum(value - terms * eps * largest, 0.0)
        return lower[None], upper[None]

    def largest(self) -> jax.Array | float:
        """What |K f| is at most, whatever the map: 1, or where labels differ by more, that."""
        if self.labels is None:
            return 1.0
        numpy = module_of(self.labels)
        size = (numpy.abs(labels).max(initial=0.0) for labels in (self.labels, self.target_labels))
        return numpy.maximum(sum(size), 1.0)

    def _least(self, adjoint: jax.Array) -> jax.Array:
        """[S]: the least entry of each row that is no padding."""
        numpy = module_of(adjoint)
        return numpy.where(self.exists, adjoint, numpy.inf).min(axis=1)

    def norm_bound(self) -> jax.Array:
        """sqrt(|K|_1 |K|_inf), from the row and column sums of T and T', and of the labels."""
        numpy = module_of(self.pinned)
        ones = numpy.ones((self.mdp.num_states, self.mdp.num_actions, 1), self.mdp.dtype)
        into_states = self._pushed(ones).max()
        into_targets = self.target.sum(axis=0).max()
        columns, rows = into_states + self.mdp.num_actions, 1.0 + into_targets
        if self.labels is not None:
            columns += self.mdp.num_actions * self.num_labels * self.largest()
            rows = numpy.maximum(rows, len(self.exists) * self.largest())
        return numpy.sqrt(columns * rows)[None]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class HostProblem(GlobalHomomorphismProblem):
    """The same in NumPy and SciPy; one batch of products with T' and one with T, both sparse where T is.

    Attributes:
      rows: [S A, S], the rows of T.
    """

    rows: scipy.sparse.csr_array | np.ndarray

    @functools.cached_property
    def _within(self) -> tuple[scipy.sparse.csr_array, scipy.sparse.csr_array]:
        """T' as [E, A E], and its transpose."""
        matrix = scipy.sparse.csr_array(self.target.reshape(len(self.target), -1))
        return matrix, matrix.T.tocsr()

    def on_device(self) -> GlobalHomomorphismProblem:
        """The problem for programs."""
        fields = {field.name: getattr(self, field.name) for field in dataclasses.fields(GlobalHomomorphismProblem)}
        return GlobalHomomorphismProblem(**fields)

    def _expected(self, f):
        return (self.rows @ f).reshape(*self.mdp.allowed.shape, -1)

    def _pushed(self, y):
        return self.rows.T @ y.reshape(self.rows.shape[0], -1)

    def _mapped(self, f):
        return (self._within[1] @ f.T).T.reshape(*self.mdp.allowed.shape, -1)

    def _mapped_back(self, y):
        return (self._within[0] @ y.reshape(len(y), -1).T).T


def restricted_to_list(mdp: MDP, experts: jax.Array) -> jax.Array:
    """T^E [E, A, E] for a list of different states [E] that is padded with S; inside programs.

    Transitions that leave the set become self-loops on the state they leave. Padding has no transitions. An entry adds
    up to N numbers, which is exact to N times eps.
    """
    count, num_states = len(experts), mdp.num_states
    column = jnp.full(num_states, count, jnp.int32).at[experts].set(jnp.arange(count, dtype=jnp.int32), mode="drop")
    target = column[mdp.next_state.at[experts].get(mode="clip")]
    own, action = jnp.arange(count)[:, None, None], jnp.arange(mdp.num_actions)[:, None]
    probability = mdp.probability.at[experts].get(mode="fill", fill_value=0)
    zeros = jnp.zeros((count, mdp.num_actions, count), mdp.dtype)
    return zeros.at[own, action, jnp.where(target < count, target, own)].add(probability)


def centred(*labels):
    """Labels [.., A, L] of models between which states are mapped, less the middle of all of each kind.

    Rows of maps sum to 1, so that labels can be counted from anywhere: from where they are small, rounding is.
    """
    numpy = module_of(labels[0])
    highest = functools.reduce(numpy.maximum, (one.max(axis=0) for one in labels))
    lowest = functools.reduce(numpy.minimum, (one.min(axis=0) for one in labels))
    middle = 0.5 * highest + 0.5 * lowest
    return tuple(one - middle for one in labels)
