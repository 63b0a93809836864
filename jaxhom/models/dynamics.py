"""The two linear maps of a model's transitions T(s, a, s'), which are all that the solvers need of them.

    backward   (T v)(s, a) = sum_s' T(s, a, s') v(s')
    forward    (T^t x)(s') = sum_{s, a} x(s, a) T(s, a, s')

`Dynamics` says what either layout can do: `dense_tensor` by products with T itself, `successor_lists` by gathers along
the successors of each pair. Which of the two a model has is chosen once, by its constructors (`construction`).

Sweeps take a trailing batch axis: v is [S] or [S, B], x is [S, A] or [S, A, B]. Batch last is what XLA's CPU
backend vectorises.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Protocol

from jaxhom.status import Record

if TYPE_CHECKING:
    import numpy as np
    import scipy.sparse
    from jaxtyping import Array, Bool, Float, Int

    from jaxhom.models.edge_chains import ActionChains


class Chain(Protocol):
    """P_pi(s, s') = sum_a pi(s, a) T(s, a, s') of one policy or, with the batch last, of B of them."""

    def expected_next_value(self, value: Float[Array, "S *B"]) -> Float[Array, "S *B"]:
        """P_pi v."""

    def push_forward(self, occupancy: Float[Array, "S *B"]) -> Float[Array, "S *B"]:
        """P_pi^T mu."""


class Dynamics(Record):
    """T(s, a, s') in one of its layouts. Works under `jit`, `vmap` and `grad` where nothing else is said.

    Attributes:
      next_state: int32 [S, A, N], successors of each state-action pair (ascending; padding repeats 0).
      probability: float [S, A, N], their probabilities; 0 on padding.
    """

    layout: ClassVar[str]

    next_state: Int[Array, "S A N"]
    probability: Float[Array, "S A N"]

    @property
    def transition(self) -> Float[Array, "S A S"]:
        """The dense tensor T."""
        raise NotImplementedError

    def expected_next_value(self, value: Float[Array, "S *B"]) -> Float[Array, "S A *B"]:
        """The backward map: E[value(s') | s, a]."""
        raise NotImplementedError

    def expected_next_values(self, value: Float[Array, "S *B"]) -> list[Float[Array, "S *B"]]:
        """The backward map action by action: a list of A arrays."""
        raise NotImplementedError

    def push_forward(self, occupancy: Float[Array, "S A *B"]) -> Float[Array, "S *B"]:
        """The forward map: sum_{s, a} x(s, a) T(s, a, s')."""
        raise NotImplementedError

    def state_transition(self, policy: Float[Array, "S A"]) -> Float[Array, "S S"]:
        """P_pi as a dense matrix."""
        raise NotImplementedError

    def chain(self, policy: Float[Array, "S A *B"]) -> Chain:
        """P_pi for loops that apply it many times."""
        raise NotImplementedError

    def action_chains(self) -> ActionChains | None:
        """All actions' chains for loops over them; None where `expected_next_values` is at least as fast."""
        raise NotImplementedError

    def host_matrix(self, numbers: Float[np.ndarray, "S A N"]) -> np.ndarray | scipy.sparse.csr_array:
        """Numbers in the slots of the layout as a matrix [S A, S] on the host: an array, or sparse."""
        raise NotImplementedError

    def leads(
        self, state: Int[np.ndarray, " P"], action: Int[np.ndarray, " P"], successor: Int[np.ndarray, " P"]
    ) -> Bool[np.ndarray, " P"]:
        """Whether T(s, a, s') > 0 for each of P triples; on the host."""
        raise NotImplementedError

    def open_slots(self) -> Bool[np.ndarray, "S A N"]:
        """Where new probabilities may stand: in every slot whose successor the layout knows; on the host."""
        raise NotImplementedError

    @property
    def longest_sum(self) -> int:
        """How many terms `push_forward` adds up at most, one after the other."""
        raise NotImplementedError

    def known_slots(self) -> Bool[np.ndarray, "S A N"] | None:
        """The slots that hold a successor, on the host, also where probabilities are traced; None if the graph is."""
        raise NotImplementedError
