"""A soft homomorphism from one model to another: eq. (7) of Boularias and Chaib-draa 2010 with the least error."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np

from jaxhom import checks
from jaxhom.generalization import evidence
from jaxhom.generalization.global_lp import GlobalHomomorphismProblem, HostProblem, centred
from jaxhom.generalization.global_map import Effort, map_in_program, map_on_host
from jaxhom.models.inputs import check_labels, check_policy
from jaxhom.models.mdp import MDP
from jaxhom.status import Record

if TYPE_CHECKING:
    from jaxtyping import Array, ArrayLike, Float, Int


class SoftHomomorphism(Record):
    """A map from all S states of a source model to the S' states of a target, from `soft_homomorphism`.

    Attributes:
      map: f [S, S'], rows sum to 1. Values of the target are carried over by `found.map @ value`.
      error_lower: scalar, error_lower <= e <= error_upper for the least error e of all maps.
      error_upper: scalar, likewise; the map's own error is no more.
      status: int32, a `jaxhom.Status`: SOLVED where the bounds are as close as asked for.
      source: the model that is mapped.
      target: the model that it is mapped to.
    """

    map: Float[Array, "S T"]
    error_lower: Float[Array, ""]
    error_upper: Float[Array, ""]
    status: Int[Array, ""]
    source: MDP
    target: MDP

    @checks.eager_where_concrete
    def pull_back(self, policy: Float[ArrayLike, "T A"] | Int[ArrayLike, " T"]) -> Float[Array, "S A"]:
        """A policy of the target as one of the source: sum_k f(s, k) pi'(k, a), over the actions allowed in s.

        Works under `jit`, `vmap` and `grad`, in the map and the policy.

        Args:
          policy: [S', A], rows sum to 1; integers [S'] are the actions of one that is deterministic.

        Returns:
          [S, A], rows sum to 1; uniform where nothing is left of it.

        Raises:
          ValueError: if it is no policy of the target.
        """
        policy = check_policy(self.target, policy, batch=False)
        xp = checks.arrays_of(self.map, policy)
        found, _ = evidence.policy_of_votes(self.source, xp.asarray(self.map) @ xp.asarray(policy))
        return checks.to_device(found, self.source.dtype)


def map_to_model(source: MDP, target: MDP, labels, target_labels, label_weight, effort: Effort) -> SoftHomomorphism:
    """The map of least error between two models, concrete or traced; see `soft_homomorphism`."""
    _require_pair(source, target)
    kept, kept_in_target = _labels_of_pair(source, target, labels, target_labels, label_weight)
    shape = (source.num_states, target.num_states)
    if checks.is_traced(source, target, kept, kept_in_target):
        problem = GlobalHomomorphismProblem(
            mdp=source,
            target=target.transition,
            pinned=jnp.zeros(shape, bool),
            exists=jnp.ones(shape[1], bool),
            labels=None if kept is None else jnp.asarray(kept),
            target_labels=None if kept is None else jnp.asarray(kept_in_target),
        )
        found = map_in_program(problem, effort)
    else:
        found = map_on_host(_host_problem(source, target, kept, kept_in_target), effort)
    return SoftHomomorphism(
        map=checks.to_device(found.mapping, source.dtype),
        error_lower=checks.to_device(found.lower, source.dtype),
        error_upper=checks.to_device(found.upper, source.dtype),
        status=checks.to_device(found.status, jnp.int32),
        source=source,
        target=target,
    )


def _host_problem(source: MDP, target: MDP, kept, kept_in_target) -> HostProblem:
    rows = target.dynamics.host_matrix(np.asarray(target.probability))
    tensor = rows if isinstance(rows, np.ndarray) else rows.toarray()
    return HostProblem(
        mdp=source,
        target=tensor.reshape(target.num_states, target.num_actions, -1),
        pinned=np.zeros((source.num_states, target.num_states), bool),
        exists=np.ones(target.num_states, bool),
        labels=kept,
        target_labels=kept_in_target,
        rows=source.dynamics.host_matrix(np.asarray(source.probability)),
    )


def _require_pair(source: MDP, target: MDP) -> None:
    for name in ("num_actions", "dtype"):
        here, there = getattr(source, name), getattr(target, name)
        if here != there:
            raise ValueError(f"the target has {name} {there}, the source {here}")


def _labels_of_pair(source: MDP, target: MDP, labels, target_labels, label_weight):
    """What the map has to keep, [S, A, L] and [S', A, L], or None twice: the labels, and which actions are refused."""
    if (labels is None) != (target_labels is None):
        raise ValueError("labels and target_labels must be given together")
    pairs = []
    if labels is not None:
        here = check_labels(source, labels, label_weight)
        there = check_labels(target, target_labels, label_weight, "target_labels")
        expected = f"({target.num_states}, {target.num_actions}, {here.shape[-1]}), as many labels as the source"
        checks.require_shape("target_labels", there, expected, here.shape[-1] == there.shape[-1])
        pairs.append((here, there))
    if source.restricts_actions or target.restricts_actions:
        pairs.append((_refused(source), _refused(target)))
    if not pairs:
        return None, None
    xp = jnp if checks.is_traced(pairs) else np
    return centred(*(xp.concatenate([xp.asarray(one) for one in side], axis=-1) for side in zip(*pairs, strict=True)))


def _refused(mdp: MDP):
    """[S, A, 1]: 1 where an action is not allowed."""
    xp = jnp if checks.is_traced(mdp.allowed) else np
    return 1.0 - xp.asarray(mdp.allowed, mdp.dtype)[..., None]
