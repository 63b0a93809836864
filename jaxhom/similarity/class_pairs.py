"""LP (9) for pairs of classes of local models: padded to a few sizes, so that few programs are compiled.

What is found is about the local model that stands for its class. Models of one class differ by up to `model_rounding`
in every probability, and in every label by that share of the largest; `ClassPairs.slack` says by how much errors may.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import jax
import numpy as np

from jaxhom.similarity.brackets import Goal, LocalSimilarity, Progress, bracket_errors, find_maps, no_progress
from jaxhom.similarity.classes import ClassBook, model_rounding
from jaxhom.similarity.local_models import LocalModelMaker, LocalModels, is_oversized
from jaxhom.status import Record, Status

if TYPE_CHECKING:
    from jaxtyping import Float, Int

_SMALL = 8  # local models up to this size share one padding
_ALIKE_GROUP = 4  # up to 2^4 states both models of a pair are padded alike
_CHUNK_BYTES = 256 * 2**20  # of local models that are built at a time
_MAX_PRODUCTS = 2e11  # multiplications per pair, a minute or two: large models stop with the bounds that they have
_MAX_MAP_PRODUCTS = 2e10  # the same for a map, which somebody waits for
_MIN_ITERATIONS = 64  # however large
_SAME, _TOO_LARGE = -1, -2  # in place of a size group


class LocalModel(Record):
    """The local model that stands for a class, as relations of the user's get it; NumPy.

    Attributes:
      states: int [n], the states of the model, centre first, then ascending.
      transition: [n, A, n], T^{s,d}; zero where an action is not allowed.
      labels: [n, A, L], what else tells states and actions apart, and last, where some state of the model lacks some
        action, 1 where an action is not allowed; None where there is neither.
    """

    states: Int[np.ndarray, " n"]
    transition: Float[np.ndarray, "n A n"]
    labels: Float[np.ndarray, "n A L"] | None = None


class ClassModels:
    """The local models that stand for classes.

    Args:
      maker: builds local models.
      book: the classes.

    Attributes:
      dtype, num_actions: of the model.
      label_size: as in `LocalModelMaker`.
      has_labels: whether there are labels.
    """

    def __init__(self, maker: LocalModelMaker, book: ClassBook):
        self._maker, self._book = maker, book
        self.dtype, self.num_actions = maker.graph.dtype, maker.graph.num_actions
        self.label_size, self.has_labels = maker.label_size, maker.labels is not None

    @property
    def size(self) -> np.ndarray:
        """int32 [C]: how many states they have."""
        return self._book.size

    def of(self, classes: np.ndarray, width: int) -> LocalModels:
        """The models of classes [Q], padded to a width; each is built once."""
        different, position = np.unique(classes, return_inverse=True)
        models = self._maker.make(self._book.representative[different], width)
        return jax.tree.map(lambda leaf: leaf[position], models)

    def alone(self, number: int, *, is_scaled: bool = False) -> LocalModel:
        """The model of one class, not padded; with labels of at most about 1, if they are to be scaled."""
        found = self.of(np.array([number]), int(self.size[number]))
        labels = self._maker.scaled(found.labels) if is_scaled else found.labels
        return LocalModel(
            states=found.members[0],
            transition=found.transition[0],
            labels=None if labels is None else labels[0],
        )

    def of_pairs(self, pairs: np.ndarray) -> Iterator[tuple[np.ndarray, LocalModels, LocalModels]]:
        """Numbers of different pairs of classes [Q, 2] of a few sizes, and their models; none that are too large."""
        groups = _Groups(pairs, self)
        is_small = ~is_oversized(self.size, self.num_actions)[pairs]
        of_class = np.where(is_small, groups.of_class[pairs], _TOO_LARGE)
        groups.of_pair = np.where(groups.of_pair == _SAME, of_class, groups.of_pair)
        for members, widths in groups.members():
            for index in self.chunks(members, widths):
                yield index, *(self.of(classes, width) for classes, width in zip(pairs[index].T, widths, strict=True))

    def chunks(self, members: np.ndarray, widths: tuple[int, int]) -> list[np.ndarray]:
        """Numbers of pairs of models of so many states, as many at a time as memory allows."""
        size = max(widths) ** 2 * self.num_actions * np.dtype(self.dtype).itemsize
        chunk = max(1, _CHUNK_BYTES // size)
        return np.split(members, range(chunk, len(members), chunk))


class ClassPairs:
    """Solves LP (9) between classes.

    Args:
      models: those that stand for the classes.
      anchored: require that the centre is mapped to the centre.
      iterates: as in `bracket_errors`.
    """

    has_maps = True

    def __init__(self, models: ClassModels, anchored: bool, *, iterates: bool = True):
        self._models, self._anchored, self._iterates = models, anchored, iterates
        self.dtype, self._num_actions = models.dtype, models.num_actions
        self.num_solved = 0
        self.most = 2.0 * models.label_size if models.has_labels else 1.0  # that any map can be off by

    def brackets(self, pairs: np.ndarray, goal: Goal, progress: Progress = no_progress) -> LocalSimilarity:
        """Bounds for different ordered pairs of classes [Q, 2]; a class against itself has an isomorphism."""
        groups = _Groups(pairs, self._models)
        result = self._without_programs(groups)
        progress(int((~groups.to_solve).sum()))
        for members, widths in groups.members():
            for index in self._models.chunks(members, widths):
                models = self._pair(pairs[index], widths)
                limited = self._limited(goal, widths, _MAX_PRODUCTS)
                found = bracket_errors(**models, goal=limited, iterates=self._iterates, progress=progress)
                jax.tree.map(lambda place, new, index=index: np.put(place, index, new), result, found)
        self.num_solved += int((result.iterations > 0).sum())
        return result

    def map_of(self, pair: np.ndarray, goal: Goal) -> tuple[LocalSimilarity, np.ndarray]:
        """Bounds [1] for one pair of classes, and a map [n, m] whose own error is at most the upper one."""
        groups = _Groups(pair[None], self._models)
        n, m = self._models.size[pair]
        if not groups.to_solve[0]:  # the identity; or, where models are too large, everything to the centre
            f = np.eye(n, m, dtype=self.dtype) if groups.of_pair[0, 0] == _SAME else np.eye(1, m, dtype=self.dtype)
            return self._without_programs(groups), np.broadcast_to(f, (n, m))
        ((_, widths),) = groups.members()
        self.num_solved += 1
        found, maps = find_maps(**self._pair(pair[None], widths), goal=self._limited(goal, widths, _MAX_MAP_PRODUCTS))
        return found, maps[0, :n, :m]

    def slack(self, pairs: np.ndarray) -> np.ndarray:
        """[Q]: how far the errors of other members of two classes can lie from those that were solved for.

        Within a class that is a quantum; nothing where a model is too large to have company in its class.
        """
        sizes = self._models.size[pairs]
        slack = self._slack_of(sizes.max(axis=1, initial=0))
        slack = np.where(pairs[:, 0] == pairs[:, 1], model_rounding(self.dtype) * self._models.label_size, slack)
        return np.where(is_oversized(sizes, self._num_actions).any(axis=1), 0.0, slack).astype(self.dtype)

    def _slack_of(self, size):
        """The slack of models of up to so many states: a row of T f or f T' sums as many, labels are two at a time."""
        return model_rounding(self.dtype) * np.maximum(2.0 + size, 2.0 * self._models.label_size)

    def tolerance(self, goal: Goal, slack):
        """What bounds have to reach before they are widened by `slack` on both sides: for decisions, which are about
        the models that stand for their classes, they are not (in float32 it alone may exceed the tolerance).
        """
        return goal.tolerance if goal.decides else np.maximum(goal.tolerance - 2.0 * slack, 0.5 * goal.tolerance)

    def _limited(self, goal: Goal, widths: tuple[int, int], products: float) -> Goal:
        """The goal for models of so many states, with no more iterations than so many multiplications allow."""
        n, m = widths
        affordable = max(products / (2.0 * self._num_actions * n * m * (n + m)), _MIN_ITERATIONS)
        slack = self._slack_of(max(widths))
        limit = int(min(goal.max_iterations, affordable))
        return goal._replace(tolerance=float(self.tolerance(goal, slack)), max_iterations=limit)

    def _without_programs(self, groups: _Groups) -> LocalSimilarity:
        """What is known beforehand, which for pairs to be solved is nothing."""
        group, count = groups.of_pair[:, 0], len(groups.of_pair)
        return LocalSimilarity(
            lower=np.zeros(count, self.dtype),
            upper=np.where(group == _SAME, 0.0, self.most).astype(self.dtype),
            iterations=np.zeros(count, np.int32),
            status=np.where(group == _TOO_LARGE, Status.ITERATION_LIMIT, Status.SOLVED).astype(np.int32),
        )

    def _pair(self, pairs: np.ndarray, widths: tuple[int, int]) -> dict:
        """The models of pairs [Q, 2], as arguments of `bracket_errors`."""
        different, numbers = zip(*(np.unique(classes, return_inverse=True) for classes in pairs.T), strict=True)
        source, target = (self._models.of(classes, width) for classes, width in zip(different, widths, strict=True))
        return {
            "source": source.transition,
            "target": target.transition,
            "source_size": source.size,
            "target_size": target.size,
            "source_labels": source.labels,
            "target_labels": target.labels,
            "anchored": self._anchored,
            "pairs": np.stack(numbers, axis=1),
        }

    def renamings(self, pairs: np.ndarray) -> None:
        """None: every action stands for itself."""
        del pairs


