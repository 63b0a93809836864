"""Several models side by side as one, whose parts do not lead to each other.

What is known in one of them then serves the others: demonstrations are given in one part, and whatever compares the
states of one model (local models, global maps, coordinates) compares states of different parts.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np

from jaxhom import checks
from jaxhom.models.demonstrations import Demonstrations, require_demonstrations
from jaxhom.models.mdp import MDP
from jaxhom.models.stacking import as_models, require_alike
from jaxhom.status import Record

if TYPE_CHECKING:
    from jaxtyping import Array, Int


class DisjointUnion(Record):
    """M models as one. Build it with `disjoint_union`.

    Attributes:
      mdp: the model on the states of all parts, part after part.
      offsets: int32 [M], the first state of each part.
    """

    mdp: MDP
    offsets: Int[Array, " M"]

    def states(self, part: int) -> slice:
        """Where a part's states are: `policy[union.states(1)]` are the rows of part 1. Not for traced offsets.

        Raises:
          ValueError: if there is no such part.
        """
        ends = [*checks.as_host_array("offsets", self.offsets).tolist(), self.mdp.num_states]
        number = self._number(part)
        return slice(ends[number], ends[number + 1])

    def place(self, part: int, demonstrations: Demonstrations) -> Demonstrations:
        """The demonstrations in a part's own states as demonstrations in the union. Works under `jit` and `vmap`.

        Raises:
          ValueError: if there is no such part, or naming the first concrete state that it does not have.
        """
        number, demonstrations = self._number(part), require_demonstrations(demonstrations)
        if not checks.is_traced(demonstrations, self.offsets):
            inside = self.states(part)
            _require_states(demonstrations, inside.stop - inside.start)
        xp = checks.arrays_of(demonstrations, self.offsets)
        offset, states = xp.asarray(self.offsets)[number], xp.asarray(demonstrations.states)
        final = xp.asarray(demonstrations.final_states)
        return demonstrations.replace(
            states=checks.to_device(xp.where(xp.asarray(demonstrations.mask), states + offset, 0), jnp.int32),
            final_states=checks.to_device(xp.where(final >= 0, final + offset, final), jnp.int32),
        )

    def _number(self, part: int) -> int:
        number = checks.require_count("part", part, least=0)
        if number >= len(self.offsets):
            raise ValueError(f"part must be below {len(self.offsets)}, got {number}")
        return number


def disjoint_union(models: Iterable[MDP]) -> DisjointUnion:
    """Puts M models side by side, as one whose parts do not lead to each other.

    So demonstrations in one model vote in another, in all that compares states. Nothing of size S x S is made of models
    that are kept as lists. On the host: not under `jit`, `vmap` or `grad`.

    Args:
      models: M of them, one at least, or what has one as `.mdp`. They have the same A, K, type and discount; numbers of
        states, layouts and allowed actions may differ.

    Returns:
      `DisjointUnion`: its `mdp` has the states of all parts, part after part, their transitions, features and allowed
      actions, and starts in each part with probability 1/M. Its layout is chosen anew, as by `MDP.from_successors`.
      Where all parts' states have names, those of the union are pairs (part, name); actions keep names that all share.

    Raises:
      ValueError: if there is no model, or naming the first one that does not fit, and in what, or is traced.

    Example:
      >>> import jaxhom
      >>> shown, other = jaxhom.gridworld(3), jaxhom.gridworld(4)
      >>> union = disjoint_union([shown, other])
      >>> union.mdp.num_states, union.offsets.tolist(), union.states(1)
      (25, [0, 9], slice(9, 25, None))
      >>> walk = jaxhom.Demonstrations.from_trajectories([([0, 1, 2, 5], [3, 3, 1, 1])])
      >>> general = jaxhom.soft_homomorphism(union.mdp, union.place(0, walk), tolerance=1e-2)
      >>> general.policy[union.states(1)].shape
      (16, 4)
    """
    parts = as_models(models, "a union")
    for number, part in enumerate(parts):
        if checks.is_traced(part):
            raise ValueError(f"models[{number}] is traced: unite models outside jit, vmap and grad")
    require_alike(parts, _traits)
    sizes = [part.num_states for part in parts]
    offsets = np.cumsum([0, *sizes[:-1]])
    next_state, probability = _side_by_side([_lists(part) for part in parts], offsets)
    mdp = MDP.from_successors(
        next_state,
        probability,
        discount=np.asarray(parts[0].discount),
        initial=np.concatenate([np.asarray(part.initial) / len(parts) for part in parts]),
        features=np.concatenate([np.asarray(part.features) for part in parts]),
        allowed=np.concatenate([np.asarray(part.allowed) for part in parts]),
        state_names=_state_names(parts),
        action_names=parts[0].action_names if len({part.action_names for part in parts}) == 1 else None,
    )
    return DisjointUnion(mdp=mdp, offsets=checks.to_device(offsets, jnp.int32))


def _traits(mdp: MDP) -> dict[str, Any]:
    return {
        "num_actions": mdp.num_actions,
        "num_features": mdp.num_features,
        "dtype": str(mdp.dtype),
        "discount": float(mdp.discount),
    }


def _state_names(parts: list[MDP]) -> list[tuple[int, Hashable]] | None:
    if any(part.state_names is None for part in parts):
        return None
    return [(number, name) for number, part in enumerate(parts) for name in part.state_names]


def _lists(mdp: MDP) -> tuple[np.ndarray, np.ndarray]:
    """Successors and probabilities [S, A, N] with no slot that all pairs leave empty."""
    probability, next_state = np.asarray(mdp.probability), np.asarray(mdp.next_state)
    width = int((probability > 0).sum(axis=-1).max())
    if width == probability.shape[-1]:
        return next_state, probability
    filled_first = np.argsort(probability <= 0, axis=-1, kind="stable")[..., :width]
    return np.take_along_axis(next_state, filled_first, axis=-1), np.take_along_axis(probability, filled_first, axis=-1)


def _side_by_side(lists: list[tuple[np.ndarray, np.ndarray]], offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The parts' lists as those of the union."""
    width = max(probability.shape[-1] for _, probability in lists)
    shape = (sum(len(probability) for _, probability in lists), *lists[0][1].shape[1:2], width)
    checks.require_slots(*shape)
    next_state, probability = np.zeros(shape, np.int32), np.zeros(shape, lists[0][1].dtype)
    for (successors, numbers), offset in zip(lists, offsets, strict=True):
        block = (slice(offset, offset + len(numbers)), slice(None), slice(numbers.shape[-1]))
        next_state[block], probability[block] = successors + offset, numbers
    return next_state, probability


def _require_states(demonstrations: Demonstrations, num_states: int) -> None:
    states, final = np.asarray(demonstrations.states), np.asarray(demonstrations.final_states)
    message = f"must lie in [0, {num_states}), the part's states"
    inside = (states >= 0) & (states < num_states)
    checks.require_all("states", states, inside | ~np.asarray(demonstrations.mask), f"{message} (trajectory, step)")
    checks.require_all("final_states", final, final < num_states, f"{message} (trajectory)")
