"""The soft homomorphism from a whole model to its demonstrated part as a saddle-point problem.

LP (8) of Boularias and Chaib-draa 2010: maps f [S, E] from all states to the E demonstrated ones, rows summing to 1,

    min_f max_{s,a,k} |sum_s'' T(s,a,s'') f(s'',k) - sum_l f(s,l) T^E(l,a,k)|,

with T^E the model restricted to the demonstrated states. As for the local program, e = min_f max_{|y|_1 <= 1} <y, K f>,
any f gives an upper and any y a lower bound. The products with T are the model's own sweeps with the E columns as
their batch; T^E is a dense tensor. `HostProblem` is the same in NumPy, for what is solved before a program is compiled.

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
    """One LP (8), as a batch of a single lane: points are [S, E, 1] and [S, A, E, 1].

    Attributes:
      mdp: the model.
      restricted: [E, A, E], T^E.
      pinned: bool [S, E]; a row with a True is fixed to that entry. All False in the program as printed.
      exists: bool [E]; False on padding, where T^E is zero.
    """

    mdp: MDP
    restricted: jax.Array
    pinned: jax.Array
    exists: jax.Array

    def start(self) -> tuple[jax.Array, jax.Array]:
        """Uniform rows, and y = 0."""
        numpy, (num_states, num_experts) = module_of(self.pinned), self.pinned.shape
        f = self.project_primal(numpy.zeros((num_states, num_experts, 1), self.mdp.dtype), None)
        return f, numpy.zeros((num_states, self.mdp.num_actions, num_experts, 1), self.mdp.dtype)

    def forward(self, f: jax.Array) -> jax.Array:
        """K f."""
        numpy = module_of(f)
        f = numpy.where(self.exists, f[..., 0], 0.0)
        return (self._expected(f) - self._mapped(f))[..., None]

    def adjoint(self, y: jax.Array) -> jax.Array:
        """K^T y."""
        return (self._pushed(y[..., 0]) - self._mapped_back(y[..., 0]))[..., None]

    def _expected(self, f: jax.Array) -> jax.Array:
        """sum_s'' T(s, a, s'') f(s'', k), [S, A, E]."""
        return expected_next_value(self.mdp, f)

    def _pushed(self, y: jax.Array) -> jax.Array:
        """sum_{s, a} T(s, a, s'') y(s, a, k), [S, E]."""
        return push_forward(self.mdp, y)

    def _mapped(self, f: jax.Array) -> jax.Array:
        """sum_l f(s, l) T^E(l, a, k), [S, A, E]."""
        return jnp.einsum("sl,lak->sak", f, self.restricted)

    def _mapped_back(self, y: jax.Array) -> jax.Array:
        """sum_{a, k} y(s, a, k) T^E(l, a, k), [S, E]."""
        return jnp.einsum("sak,lak->sl", y, self.restricted)

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
        num_states, num_actions, num_experts = forward.shape
        eps = numpy.finfo(forward.dtype).eps
        defect = numpy.abs(f.sum(axis=1) - 1.0).max()
        upper = numpy.abs(forward).max() + 2.0 * defect + (self.mdp.probability.shape[-1] + num_experts + 2) * eps
        lowest = numpy.where(self.pinned.any(axis=1), (self.pinned * adjoint).sum(axis=1), self._least(adjoint))
        value = lowest.sum() / numpy.maximum(numpy.abs(y).sum(), 1.0)
        # Rounding in K^T y is relative to the |y| that is summed, whose total is 1, spread over the chains of sums.
        rounding = 4.0 * (num_actions * num_experts + self.mdp.probability.shape[-1]) * eps
        lower = numpy.maximum(value - rounding - numpy.sqrt(num_states) * eps, 0.0)
        return lower[None], upper[None]

    def _least(self, adjoint: jax.Array) -> jax.Array:
        """[S]: the least entry of each row that is no padding."""
        numpy = module_of(adjoint)
        return numpy.where(self.exists, adjoint, numpy.inf).min(axis=1)

    def norm_bound(self) -> jax.Array:
        """sqrt(|K|_1 |K|_inf), from the row and column sums of T and T^E."""
        numpy = module_of(self.pinned)
        ones = numpy.ones((self.mdp.num_states, self.mdp.num_actions, 1), self.mdp.dtype)
        into_states = self._pushed(ones).max()
        into_experts = self.restricted.sum(axis=0).max()
        return numpy.sqrt((into_states + self.mdp.num_actions) * (1.0 + into_experts))[None]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class HostProblem(GlobalHomomorphismProblem):
    """The same in NumPy and SciPy; one batch of products with T^E and one with T, both sparse where T is.

    Attributes:
      rows: [S A, S], the rows of T.
    """

    rows: scipy.sparse.csr_array | np.ndarray

    @functools.cached_property
    def _within(self) -> tuple[scipy.sparse.csr_array, scipy.sparse.csr_array]:
        """T^E as [E, A E], and its transpose."""
        matrix = scipy.sparse.csr_array(self.restricted.reshape(len(self.restricted), -1))
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
