"""LP (9) for pairs of classes of local models: padded to a few sizes, so that few programs are compiled.

What is found is about the local model that stands for its class. Models of one class differ by up to `model_rounding`
in every probability, and `class_slack` says by how much errors may.
"""

from __future__ import annotations

import jax
import numpy as np
from tqdm import tqdm

from jaxhom.similarity.brackets import Goal, LocalSimilarity, bracket_errors, find_maps
from jaxhom.similarity.classes import ClassBook, model_rounding
from jaxhom.similarity.local_models import LocalModelMaker, LocalModels, is_oversized
from jaxhom.status import Status

_SMALL = 8  # local models up to this size share one padding
_ALIKE_GROUP = 4  # up to 2^4 states both models of a pair are padded alike
_CHUNK_BYTES = 256 * 2**20  # of local models that are built at a time
_MAX_PRODUCTS = 2e11  # multiplications per pair, a minute or two: large models stop with the bounds that they have
_MAX_MAP_PRODUCTS = 2e10  # the same for a map, which somebody waits for
_MIN_ITERATIONS = 64  # however large
_SAME, _TOO_LARGE = -1, -2  # in place of a size group


class ClassPairs:
    """Solves LP (9) between classes.

    Args:
      maker: builds their local models.
      book: the classes.
      anchored: require that the centre is mapped to the centre.
    """

    def __init__(self, maker: LocalModelMaker, book: ClassBook, anchored: bool):
        self._maker, self._book, self._anchored = maker, book, anchored
        self.dtype, self._num_actions = maker.graph.dtype, maker.graph.num_actions
        self.num_solved = 0

    def brackets(self, pairs: np.ndarray, goal: Goal, *, progress: bool = False) -> LocalSimilarity:
        """Bounds for different ordered pairs of classes [Q, 2]; a class against itself has an isomorphism."""
        groups = _Groups(pairs, self._book.size, self._num_actions)
        result = self._without_programs(groups)
        self.num_solved += int(groups.to_solve.sum())
        with tqdm(total=len(pairs), desc="similarity", unit="pair", leave=False, disable=not progress) as bar:
            bar.update(int((~groups.to_solve).sum()))
            for members, widths in groups.members():
                size = max(widths) ** 2 * self._num_actions * np.dtype(self.dtype).itemsize
                chunk = max(1, _CHUNK_BYTES // size)
                for index in np.split(members, range(chunk, len(members), chunk)):
                    models = self._pair(pairs[index], widths)
                    limited = self._limited(goal, widths, _MAX_PRODUCTS)
                    found = bracket_errors(**models, goal=limited, progress=bar.update)
                    jax.tree.map(lambda place, new, index=index: np.put(place, index, new), result, found)
        return result

    def map_of(self, pair: np.ndarray, goal: Goal) -> tuple[LocalSimilarity, np.ndarray]:
        """Bounds [1] for one pair of classes, and a map [n, m] whose own error is at most the upper one."""
        groups = _Groups(pair[None], self._book.size, self._num_actions)
        n, m = self._book.size[pair]
        if not groups.to_solve[0]:  # the identity; or, where models are too large, everything to the centre
            f = np.eye(n, m, dtype=self.dtype) if groups.of_pair[0, 0] == _SAME else np.eye(1, m, dtype=self.dtype)
            return self._without_programs(groups), np.broadcast_to(f, (n, m))
        ((_, widths),) = groups.members()
        self.num_solved += 1
        found, maps = find_maps(**self._pair(pair[None], widths), goal=self._limited(goal, widths, _MAX_MAP_PRODUCTS))
        return found, maps[0, :n, :m]

    def slack(self, pairs: np.ndarray) -> np.ndarray:
        """[Q]: how far the errors of other members of two classes can lie from those that were solved for.

        Nothing where the classes are the same, or where a model is too large to have company in its class.
        """
        sizes = self._book.size[pairs]
        alone = (pairs[:, 0] == pairs[:, 1]) | is_oversized(sizes, self._num_actions).any(axis=1)
        slack = np.where(alone, 0.0, model_rounding(self.dtype) * (2.0 + sizes.max(axis=1, initial=0)))
        return slack.astype(self.dtype)

    def tolerance(self, goal: Goal, slack):
        """What bounds have to reach before they are widened by `slack` on both sides: for decisions, which are about
        the models that stand for their classes, they are not (in float32 it alone may exceed the tolerance).
        """
        return goal.tolerance if goal.decides else np.maximum(goal.tolerance - 2.0 * slack, 0.5 * goal.tolerance)

    def _limited(self, goal: Goal, widths: tuple[int, int], products: float) -> Goal:
        """The goal for models of so many states, with no more iterations than so many multiplications allow."""
        n, m = widths
        affordable = max(products / (2.0 * self._num_actions * n * m * (n + m)), _MIN_ITERATIONS)
        slack = model_rounding(self.dtype) * (2.0 + max(widths))
        limit = int(min(goal.max_iterations, affordable))
        return goal._replace(tolerance=float(self.tolerance(goal, slack)), max_iterations=limit)

    def _without_programs(self, groups: _Groups) -> LocalSimilarity:
        """What is known beforehand, which for pairs to be solved is nothing."""
        group, count = groups.of_pair[:, 0], len(groups.of_pair)
        return LocalSimilarity(
            lower=np.zeros(count, self.dtype),
            upper=np.where(group == _SAME, model_rounding(self.dtype), 1.0).astype(self.dtype),
            iterations=np.zeros(count, np.int32),
            status=np.where(group == _TOO_LARGE, Status.ITERATION_LIMIT, Status.SOLVED).astype(np.int32),
        )

    def _pair(self, pairs: np.ndarray, widths: tuple[int, int]) -> dict:
        """The models of pairs [Q, 2], as arguments of `bracket_errors`."""
        source, target = (self._models(classes, width) for classes, width in zip(pairs.T, widths, strict=True))
        return {
            "source": source.transition,
            "target": target.transition,
            "source_size": source.size,
            "target_size": target.size,
            "source_labels": source.labels,
            "target_labels": target.labels,
            "anchored": self._anchored,
        }

    def _models(self, classes: np.ndarray, width: int) -> LocalModels:
        """The models of classes [Q], padded to a width; each is built once."""
        different, position = np.unique(classes, return_inverse=True)
        models = self._maker.make(self._book.representative[different], width)
        return jax.tree.map(lambda leaf: leaf[position], models)


class _Groups:
    """The sizes to which the models of pairs of classes [Q, 2] are padded.

    Both sides alike where they are small, so that few shapes are compiled; each to its own where one is large. A group
    is as wide as its largest class, of all that are known: one width for a model's grids of five states, say.

    Attributes:
      of_pair: int [Q, 2], the size groups; `_SAME` or `_TOO_LARGE` where there is nothing to solve.
      to_solve: bool [Q], the others.
    """

    def __init__(self, pairs: np.ndarray, size: np.ndarray, num_actions: int):
        self._size = size
        self._of_class = np.ceil(np.log2(np.maximum(size, _SMALL))).astype(int)
        groups = self._of_class[pairs]
        larger = groups.max(axis=1, keepdims=True)
        groups = np.where(larger <= _ALIKE_GROUP, larger, groups)
        too_large = is_oversized(size, num_actions)[pairs].any(axis=1, keepdims=True)
        groups = np.where(too_large, _TOO_LARGE, groups)
        self.of_pair = np.where(pairs[:, :1] == pairs[:, 1:], _SAME, groups)
        self.to_solve = self.of_pair[:, 0] >= 0

    def members(self):
        """Numbers of the pairs of each padding, and its widths (n, m)."""
        for group in np.unique(self.of_pair[self.to_solve], axis=0):
            (index,) = np.nonzero((self.of_pair == group).all(axis=1))
            yield index, tuple(int(self._size[self._of_class <= side].max()) for side in group)
