"""A model as the methods of LPAL see it, with what all solves over it share.

Features come in a unit in which they are about 1: a power of two, so that no digit changes. What one method prepares
for a model (a factorisation, a sparse program) it asks for by the function that makes it, `model.once(make)`: the model
knows no method, and a second solve finds everything made.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import TypeVar

import numpy as np

from jaxhom import checks
from jaxhom.apprenticeship.certificate import ExactSides
from jaxhom.apprenticeship.presolve import Reach
from jaxhom.models.mdp import MDP

T = TypeVar("T")


class PreparedModel:
    """A concrete model and what is made of it once.

    Attributes:
      given: the model as the caller gave it.
      unit: of the features and margins that methods see, in the caller's.
    """

    def __init__(self, given: MDP):
        largest = float(np.abs(np.asarray(given.features)).max())
        self.given, self.unit = given, float(np.exp2(np.floor(np.log2(largest or 1.0))))
        self._made: dict[Callable, object] = {}

    @functools.cached_property
    def mdp(self) -> MDP:
        """The model with features in units of about 1."""
        if self.unit == 1.0:
            return self.given
        features = np.asarray(self.given.features)
        return dataclasses.replace(self.given, features=checks.to_device(features / features.dtype.type(self.unit)))

    @functools.cached_property
    def reach(self) -> Reach:
        """What policies can reach at most and at least, in the caller's units."""
        return Reach.of(self.given)

    @functools.cached_property
    def sides(self) -> ExactSides:
        """Both sides of the certificate, in the caller's units."""
        return ExactSides(self.given)

    def once(self, make: Callable[[MDP], T]) -> T:
        """What `make` prepares for the model of the methods; made when it is first asked for."""
        if make not in self._made:
            self._made[make] = make(self.mdp)
        return self._made[make]
