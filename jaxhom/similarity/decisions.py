"""Which pairs are similar, e <= epsilon, as the bounds on their errors have it: pairs of states, and of all classes."""

from __future__ import annotations

import numpy as np

from jaxhom import checks
from jaxhom.similarity.brackets import Goal, LocalSimilarity
from jaxhom.status import Record, Status

MAX_CLASSES = 4096  # whose pairs are all decided at once: 1.5 GB of bounds, and hours of programs
_PAIR_BYTES = 96  # of bounds, keys and what was tried, and of their copies while pairs are added


class Decisions(Record):
    """Which of P pairs of states are similar.

    Attributes:
      similar: bool [P].
      status: int32 [P], a `jaxhom.Status`: SOLVED where the bounds decide, or else why they do not.
      error: [P], upper bounds on the errors of similar pairs that are as close as asked for; None if not asked for.
    """

    similar: np.ndarray
    status: np.ndarray
    error: np.ndarray | None = None


class Relation(Record):
    """Which classes of a model's states are similar: state s is to s' if similar[label[s], label[s']].

    Attributes:
      label: int32 [S], the class of each state.
      similar: bool [C, C]. Pairs that could not be decided count as different.
      status: int32 [C, C], a `jaxhom.Status`: SOLVED where the bounds decide, or else why they do not.
      error: [C, C], as in `Decisions`; None if not asked for.
      renaming: int [C, C, A], which action of the target stands for each of the source's, of similar pairs; None where
        every action is itself.
    """

    label: np.ndarray
    similar: np.ndarray
    status: np.ndarray
    error: np.ndarray | None = None
    renaming: np.ndarray | None = None

    @property
    def undecided(self) -> np.ndarray:
        """bool [C, C], the pairs whose error could not be told from the threshold."""
        return self.status != Status.SOLVED


def is_similar(known: LocalSimilarity, goal: Goal) -> np.ndarray:
    """bool [P]: which pairs the bounds show to be similar."""
    return known.upper <= goal.threshold + goal.tolerance


def is_far(known: LocalSimilarity, goal: Goal) -> np.ndarray:
    """bool [P]: which pairs the bounds show to be different."""
    return (known.lower > goal.threshold) & ~is_similar(known, goal)


def decisions_of(known: LocalSimilarity, goal: Goal, back: LocalSimilarity | None = None) -> Decisions:
    """What bounds say of pairs [P]; of both directions where those of the pairs the other way round are given."""
    similar, far, status = is_similar(known, goal), is_far(known, goal), known.status
    if back is not None:
        status = np.where(similar, back.status, status)
        similar, far = similar & is_similar(back, goal), far | is_far(back, goal)
    return Decisions(similar=similar, status=honest_status(similar | far, status))


def honest_status(is_met: np.ndarray, status: np.ndarray) -> np.ndarray:
    """The status of bounds that are wider than they were found; where that keeps them open, rounding is to blame."""
    return np.where(is_met, Status.SOLVED, np.where(status == Status.SOLVED, Status.STALLED, status)).astype(np.int32)


def every_pair(num_classes: int) -> np.ndarray:
    """int [C^2, 2]: all ordered pairs of classes, the first class first; `ValueError` where they are too many."""
    if num_classes > MAX_CLASSES:
        count = num_classes**2
        raise ValueError(
            f"the model has {num_classes} classes of local models: their {count} ordered pairs would take "
            f"{count * _PAIR_BYTES / 1e9:.1f} GB, and more than {MAX_CLASSES} classes are not decided beforehand; "
            "outside jit, vmap and grad only pairs that are met are decided"
        )
    return np.indices((num_classes,) * 2).reshape(2, -1).T


def require_decided(is_open: np.ndarray, threshold: float, tolerance: float, how: str = "") -> None:
    """Raises `ValueError` where pairs are still to be solved for a threshold; `how` a table has to be completed."""
    if is_open.any():
        raise ValueError(
            f"the table has not decided {int(is_open.sum())} of {len(is_open)} pairs of classes for threshold "
            f"{checks.in_one_line(threshold)} and tolerance {checks.in_one_line(tolerance)}: call "
            f"table.complete(threshold={checks.in_one_line(threshold)}{how}) first, outside jit, vmap and grad"
        )
