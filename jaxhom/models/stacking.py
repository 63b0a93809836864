"""Several models as one, for `jax.vmap`: every array gains a leading axis.

Models of one shape mostly have arrays of the same sizes (`list_sizes`). Where they do not, the lists of successors are
made anew in the sizes of the largest; the transitions stay what they are.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom import checks
from jaxhom.models.inputs import as_model
from jaxhom.models.list_sizes import common_sizes
from jaxhom.models.mdp import MDP
from jaxhom.models.successor_lists import SuccessorLists
from jaxhom.status import Record

if TYPE_CHECKING:
    from jaxtyping import Array


def stack_models(models: Iterable[MDP]) -> MDP:
    """Stacks B models of one shape for `jax.vmap`: maps of one size, or one map in variants.

    Every array of the result has a leading axis [B]: `initial` [B, S], `features` [B, S, A, K], `discount` [B]. It is
    no model to call functions with, but an argument for `jax.vmap(f)(stacked)`, in which `f` is given one model. There
    it is a model whose graph is traced. What works on one works: `optimal_policy`, `occupancy`, `feature_expectations`,
    `policy_value`, `sample_demonstrations`, `empirical_policy`, the evaluations, and `lpal` up to 4,096 states. What
    searches the graph on the host, such as `soft_local_homomorphism`, refuses.

    Args:
      models: B of them, one at least, or what has one as `.mdp`. They have the same S, A, K, type and layout; numbers,
        successors, actions that are not allowed and discounts may differ. N, the largest number of successors, may too:
        it becomes the largest of all. Under `jit`, `vmap` and `grad` numbers may be traced, and graphs only where the
        arrays have the same sizes already.

    Returns:
      One `MDP` pytree with leaves [B, ...]. `jax.tree.map(lambda leaf: leaf[b], stacked)` is model b again, in
      arrays of those sizes.

    Raises:
      ValueError: if there is no model, or naming the first one that does not fit, and in what; if graphs are traced.

    Example:
      >>> import jax
      >>> from jaxhom import gridworld, optimal_policy
      >>> stacked = stack_models([gridworld(5, noise=noise, discount=0.9) for noise in (0.0, 0.3, 0.6)])
      >>> reward = jnp.zeros((25, 4)).at[24].set(1.0)
      >>> value = jax.vmap(lambda mdp: optimal_policy(mdp, reward).value[0])(stacked)
      >>> print(*(round(float(v), 3) for v in value))
      4.305 2.744 1.164
    """
    stacked = as_models(models, "a stack")
    require_alike(stacked, _traits)
    restricts = any(model.restricts_actions for model in stacked)
    stacked = [dataclasses.replace(model, restricts_actions=restricts) for model in _in_common_sizes(stacked)]
    return jax.tree.map(_stack, *stacked)


def as_models(models: Any, what: str) -> list[MDP]:
    """Several models, each as it is or as what has one as `.mdp`.

    Raises:
      ValueError: if they are not several, or none, of which `what` ("a stack") cannot be made; naming the first that is
        no model.
    """
    if isinstance(models, Record) or not isinstance(models, Iterable):
        raise ValueError(f"models must be several, in a list for one, got {type(models).__name__}")
    found = []
    for number, model in enumerate(models):
        try:
            found.append(as_model(model))
        except ValueError as error:
            raise ValueError(f"models[{number}]: {error}") from None
    if not found:
        raise ValueError(f"models is empty: {what} needs one at least")
    return found


def require_alike(models: list[MDP], traits: Callable[[MDP], dict[str, Any]]) -> None:
    """Raises unless every model has the traits of the first one, naming the first that does not."""
    first = traits(models[0])
    for number, model in enumerate(models):
        for name, trait in traits(model).items():
            if trait != first[name]:
                raise ValueError(f"models[{number}] has {name} {trait}, models[0] has {first[name]}")


def _traits(mdp: MDP) -> dict[str, Any]:
    return {
        "num_states": mdp.num_states,
        "num_actions": mdp.num_actions,
        "num_features": mdp.num_features,
        "dtype": str(mdp.dtype),
        "layout": repr(mdp.dynamics.layout),
    }


def _in_common_sizes(models: list[MDP]) -> list[MDP]:
    lists = [model.dynamics for model in models if isinstance(model.dynamics, SuccessorLists)]
    sizes = common_sizes(one.sizes for one in lists) if lists else None
    if all(one.sizes == sizes for one in lists):
        return models
    for number, one in enumerate(lists):
        if checks.is_traced(one.next_state, one.predecessors):
            raise ValueError(f"models[{number}] has a traced graph of other sizes: stack outside jit, vmap and grad")
    return [dataclasses.replace(model, dynamics=one.in_sizes(sizes)) for model, one in zip(models, lists, strict=True)]


def _stack(*leaves: Array) -> Array:
    """Concrete ones on the host: nothing is compiled for their shape."""
    if checks.is_traced(leaves):
        return jnp.stack(leaves)
    return checks.to_device(np.stack([np.asarray(leaf) for leaf in leaves]))
