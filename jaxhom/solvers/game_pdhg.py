"""Zero-sum matrix games as saddle-point problems.

    value = min_{w in simplex} max_{q in simplex} <w, M q>,   M [K, m].

Any w gives the upper bound max_j (M^T w)_j, any q the lower bound min_i (M q)_i. In LPAL the rows are features, the
columns the policies met so far.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from jaxhom.solvers.projections import project_simplex
from jaxhom.status import Record

if TYPE_CHECKING:
    from jaxtyping import Array, Bool, Float

_ABSENT = -1e30  # keeps the probability of a column that does not exist at zero


class MatrixGame(Record):
    """A batch of games.

    Attributes:
      payoff: [lanes, K, m], M. The lanes come first here alone: batched products of matrices that are not tiny want
        them there.
      is_column: bool [m, lanes], which columns exist; at least one.
    """

    payoff: Float[Array, "lanes K m"]
    is_column: Bool[Array, "m lanes"]

    def start(self) -> tuple[Float[Array, "K lanes"], Float[Array, "m lanes"]]:
        """Uniform strategies."""
        lanes, rows, columns = self.payoff.shape
        w = jnp.full((rows, lanes), 1.0 / rows, self.payoff.dtype)
        return w, self.project_dual(jnp.zeros((columns, lanes), self.payoff.dtype), None)

    def forward(self, w: jax.Array) -> jax.Array:
        """M^T w, [K, lanes] -> [m, lanes]."""
        return jnp.einsum("bkm,kb->mb", self.payoff, w)

    def adjoint(self, q: jax.Array) -> jax.Array:
        """M q, [m, lanes] -> [K, lanes]."""
        return jnp.einsum("bkm,mb->kb", self.payoff, q)

    def project_primal(self, point: jax.Array, step: jax.Array | None) -> jax.Array:
        """Onto the simplex of the rows."""
        del step
        return project_simplex(point)

    def project_dual(self, point: jax.Array, step: jax.Array | None) -> jax.Array:
        """Onto the simplex of the columns that exist."""
        del step
        return jnp.where(self.is_column, project_simplex(jnp.where(self.is_column, point, _ABSENT)), 0.0)

    def bounds(self, w: jax.Array, q: jax.Array, forward: jax.Array, adjoint: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Lower and upper bounds on the value; w and q are normalised to rounding."""
        columns = jnp.where(self.is_column, forward, -jnp.inf)
        return adjoint.min(axis=0), columns.max(axis=0)

    def norm_bound(self) -> jax.Array:
        """sqrt(|M|_1 |M|_inf)."""
        size = jnp.abs(self.payoff)
        return jnp.sqrt(size.sum(axis=1).max(axis=1) * size.sum(axis=2).max(axis=1))
