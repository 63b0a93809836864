"""What is known of ordered pairs of classes, of those alone that have been met."""

from __future__ import annotations

import jax
import numpy as np

from jaxhom.similarity.brackets import METHODS, Goal, LocalSimilarity
from jaxhom.status import Status


class PairBounds:
    """Bounds of ordered pairs of classes; of pairs that were never met, that the error is not negative.

    Args:
      dtype: of the bounds.
    """

    def __init__(self, dtype):
        self._key = np.zeros(0, np.int64)
        # One more row than there are keys, for pairs that were never met.
        self._bounds = LocalSimilarity(
            lower=np.zeros(1, dtype),
            upper=np.full(1, np.inf, dtype),
            iterations=np.zeros(1, np.int32),
            status=np.full(1, Status.SOLVED, np.int32),
        )
        self._tried = np.zeros((1, 1 + len(METHODS)), np.int64)  # iterations, by kind of goal, that left a pair open

    def __len__(self) -> int:
        return len(self._key)

    def pairs(self) -> np.ndarray:
        """int [Q, 2]: those that have been met."""
        return np.stack([self._key >> 32, self._key & 0xFFFFFFFF], axis=1)

    def look_up(self, pairs: np.ndarray) -> LocalSimilarity:
        """Bounds of pairs [P, 2]; the status is that of the last attempt that left the pair open, if there was one."""
        place = self._place(pairs)
        return jax.tree.map(lambda leaf: leaf[place], self._bounds)

    def was_tried(self, pairs: np.ndarray, goal: Goal) -> np.ndarray:
        """bool [P]: whether as many iterations towards a goal of this kind have left the pair open before."""
        return self._tried[self._place(pairs), _kind(goal)] >= goal.max_iterations

    def add(self, pairs: np.ndarray, found: LocalSimilarity, goal: Goal | None = None) -> None:
        """Takes in bounds of different pairs [P, 2]; the better of old and new stay.

        Args:
          pairs: of classes.
          found: their new bounds.
          goal: what was aimed for; None where nothing can be said of another attempt.
        """
        fresh = self._place(pairs) == len(self)
        self._insert(pairs[fresh])
        place, bounds, is_open = self._place(pairs), self._bounds, found.status != Status.SOLVED
        bounds.lower[place] = np.fmax(bounds.lower[place], found.lower)
        bounds.upper[place] = np.fmin(bounds.upper[place], found.upper)
        bounds.iterations[place] = found.iterations
        bounds.status[place] = np.where(is_open, found.status, bounds.status[place])
        if goal is not None:
            self._tried[place[is_open], _kind(goal)] = goal.max_iterations

    def _insert(self, pairs: np.ndarray) -> None:
        """Makes rows for pairs that have none."""
        keys = np.append(self._key, pair_keys(pairs))
        order = np.argsort(keys)
        nothing = len(self)
        source = np.append(np.arange(nothing), np.full(len(pairs), nothing))[order]
        source = np.append(source, nothing)
        self._key = keys[order]
        self._bounds = jax.tree.map(lambda leaf: leaf[source], self._bounds)
        self._tried = self._tried[source]

    def _place(self, pairs: np.ndarray) -> np.ndarray:
        """The row of each pair, the last one where it was never met."""
        keys = pair_keys(pairs)
        place = np.searchsorted(self._key, keys)
        found = np.append(self._key, -1)[place] == keys
        return np.where(found, place, len(self))


def pair_keys(pairs: np.ndarray) -> np.ndarray:
    """int64 [P]: one number for each pair [P, 2] of classes, that stays as classes are added."""
    return (pairs[:, 0].astype(np.int64) << 32) | pairs[:, 1]


def pair_set(pairs: np.ndarray) -> np.ndarray:
    """The different ones of pairs [P, 2], in the order of their keys."""
    _, first = np.unique(pair_keys(pairs), return_index=True)
    return pairs[first]


def _kind(goal: Goal) -> int:
    return 0 if goal.decides else 1 + METHODS.index(goal.method)
