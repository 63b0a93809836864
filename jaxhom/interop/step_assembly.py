"""Demonstrations from rows of checked states and actions, all at once: files have millions of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from jaxhom import checks
from jaxhom.interop.import_reports import ImportReport, require_some
from jaxhom.interop.step_order import Rows
from jaxhom.models.demonstrations import Demonstrations
from jaxhom.models.trajectories import require_slots


def assembled(
    rows: Rows, columns: Mapping[str, np.ndarray], has_action: np.ndarray, names: Sequence[int | str]
) -> tuple[Demonstrations, ImportReport]:
    """The demonstrations of rows with actions.

    Args:
      rows: the order of T rows, and where M episodes begin.
      columns: indices [T] in the roles `state` and `action`, and `next_state`, if known; flags.
      has_action: bool [T], False on final observations.
      names: M, what the report calls the episodes.

    Raises:
      ValueError: if no episode has an action, or they are too many steps when padded to the longest.
    """
    counts = np.diff(np.append(rows.first, len(rows.order)))
    last = rows.order[rows.first + counts - 1]
    is_observed = ~has_action[last]  # the last row is a final observation
    length, is_kept = counts - is_observed, counts > is_observed
    dropped = tuple((names[i], "it has no actions") for i in np.flatnonzero(~is_kept).tolist())
    require_some(int(is_kept.sum()), dropped)
    follows = columns.get("next_state", np.full(len(has_action), -1))
    final = np.where(is_observed, columns["state"][last], follows[last])[is_kept]
    mask = np.arange(_horizon(length[is_kept])) < length[is_kept, None]
    steps = rows.order[(np.repeat(is_kept, counts)) & has_action[rows.order]]
    padded = {role: np.zeros(mask.shape, np.int32) for role in ("state", "action")}
    for role, array in padded.items():
        array[mask] = columns[role][steps]
    demonstrations = Demonstrations(
        states=checks.to_device(padded["state"]),
        actions=checks.to_device(padded["action"]),
        mask=checks.to_device(mask),
        terminated=checks.to_device(rows.terminated(columns)[is_kept]),
        final_states=checks.to_device(final, np.int32),
    )
    return demonstrations, ImportReport(len(mask), len(steps), int((final >= 0).sum()), dropped)


def _horizon(length: np.ndarray) -> int:
    require_slots(len(length), int(length.max()))
    return int(length.max())
