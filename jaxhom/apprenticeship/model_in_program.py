"""A model as LPAL's loop inside a program sees it (`in_program`): PDHG's part of it, and the units of both."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom import checks
from jaxhom.apprenticeship.column_responses import with_compact_features
from jaxhom.apprenticeship.flow_factor import feature_units
from jaxhom.apprenticeship.flow_factor_in_program import split_flow_in_program
from jaxhom.apprenticeship.flow_splitting import Goal, Splitting, State, begin, reading
from jaxhom.apprenticeship.pdhg import FlowProgram
from jaxhom.apprenticeship.prepared import PreparedModel
from jaxhom.apprenticeship.presolve import Reach
from jaxhom.models.mdp import MDP
from jaxhom.status import Record

if TYPE_CHECKING:
    from jaxtyping import Array, Float, Int


class ModelInProgram(Record):
    """A model as the passes see it.

    Attributes:
      mdp: with features in a unit in which they are about 1; [S, 1, K] where they are known to be those of the state.
      unit: that unit, in the caller's.
      reach: what policies can reach, in the caller's units.
      splitting: PDHG's program, in units of its own. flow_unit: [K], these, in the unit above.
      order: int [2, S], the states in the order of the splitting, and its inverse; None where that is the caller's.
    """

    mdp: MDP
    unit: Float[Array, ""]
    reach: Reach
    splitting: Splitting
    flow_unit: Float[Array, " K"]
    order: Int[Array, "2 S"] | None = None

    @classmethod
    def of_concrete(cls, model: PreparedModel) -> ModelInProgram:
        """That of a model on the host."""
        flow = model.once(FlowProgram)
        return cls(
            mdp=model.once(with_compact_features),
            unit=checks.to_device(np.asarray(model.unit), model.given.dtype),
            reach=jax.tree.map(lambda leaf: checks.to_device(np.asarray(leaf), model.given.dtype), model.reach),
            splitting=flow.splitting,
            flow_unit=checks.to_device(flow.unit, model.given.dtype),
            order=checks.to_device(np.stack([flow.order, np.argsort(flow.order)]).astype(np.int32)),
        )

    @classmethod
    def of_traced(cls, mdp: MDP) -> ModelInProgram:
        """That of a model whose numbers are traced."""
        size = jnp.abs(mdp.features).max(axis=(0, 1))
        unit = jnp.exp2(jnp.floor(jnp.log2(jnp.where(size.max() > 0, size.max(), 1.0))))
        flow_unit = feature_units(size / unit)
        scaled = mdp.replace(features=mdp.features / unit)
        return cls(
            mdp=scaled,
            unit=unit,
            reach=Reach.of(mdp),
            splitting=split_flow_in_program(mdp, scaled.features / flow_unit, flow_unit),
            flow_unit=flow_unit,
        )

    def goal(self, expectations: Float[Array, "B K"], x: Float[Array, "B S A"], weights: Float[Array, "B K"]) -> Goal:
        """PDHG's, beginning at an occupancy and at weights."""
        kept, dtype = 1.0 - self.mdp.discount, self.splitting.features.dtype
        asked = (kept * expectations / self.flow_unit).T
        w = (weights * self.flow_unit / self.flow_unit.min()).T
        return Goal(expectations=asked.astype(dtype), x=self._inner(x), w=w.astype(dtype))

    def begin(self, goal: Goal, x: Float[Array, "B S A"]) -> State:
        """PDHG's state at another occupancy than the goal's."""
        return begin(self.splitting, goal.replace(x=self._inner(x)))

    def _inner(self, x: Float[Array, "B S A"]) -> Float[Array, "S A B"]:
        x = (1.0 - self.mdp.discount) * jnp.moveaxis(jnp.nan_to_num(x), 0, -1)
        return (x if self.order is None else x[self.order[0]]).astype(self.splitting.features.dtype)

    def read(self, goal: Goal, flow: State) -> tuple[Float[Array, "B S A"], Float[Array, "B K"], Float[Array, "B S"]]:
        """x up to scale, weights and values, in the unit of the model."""
        dtype = self.mdp.dtype
        x, w, value = (leaf.astype(dtype) for leaf in reading(self.splitting, goal, flow))
        if self.order is not None:
            x, value = x[self.order[1]], value[self.order[1]]
        return jnp.moveaxis(x, -1, 0) / (1.0 - self.mdp.discount), w.T, value.T * self.flow_unit.min()
