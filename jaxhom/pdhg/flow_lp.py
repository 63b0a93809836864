"""LPAL's linear program over occupancies as a saddle-point problem, lanes last.

    min_{w in simplex, h in box} max_{x in X}  w . (Phi^T x - Vhat) + h . (alpha - (E - gamma T)^T x),

with X = {x >= 0, sum x = 1 / (1 - gamma)}, which the Bellman flow (3)-(4) of Boularias and Chaib-draa 2010 implies,
and h, the multipliers of the flow, in the box of values that rewards Phi w can have. Both restrictions leave the
value alone and make every point a certificate: with the other side's best answer in closed form, any (w, h) is an
upper and any x a lower bound.

Inside, x is scaled to sum 1, h to the unit of features (divided by 1 - gamma where it acts). The primal point is
w and h stacked, [K + S, lanes]; the dual is x, [S, A, lanes].
"""

import chex
import jax
import jax.numpy as jnp

from jaxhom.mdp import MDP, expected_next_values, push_forward
from jaxhom.pdhg.projections import project_simplex


@chex.dataclass(frozen=True)
class FlowProblem:
    """A batch of programs over one model.

    Attributes:
      mdp: the model, features [S, A, K].
      expectations: [K, lanes], (1 - gamma) Vhat.
    """

    mdp: MDP
    expectations: jax.Array

    def start(self) -> tuple[jax.Array, jax.Array]:
        """Uniform w, h in the middle of its box, uniform x."""
        mdp, lanes = self.mdp, self.expectations.shape[-1]
        w = jnp.full((mdp.num_features, lanes), 1.0 / mdp.num_features, mdp.dtype)
        h = jnp.full((mdp.num_states, lanes), sum(self._box()) / 2, mdp.dtype)
        pairs = mdp.num_states * mdp.num_actions
        x = jnp.full((mdp.num_states, mdp.num_actions, lanes), 1.0 / pairs, mdp.dtype)
        return jnp.concatenate([w, h]), x

    def forward(self, primal: jax.Array) -> jax.Array:
        """Phi w + (gamma T h - h) / (1 - gamma), [K + S, lanes] -> [S, A, lanes]."""
        mdp = self.mdp
        w, h = self._split(primal)
        advantage = jnp.stack([mdp.discount * v - h for v in expected_next_values(mdp, h)], axis=1)
        return jnp.einsum("sak,kb->sab", mdp.features, w) + advantage / (1.0 - mdp.discount)

    def adjoint(self, x: jax.Array) -> jax.Array:
        """Phi^T x stacked on (gamma T^T x - E^T x) / (1 - gamma), [S, A, lanes] -> [K + S, lanes]."""
        mdp = self.mdp
        arriving = mdp.discount * push_forward(mdp, x) - x.sum(axis=1)
        expected = jnp.einsum("sak,sab->kb", mdp.features, x)
        return jnp.concatenate([expected, arriving / (1.0 - mdp.discount)])

    def project_primal(self, point: jax.Array, step: jax.Array) -> jax.Array:
        """The step on the linear term -Vhat . w + alpha . h, then w onto the simplex and h into its box."""
        point = point - step * self._linear()
        w, h = self._split(point)
        return jnp.concatenate([project_simplex(w), jnp.clip(h, *self._box())])

    def project_dual(self, point: jax.Array, step: jax.Array) -> jax.Array:
        """Onto x >= 0, sum x = 1."""
        del step
        flat = point.reshape(-1, point.shape[-1])
        return project_simplex(flat).reshape(point.shape)

    def bounds(self, primal, x, forward, adjoint) -> tuple[jax.Array, jax.Array]:
        """Lower and upper bounds on (1 - gamma) v*."""
        linear = self._linear()
        upper = forward.max(axis=(0, 1)) + (linear * primal).sum(axis=0)
        gradient_w, gradient_h = self._split(adjoint + linear)
        low, high = self._box()
        worst_h = jnp.minimum(low * gradient_h, high * gradient_h).sum(axis=0)
        return gradient_w.min(axis=0) + worst_h, upper

    def norm_bound(self) -> jax.Array:
        """Infinite: the power iteration's estimate is used as it is."""
        return jnp.full(self.expectations.shape[-1], jnp.inf, self.mdp.dtype)

    def _split(self, stacked: jax.Array) -> tuple[jax.Array, jax.Array]:
        return stacked[: self.mdp.num_features], stacked[self.mdp.num_features :]

    def _linear(self) -> jax.Array:
        lanes = self.expectations.shape[-1]
        initial = jnp.broadcast_to(self.mdp.initial[:, None], (self.mdp.num_states, lanes))
        return jnp.concatenate([-self.expectations, initial])

    def _box(self) -> tuple[jax.Array, jax.Array]:
        return self.mdp.features.min(), self.mdp.features.max()
