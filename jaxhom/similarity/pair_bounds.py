"""What is known of ordered pairs of classes, of those alone that have been met."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import jax
import numpy as np

from jaxhom import checks
from jaxhom.similarity.brackets import METHODS, Goal, LocalSimilarity
from jaxhom.status import Status

_SIDES = ("lower", "upper")


class _Rows(NamedTuple):
    """A row for each of Q pairs, by ascending keys, and a last one for pairs that were never met.

    Attributes:
      key: int64 [Q], see `pair_keys`.
      bounds: [Q + 1].
      tried: int64 [Q + 1, kinds], iterations, by kind of goal, that left a pair open.
    """

    key: np.ndarray
    bounds: LocalSimilarity
    tried: np.ndarray


class PairBounds:
    """Bounds of ordered pairs of classes; of pairs that were never met, that the error is not negative.

    What it holds is true at every moment, whatever may interrupt it.

    Args:
      dtype: of the bounds.
    """

    def __init__(self, dtype):
        nothing = LocalSimilarity(
            lower=np.zeros(1, dtype),
            upper=np.full(1, np.inf, dtype),
            iterations=np.zeros(1, np.int32),
            status=np.full(1, Status.SOLVED, np.int32),
        )
        self._rows = _Rows(np.zeros(0, np.int64), nothing, np.zeros((1, 1 + len(METHODS)), np.int64))

    def __len__(self) -> int:
        return len(self._rows.key)

    def pairs(self) -> np.ndarray:
        """int [Q, 2]: those that have been met."""
        return np.stack([self._rows.key >> 32, self._rows.key & 0xFFFFFFFF], axis=1)

    def look_up(self, pairs: np.ndarray) -> LocalSimilarity:
        """Bounds of pairs [P, 2]; the status is that of the last attempt that left the pair open, if there was one."""
        place = self._place(pairs)
        return jax.tree.map(lambda leaf: leaf[place], self._rows.bounds)

    def was_tried(self, pairs: np.ndarray, goal: Goal) -> np.ndarray:
        """bool [P]: whether as many iterations towards a goal of this kind have left the pair open before."""
        return self._rows.tried[self._place(pairs), _kind(goal)] >= goal.max_iterations

    def add(self, pairs: np.ndarray, found: LocalSimilarity, goal: Goal | None = None) -> None:
        """Takes in bounds of different pairs [P, 2]; the better of old and new stay.

        Args:
          pairs: of classes.
          found: their new bounds.
          goal: what was aimed for; None where nothing can be said of another attempt.
        """
        self._insert(pairs[self._place(pairs) == len(self)])
        place, bounds, is_open = self._place(pairs), self._rows.bounds, found.status != Status.SOLVED
        bounds.lower[place] = np.fmax(bounds.lower[place], found.lower)
        bounds.upper[place] = np.fmin(bounds.upper[place], found.upper)
        bounds.iterations[place] = found.iterations
        bounds.status[place] = np.where(is_open, found.status, bounds.status[place])
        if goal is not None:
            self._rows.tried[place[is_open], _kind(goal)] = goal.max_iterations

    def part(self, pairs: np.ndarray) -> PairBounds:
        """What is known of pairs [P, 2] alone; it grows by itself."""
        place = np.unique(self._place(pairs))
        result = PairBounds(self._rows.bounds.lower.dtype)
        result._rows = self._rows_at(self._rows.key[place[place < len(self)]], np.union1d(place, len(self)))
        return result

    def contents(self) -> dict[str, np.ndarray]:
        """All that is known, as plain arrays for `restore`: pairs [Q, 2], the fields of their bounds, and `tried`."""
        fields = {name: leaf[:-1] for name, leaf in dict(self._rows.bounds).items()}
        return {"pairs": self.pairs().astype(np.int32), **fields, "tried": self._rows.tried[:-1]}

    def restore(self, contents: Mapping[str, np.ndarray], num_classes: int) -> None:
        """Fills an empty table with the `contents` of another; `ValueError` where they are none."""
        pairs = checks.require_integers("pairs", contents["pairs"], upper=num_classes)
        checks.require_shape("pairs", pairs, "[Q, 2]", pairs.ndim == 2 and pairs.shape[1] == 2)
        keys, count = pair_keys(pairs), len(pairs)
        is_next = np.append(True, keys[1:] > keys[:-1])[:count]
        checks.require_all("pairs", pairs, is_next, "must come once each, in ascending order")
        lower, upper = (_bounds_in(name, contents[name], self._rows.bounds.lower.dtype, count) for name in _SIDES)
        checks.require_all("lower", lower, (lower >= 0) & (lower < np.inf), "must be finite and not negative")
        iterations, status, tried = (
            checks.require_integers(name, contents[name]) for name in ("iterations", "status", "tried")
        )
        for name, array in (("iterations", iterations), ("status", status)):
            checks.require_shape(name, array, f"({count},)", array.shape == (count,))
        checks.require_integers("status", status, upper=len(Status))
        checks.require_shape("tried", tried, f"({count}, {1 + len(METHODS)})", tried.shape == (count, 1 + len(METHODS)))
        bounds = LocalSimilarity(
            lower=lower, upper=upper, iterations=iterations.astype(np.int32), status=status.astype(np.int32)
        )
        bounds, last = jax.tree.map(np.append, bounds, self._rows.bounds), self._rows.tried
        self._rows = _Rows(keys, bounds, np.concatenate([tried, last]))

    def _insert(self, pairs: np.ndarray) -> None:
        """Makes rows for pairs that have none; all at once, or not at all."""
        if len(pairs):
            keys = np.append(self._rows.key, pair_keys(pairs))
            order = np.argsort(keys, kind="stable")
            nothing = len(self)
            source = np.append(np.minimum(order, nothing), nothing)
            self._rows = self._rows_at(keys[order], source)

    def _rows_at(self, key: np.ndarray, place: np.ndarray) -> _Rows:
        """Copies of rows, under keys of which the last row has none."""
        return _Rows(key, jax.tree.map(lambda leaf: leaf[place], self._rows.bounds), self._rows.tried[place])

    def _place(self, pairs: np.ndarray) -> np.ndarray:
        """The row of each pair, the last one where it was never met."""
        keys, known = pair_keys(pairs), self._rows.key
        place = np.searchsorted(known, keys)
        found = np.append(known, -1)[place] == keys
        return np.where(found, place, len(known))


def pair_keys(pairs: np.ndarray) -> np.ndarray:
    """int64 [P]: one number for each pair [P, 2] of classes, that stays as classes are added."""
    return (pairs[:, 0].astype(np.int64) << 32) | pairs[:, 1]


def pair_set(pairs: np.ndarray) -> np.ndarray:
    """The different ones of pairs [P, 2], in the order of their keys."""
    _, first = np.unique(pair_keys(pairs), return_index=True)
    return pairs[first]


def _bounds_in(name: str, array: np.ndarray, dtype, count: int) -> np.ndarray:
    """Bounds [Q] of one side, in the model's type."""
    if array.dtype != dtype:
        raise ValueError(f"{name} must hold numbers of type {dtype}, got dtype {array.dtype}")
    checks.require_shape(name, array, f"({count},)", array.shape == (count,))
    checks.require_all(name, array, ~np.isnan(array), "must not be NaN")
    return array


def _kind(goal: Goal) -> int:
    return 0 if goal.decides else 1 + METHODS.index(goal.method)