class _Groups:
    """The sizes to which the models of pairs of classes [Q, 2] are padded.

    Both sides alike where they are small, so that few shapes are compiled; each to its own where one is large. A group
    is as wide as its largest class, of all that are known: one width for a model's grids of five states, say.

    Attributes:
      of_class: int [C], the size group of every class.
      of_pair: int [Q, 2], the size groups; `_SAME` or `_TOO_LARGE` where there is nothing to solve.
    """

    def __init__(self, pairs: np.ndarray, models: ClassModels):
        self._size = size = models.size
        self.of_class = np.ceil(np.log2(np.maximum(size, _SMALL))).astype(int)
        groups = self.of_class[pairs]
        larger = groups.max(axis=1, keepdims=True)
        groups = np.where(larger <= _ALIKE_GROUP, larger, groups)
        too_large = is_oversized(size, models.num_actions)[pairs].any(axis=1, keepdims=True)
        groups = np.where(too_large, _TOO_LARGE, groups)
        self.of_pair = np.where(pairs[:, :1] == pairs[:, 1:], _SAME, groups)

    @property
    def to_solve(self) -> np.ndarray:
        """bool [Q]: the pairs that are neither the same nor too large."""
        return self.of_pair[:, 0] >= 0

    def members(self):
        """Numbers of the pairs of each padding, and its widths (n, m)."""
        for group in np.unique(self.of_pair[self.to_solve], axis=0):
            (index,) = np.nonzero((self.of_pair == group).all(axis=1))
            yield index, tuple(int(self._size[self.of_class <= side].max()) for side in group)
