"""What every way to generalize returns: a policy for every state, and where each state's came from."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING

from jaxhom import checks
from jaxhom.generalization import evidence
from jaxhom.generalization.explainers import demonstrated
from jaxhom.generalization.explanation import Explanation
from jaxhom.generalization.votes import Votes
from jaxhom.models.mdp import MDP
from jaxhom.models.names import Names
from jaxhom.status import Record

if TYPE_CHECKING:
    from jaxtyping import Array, ArrayLike, Bool, Float, Int


class Generalization(Record):
    """A policy for every state, and where each state's came from.

    Attributes:
      policy: [S, A], rows sum to 1; 0 on actions that are not allowed.
      visited: bool [S], the demonstrated states, absorbing ones included.
      radius: int32 [S], how far the method had to look (steps); 0 on demonstrated states, -1 where nothing was
        found and the policy is uniform.
      support: int32 [S], how many demonstrated states voted; 1 on demonstrated states, 0 where nothing was found.
      undecided: int32 [S], how many demonstrated states had no vote because the bounds on the error of a map to them
        stayed too far apart to tell; 0 for methods that decide nothing.
      status: int32, a `jaxhom.Status`: SOLVED where nothing stayed undecided and the bounds below are as close as asked
        for, or else why not.
      error_lower: scalar, error_lower <= e <= error_upper for the optimal error e of the global program; None for other
        methods.
      error_upper: scalar, likewise.
      explainer: what the method remembers to explain itself, called with the generalization and a state. No part of
        the pytree: whatever comes out of `jax.tree.map`, `jit` or `vmap` has forgotten it.
      state_names: what the model calls its states, for explanations, and action_names its actions; None without names.
        No part of the pytree, likewise.
    """

    policy: Float[Array, "S A"]
    visited: Bool[Array, " S"]
    radius: Int[Array, " S"]
    support: Int[Array, " S"]
    undecided: Int[Array, " S"] | None = None
    status: Int[Array, ""] | None = None
    error_lower: Float[Array, ""] | None = None
    error_upper: Float[Array, ""] | None = None
    explainer: Callable[[Generalization, int], Explanation] | None = dataclasses.field(
        default=None, metadata={"dropped": True}
    )
    state_names: Names | None = dataclasses.field(default=None, metadata={"dropped": True})
    action_names: Names | None = dataclasses.field(default=None, metadata={"dropped": True})

    @checks.eager_where_concrete
    def explain(self, state: Int[ArrayLike, ""]) -> Explanation:
        """Says where a state's policy came from; `print` it, or read its arrays.

        For Algorithm 1 that is which demonstrated states voted, at what radius, through which map from the state's
        local model to theirs, and between which certified bounds the error of such a map lies; or that nothing was
        found. Maps are computed on demand.

        Args:
          state: its number.

        Returns:
          `Explanation`.

        Raises:
          ValueError: if there is no such state, or the generalization has gone through a JAX transformation and no
            longer knows how it was made.
        """
        if self.explainer is None:
            raise ValueError(
                "this generalization no longer knows how it was made: jit, vmap and jax.tree.map drop that; "
                "ask the one that the method returned"
            )
        number = checks.as_host_array("state", state)
        checks.require_shape("state", number, "(), one state", number.ndim == 0)
        number = int(checks.require_integers("state", number, upper=len(self.visited)))
        found = (demonstrated if self.visited[number] else self.explainer)(self, number)
        return found.replace(state_names=self.state_names, action_names=self.action_names)


def extend(mdp: MDP, start: Generalization, votes: Votes, explainer, **more) -> Generalization:
    """The votes where nothing was demonstrated.

    Args:
      mdp: the model.
      start: from `uniform_elsewhere`.
      votes: for all states; those of demonstrated states do not count.
      explainer: what explains the result; None under a trace.
      **more: further fields of the result.
    """
    policy = evidence.policy_of_votes(mdp, votes.policy)[0] if mdp.restricts_actions else votes.policy
    xp = checks.arrays_of(start, votes)
    visited = xp.asarray(start.visited)

    def of_votes(old, new):
        return checks.to_device(xp.where(visited.reshape(-1, *(1,) * (new.ndim - 1)), xp.asarray(old), new))

    return start.replace(
        policy=of_votes(start.policy, policy),
        radius=of_votes(start.radius, votes.radius),
        support=of_votes(start.support, votes.support),
        explainer=explainer,
        **more,
    )
