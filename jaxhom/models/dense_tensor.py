"""The dense layout: the slots of a pair are the states themselves, and both one-step maps are matrix products.

It is what models get in which a pair has many of all the states as its successors: there products beat gathers.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import jax.numpy as jnp
import numpy as np

from jaxhom.models.dynamics import Dynamics
from jaxhom.status import Record

if TYPE_CHECKING:
    from jaxtyping import Array, Bool, Float, Int


class DenseTensor(Dynamics):
    """T as a tensor: N = S, `probability` is T and next_state[s, a, s'] is s'."""

    layout: ClassVar[str] = "dense"

    @property
    def transition(self) -> Float[Array, "S A S"]:
        """The dense tensor T, which is `probability`."""
        return self.probability

    def expected_next_value(self, value: Float[Array, "S *B"]) -> Float[Array, "S A *B"]:
        """The backward map: E[value(s') | s, a]."""
        return jnp.tensordot(self.probability, value, axes=1)

    def expected_next_values(self, value: Float[Array, "S *B"]) -> list[Float[Array, "S *B"]]:
        """The backward map action by action: one product, taken apart."""
        return list(jnp.moveaxis(self.expected_next_value(value), 1, 0))

    def push_forward(self, occupancy: Float[Array, "S A *B"]) -> Float[Array, "S *B"]:
        """The forward map: sum_{s, a} x(s, a) T(s, a, s')."""
        return jnp.tensordot(self.probability, occupancy, axes=((0, 1), (0, 1)))

    def state_transition(self, policy: Float[Array, "S A"]) -> Float[Array, "S S"]:
        """P_pi as a dense matrix."""
        return jnp.einsum("sa,saz->sz", policy, self.probability)

    def chain(self, policy: Float[Array, "S A *B"]) -> DenseChain | DenseChains:
        """P_pi for loops that apply it many times."""
        if policy.ndim == 2:
            return DenseChain(transition=self.state_transition(policy))
        return DenseChains(dynamics=self, policy=policy)

    def action_chains(self) -> None:
        """None: nothing is saved by other weights than the tensor's."""
        return

    def host_matrix(self, numbers: Float[np.ndarray, "S A S"]) -> Float[np.ndarray, "SA S"]:
        """Numbers [S, A, S] as a matrix [S A, S]."""
        return numbers.reshape(-1, numbers.shape[-1])

    def leads(
        self, state: Int[np.ndarray, " P"], action: Int[np.ndarray, " P"], successor: Int[np.ndarray, " P"]
    ) -> Bool[np.ndarray, " P"]:
        """Whether T(s, a, s') > 0 for each of P triples; on the host."""
        return np.asarray(self.probability)[state, action, successor] > 0

    def open_slots(self) -> Bool[np.ndarray, "S A S"]:
        """All slots: every state may become a successor."""
        return np.broadcast_to(True, self.probability.shape)

    @property
    def longest_sum(self) -> int:
        """All pairs."""
        return self.probability.shape[0] * self.probability.shape[1]

    def known_slots(self) -> Bool[np.ndarray, "S A S"]:
        """All slots, as `open_slots`."""
        return self.open_slots()


class DenseChain(Record):
    """P_pi of one policy as a matrix [S, S]."""

    transition: Float[Array, "S S"]

    def expected_next_value(self, value: Float[Array, " S"]) -> Float[Array, " S"]:
        """P_pi v."""
        return self.transition @ value

    def push_forward(self, occupancy: Float[Array, " S"]) -> Float[Array, " S"]:
        """P_pi^T mu."""
        return occupancy @ self.transition


class DenseChains(Record):
    """P_pi of B policies [S, A, B], by products with T.

    One matrix for all lanes: its product is worth more than the A times fewer numbers of a matrix per lane.
    """

    dynamics: DenseTensor
    policy: Float[Array, "S A B"]

    def expected_next_value(self, value: Float[Array, "S B"]) -> Float[Array, "S B"]:
        """P_pi v, lane by lane."""
        return jnp.einsum("sab,sab->sb", self.policy, self.dynamics.expected_next_value(value))

    def push_forward(self, occupancy: Float[Array, "S B"]) -> Float[Array, "S B"]:
        """P_pi^T mu, lane by lane."""
        return self.dynamics.push_forward(occupancy[:, None] * self.policy)
