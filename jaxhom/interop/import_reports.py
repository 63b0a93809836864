"""What every reader of trajectories ends with: the demonstrations, and a report of what was dropped on the way."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from jaxhom.models.demonstrations import Demonstrations
from jaxhom.status import summary


@dataclasses.dataclass(frozen=True)
class ImportReport:
    """What was read and what was dropped; `str` gives it in words.

    Attributes:
      episodes: episodes that were kept, M.
      steps: steps in them.
      final_observations: how many of them end with an observation after the last action, their final state.
      dropped: pairs (episode, reason): the position, counted from 0, or the CSV file's name of an episode that was
        dropped altogether.
      ambiguous: of states without actions, the steps that several actions could have been: (episode, step, actions).
        They are hidden, unless the report's reader asked for the likeliest.
      unread: names of what a file or a table held beside that, and was not needed, such as rewards.
    """

    episodes: int
    steps: int
    final_observations: int
    dropped: tuple[tuple[int | str, str], ...]
    ambiguous: tuple[tuple[int | str, int, tuple[int, ...]], ...] = ()
    unread: tuple[str, ...] = ()

    def __repr__(self) -> str:
        return summary(type(self).__name__, dict(vars(self)))

    def __str__(self) -> str:
        lines = [f"{self.episodes} episodes, {self.steps} steps; {self.final_observations} final observations"]
        lines += [f"episode {episode} dropped: {reason}" for episode, reason in self.dropped]
        if self.ambiguous:
            episode, step, actions = self.ambiguous[0]
            which = f"the first: episode {episode}, step {step}, actions {', '.join(map(str, actions))}"
            lines.append(f"{len(self.ambiguous)} steps could have been several actions; {which}")
        if self.unread:
            lines.append(f"not read: {', '.join(self.unread)}")
        return "\n".join(lines)


def with_report(
    kept: Sequence[tuple[np.ndarray, np.ndarray]],
    dropped: Sequence[tuple[int | str, str]],
    final_observations: int,
    terminated: Sequence[bool] | None = None,
) -> tuple[Demonstrations, ImportReport]:
    """The episodes that were kept as demonstrations, and the report.

    Args:
      kept: per episode its states [H] or [H + 1] and actions [H].
      dropped: which others were not, and why.
      final_observations: how many hold one state more than actions.
      terminated: whether each episode that was kept ended in a terminal state; False for all if None.

    Raises:
      ValueError: if nothing was kept, with the first reason.
    """
    require_some(len(kept), dropped)
    ended = None if terminated is None else np.array(terminated)
    demonstrations = Demonstrations.from_trajectories(kept, terminated=ended)
    steps = sum(len(actions) for _, actions in kept)
    report = ImportReport(
        episodes=len(kept), steps=steps, final_observations=final_observations, dropped=tuple(dropped)
    )
    return demonstrations, report


def require_some(kept: int, dropped: Sequence[tuple[int | str, str]]) -> None:
    """Raises if no episode is left, with the first reason."""
    if not kept:
        if not dropped:
            raise ValueError("there are no episodes")
        raise ValueError(f"none of {len(dropped)} episodes can be used; episode {dropped[0][0]}: {dropped[0][1]}")
