"""What a method of LPAL is asked.

A *lane* is one of the B problems of a call: one vector of expectations Vhat over the model that all of them share.
A method takes a `Request` and returns what it has `Found` (`solution`). Both are in the method's own terms: features in
a unit in which they are about 1, expectations brought within reach (`presolve`). Nothing of an answer is certified; a
method that wants to know where it stands asks the request (`certified`).
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from jaxhom.apprenticeship.certificate import Certifier
from jaxhom.apprenticeship.prepared import PreparedModel
from jaxhom.apprenticeship.solution import Found, LPALSolution

if TYPE_CHECKING:
    from jaxtyping import Float, Int


@dataclasses.dataclass(frozen=True, eq=False)
class Request:
    """What a method is asked: a batch of lanes over one model.

    Attributes:
      model: the model, and what its solves share.
      expectations: [B, K] float64, in the units of the model's features.
      tolerance: [B], gaps to aim for, in the same units.
      certifier: makes solutions of what is found for all lanes of the call.
      lanes: int [B], the numbers that these lanes have in the call.
      policy: [B, S, A] or None. weights: [B, K] or None. What to begin with.
      value: [B, S] or None, guesses of the optimal values for these weights, in the model's units.
      limit: iterations of a lane; None for what the method takes to be enough.
      progress: whether to show a bar.
    """

    model: PreparedModel
    expectations: Float[np.ndarray, "B K"]
    tolerance: Float[np.ndarray, " B"]
    certifier: Certifier
    lanes: Int[np.ndarray, " B"]
    policy: Float[np.ndarray, "B S A"] | None = None
    weights: Float[np.ndarray, "B K"] | None = None
    value: Float[np.ndarray, "B S"] | None = None
    limit: int | None = None
    progress: bool = False

    def replace(self, **changes) -> Request:
        """The request with the given fields exchanged."""
        return dataclasses.replace(self, **changes)

    def part(self, numbers: Int[np.ndarray, " C"], **changes) -> Request:
        """The request of some lanes, counted within this one, with the given fields exchanged."""
        by_lane = ("expectations", "tolerance", "lanes", "policy", "weights", "value")
        parts = {name: None if (leaf := getattr(self, name)) is None else leaf[numbers] for name in by_lane}
        return self.replace(**parts | changes)

    def certified(self, found: Found) -> LPALSolution:
        """The solutions that what was found for these lanes comes to, in the units of the call."""
        return self.certifier.certify(found, self.lanes)
