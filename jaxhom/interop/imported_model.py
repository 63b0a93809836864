"""What the readers of other people's models return, and the one way there: from entries (s, a, z, p, r) to a model.

    r(s, a) = sum_z T(s, a, z) r(s, a, z)        an expected reward per pair, which is all that values depend on

*Ends.* A state without any action becomes absorbing, with reward and features 0: every action stays there. Where states
have some actions and lack others, the latter are not allowed.

*Sums.* Rows that miss 1 by no more than `MDP.from_successors` accepts are divided by their sums, and a remark says so.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Hashable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxhom import checks
from jaxhom.domains.tile_map import TileMap
from jaxhom.interop.successor_rows import checked_rows, model_of_rows, row_sums, rows_of_entries
from jaxhom.models.mdp import MDP
from jaxhom.status import Record

if TYPE_CHECKING:
    from jaxtyping import Array, Bool, Float, Int, Num

_ROUNDING = 1e-12  # of a sum that is worth a remark


class ImportedModel(Record):
    """A model that came from a file or an object of another kind, with what else its source says.

    Attributes:
      mdp: the model.
      reward: float [S, A], expected reward of a step; None where the source has none.
      terminal: bool [S], states in which episodes have ended: they are absorbing; None if there are none.
      coordinates: [S, D], positions of the states, for pictures and distances; None where they are unknown.
      labels: by name, bool [S]: what the source says of the states.
      domain: the model on its map, for pictures; None where there is no map.
      remarks: what was ignored or mended, in words.
    """

    mdp: MDP
    reward: Float[Array, "S A"] | None = None
    terminal: Bool[np.ndarray, " S"] | None = None
    coordinates: Num[np.ndarray, "S D"] | None = None
    labels: dict[str, Bool[np.ndarray, " S"]] = dataclasses.field(default_factory=dict)
    domain: TileMap | None = None
    remarks: tuple[str, ...] = dataclasses.field(default=(), metadata={"static": True})

    def _figures(self) -> dict[str, Any]:
        return {name: value for name, value in super()._figures().items() if not (name == "labels" and not value)}

    @property
    def state_names(self) -> tuple[Hashable, ...] | None:
        """The names of the states; None where the source numbers them."""
        return self.mdp.state_names

    @property
    def action_names(self) -> tuple[Hashable, ...] | None:
        """The names of the actions; None where the source numbers them."""
        return self.mdp.action_names


@dataclasses.dataclass(frozen=True, eq=False)
class Entries:
    """Transitions as a list, in any order; entries of one successor add up.

    Attributes:
      state, action, next_state: int [N].
      probability: float [N].
      reward: float [N], or None.
    """

    state: Int[np.ndarray, " N"]
    action: Int[np.ndarray, " N"]
    next_state: Int[np.ndarray, " N"]
    probability: Float[np.ndarray, " N"]
    reward: Float[np.ndarray, " N"] | None = None


def model_of_entries(
    entries: Entries,
    *,
    num_states: int,
    num_actions: int,
    discount: Num[Any, ""],
    initial: Float[np.ndarray, " S"] | None = None,
    features: Float[np.ndarray, "..."] | None = None,
    state_names: Sequence[Hashable] | None = None,
    action_names: Sequence[Hashable] | None = None,
    coordinates: Num[np.ndarray, "S D"] | None = None,
    labels: Mapping[str, Bool[np.ndarray, " S"]] | None = None,
    remarks: Sequence[str] = (),
) -> ImportedModel:
    """Builds the model (see the module's text); pairs without entries are no actions.

    Where `initial` is None episodes start in all states alike that are no end.

    Raises:
      ValueError: naming state and action of the first row that is no distribution, and as `MDP.from_successors`.
    """
    checks.require_slots(num_states, num_actions, 1)
    pair = entries.state * num_actions + entries.action
    exists = np.bincount(pair, minlength=num_states * num_actions).astype(bool).reshape(num_states, num_actions)
    matrix = rows_of_entries(pair, entries.next_state, entries.probability, num_states, num_actions)

    def row_name(row: int) -> str:
        state, action = divmod(row, num_actions)
        return f"probabilities of action {named(action_names, action)} in state {named(state_names, state)}"

    matrix = checked_rows(matrix, exists.ravel(), row_name)
    remarks = [*remarks, *_remarks_on_sums(matrix, exists)]
    reward = None if entries.reward is None else _expected(entries.reward, entries.probability, pair, exists)
    is_end = np.asarray(~exists.any(axis=1))
    if is_end.any():
        remarks.append(f"{counted(is_end.sum(), 'state')} without actions: absorbing")
        (ends,) = np.nonzero(is_end)
        loops = (ends[:, None] * num_actions + np.arange(num_actions)).ravel()
        stay = rows_of_entries(
            loops, np.repeat(ends, num_actions), np.ones(len(loops), matrix.dtype), num_states, num_actions
        )
        matrix, exists = matrix + stay, exists | is_end[:, None]
        if features is not None:
            features = np.where(is_end.reshape(-1, *[1] * (np.ndim(features) - 1)), 0.0, features)
    if initial is None and is_end.any() and not is_end.all():
        initial = ~is_end / (~is_end).sum()
    if initial is not None:
        is_end &= np.asarray(initial) == 0  # an episode cannot have ended where it starts
    mdp = model_of_rows(
        matrix,
        num_actions,
        discount=discount,
        initial=initial,
        features=features,
        allowed=None if exists.all() else exists,
        state_names=state_names,
        action_names=action_names,
    )
    return ImportedModel(
        mdp=mdp,
        reward=None if reward is None else checks.to_device(reward, mdp.dtype),
        terminal=is_end if is_end.any() else None,
        coordinates=coordinates,
        labels=dict(labels or {}),
        remarks=tuple(remarks),
    )


def named(names: Sequence[Hashable] | None, number: int) -> str:
    """What a message calls a state or action."""
    return str(number) if names is None else checks.in_one_line(names[number])


def counted(count: int, noun: str) -> str:
    """`1 state`, `2 states`."""
    return f"{count} {noun}{'s' * bool(count != 1)}"


def _remarks_on_sums(matrix: Any, exists: np.ndarray) -> list[str]:
    off = np.abs(row_sums(matrix) - 1.0)[exists.ravel()]
    count = int((off > _ROUNDING).sum())
    if not count:
        return []
    return [f"{counted(count, 'row')} of probabilities missed 1 by up to {off.max():.0e}: divided by their sums"]


def _expected(reward: np.ndarray, probability: np.ndarray, pair: np.ndarray, exists: np.ndarray) -> np.ndarray:
    """float [S, A]; 0 where there is no action."""
    total = np.bincount(pair, probability, minlength=exists.size)
    earned = np.bincount(pair, probability * reward, minlength=exists.size)
    return np.divide(earned, total, out=np.zeros(exists.size), where=total > 0).reshape(exists.shape)
