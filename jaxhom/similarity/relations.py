"""Relations between classes of local models: what a table of similarities is about.

A relation gives every ordered pair of classes an error that is bounded from both sides; a state is similar to another
if that error is within a threshold. LP (9) is one of them (`class_pairs`), its minimum over permutations of actions
another (`lax_pairs`). Here are those that need no program: isomorphism, graph kernels, and functions of the user's.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol

import numpy as np

from jaxhom import checks
from jaxhom.similarity.brackets import Goal, LocalSimilarity, Progress, no_progress
from jaxhom.similarity.canonical_forms import are_isomorphic, stable_colours
from jaxhom.similarity.class_pairs import ClassModels, ClassPairs, LocalModel
from jaxhom.similarity.classes import quantum_bits
from jaxhom.similarity.graph_kernels import colour_counts, cosines, walks_in_common
from jaxhom.similarity.lax_pairs import LaxPairs
from jaxhom.similarity.local_models import is_oversized
from jaxhom.solvers.outward import rounded_down, rounded_up
from jaxhom.status import Status

if TYPE_CHECKING:
    from jaxtyping import Float, Int

RELATIONS = ("homomorphism", "isomorphic", "weisfeiler_lehman", "random_walk", "lax")
_ROUNDING = 64.0  # times eps: of a normalised kernel


UserRelation = Callable[[LocalModel, LocalModel], "bool | float | tuple[float, float]"]


class PairErrors(Protocol):
    """The errors of a relation.

    Attributes:
      num_solved: how many programs have been solved.
      has_maps: whether a map stands behind an error.
    """

    num_solved: int
    has_maps: bool

    def brackets(self, pairs: Int[np.ndarray, "Q 2"], goal: Goal, progress: Progress = no_progress) -> LocalSimilarity:
        """Bounds for different ordered pairs of classes; `progress` is called with how many just finished."""

    def slack(self, pairs: Int[np.ndarray, "Q 2"]) -> Float[np.ndarray, " Q"]:
        """How far the errors of other members of two classes can lie from those of the models that stand for them."""

    def tolerance(self, goal: Goal, slack):
        """What bounds have to reach before they are widened by `slack`."""

    def map_of(self, pair: Int[np.ndarray, " 2"], goal: Goal) -> tuple[LocalSimilarity, Float[np.ndarray, "n m"]]:
        """Bounds [1] of one pair, and the map that proves the upper one."""

    def renamings(self, pairs: Int[np.ndarray, "Q 2"]) -> Int[np.ndarray, "Q A"] | None:
        """Which action of the target stands for each of the source's; None where every action is itself."""


def pair_errors(relation: str | UserRelation, models: ClassModels, anchored: bool) -> PairErrors:
    """The errors of a relation, given by its name or as a function; or `ValueError`.

    Args:
      relation: one of `RELATIONS`, or a function of two `LocalModel`s.
      models: those that stand for the classes.
      anchored: whether centres are told from other states.
    """
    if callable(relation):
        return _ByFunction(models, relation)
    if not isinstance(relation, str) or relation not in RELATIONS:
        raise ValueError(f"relation must be one of {RELATIONS} or a function, got {checks.in_one_line(relation)}")
    kinds = (ClassPairs, _Isomorphic, _WeisfeilerLehman, _RandomWalk, LaxPairs)
    return dict(zip(RELATIONS, kinds, strict=True))[relation](models, anchored)


class _WithoutPrograms:
    """What relations have in common whose errors are computed and not searched for."""

    num_solved = 0
    has_maps = False

    def __init__(self, models: ClassModels, anchored: bool):
        self._models, self._anchored, self._dtype = models, anchored, models.dtype

    def brackets(self, pairs, goal: Goal, progress: Progress = no_progress) -> LocalSimilarity:
        """Bounds; nothing but that they are at most 1 for models that are too large to be looked at."""
        del goal
        is_large = is_oversized(self._models.size, self._models.num_actions)[pairs].any(axis=1)
        bounds = np.tile([0.0, 1.0], (len(pairs), 1))
        progress(int(is_large.sum()))
        bounds[~is_large] = self._bounds(pairs[~is_large], progress)
        lower, upper = bounds.T
        return LocalSimilarity(
            lower=np.maximum(rounded_down(lower, self._dtype), 0.0),
            upper=rounded_up(upper, self._dtype),
            iterations=np.zeros(len(pairs), np.int32),
            status=np.where(is_large, Status.ITERATION_LIMIT, Status.SOLVED).astype(np.int32),
        )

    def _bounds(self, pairs, progress: Progress) -> Float[np.ndarray, "Q 2"]:
        """Lower and upper bounds of pairs of models that are not too large."""
        raise NotImplementedError

    def slack(self, pairs):
        return np.zeros(len(pairs), self._dtype)

    def tolerance(self, goal: Goal, slack):
        del slack
        return goal.tolerance

    def map_of(self, pair, goal):
        raise ValueError("only errors of programs have maps behind them")

    def renamings(self, pairs):
        del pairs


class _Isomorphic(_WithoutPrograms):
    """0 for models that are equal up to a renaming of states, 1 for others."""

    def __init__(self, models: ClassModels, anchored: bool):
        super().__init__(models, anchored)
        self._colours: dict[int, bytes] = {}

    def brackets(self, pairs, goal: Goal, progress: Progress = no_progress) -> LocalSimilarity:
        """Models that are too large to be looked at are not told apart, but from themselves."""
        found = super().brackets(pairs, goal, progress)
        same = pairs[:, 0] == pairs[:, 1]
        upper, status = np.where(same, 0.0, found.upper), np.where(same, Status.SOLVED, found.status)
        is_open = found.lower < upper
        status = np.where(is_open, Status.ITERATION_LIMIT, status).astype(np.int32)
        return found.replace(upper=upper.astype(self._dtype), status=status)

    def _bounds(self, pairs, progress):
        # Models of one class are equal up to a renaming; the reverse is nearly always true, and not always.
        bounds = np.repeat(pairs[:, :1] != pairs[:, 1:], 2, axis=1).astype(float)
        for index in np.flatnonzero(pairs[:, 0] != pairs[:, 1]):
            one, other = pairs[index].tolist()
            if self._colours_of(one) == self._colours_of(other):
                bounds[index] = self._search(one, other)
        progress(len(pairs))
        return bounds

    def _colours_of(self, number: int) -> bytes:
        """The stable colours of a class, which differ where models are not isomorphic, but for rare exceptions."""
        if number not in self._colours:
            model = self._models.alone(number, is_scaled=True)
            labels = None if model.labels is None else model.labels[None]
            colours = stable_colours(model.transition[None], quantum_bits(self._dtype), labels)
            self._colours[number] = np.sort(colours[0]).tobytes()
        return self._colours[number]

    def _search(self, *numbers: int) -> tuple[float, float]:
        one, other = (self._models.alone(number, is_scaled=True) for number in numbers)
        labels = None if one.labels is None else np.stack([one.labels, other.labels])
        bits = quantum_bits(self._dtype)
        found = are_isomorphic(np.stack([one.transition, other.transition]), bits, labels)
        return (0.0, 1.0) if found is None else (1.0 - found, 1.0 - found)


class _WeisfeilerLehman(_WithoutPrograms):
    """1 - k for the normalised Weisfeiler-Lehman kernel."""

    _num_classes = 0

    def _bounds(self, pairs, progress):
        if self._num_classes < len(self._models.size):
            num_classes = len(self._models.size)
            is_small = ~is_oversized(self._models.size, self._models.num_actions)
            self._row = np.cumsum(is_small) - 1
            known = [self._models.alone(number, is_scaled=True) for number in np.flatnonzero(is_small)]
            self._features = colour_counts(known, quantum_bits(self._dtype), anchored=self._anchored)
            self._num_classes = num_classes  # last: what is interrupted begins anew
        progress(len(pairs))
        return _one_minus(cosines(self._features, self._row[pairs]))


class _RandomWalk(_WithoutPrograms):
    """1 - k for the normalised random-walk kernel."""

    def __init__(self, models: ClassModels, anchored: bool):
        super().__init__(models, anchored)
        self._own = np.zeros(0)

    def _bounds(self, pairs, progress):
        fresh = np.arange(len(self._own), len(self._models.size))
        self._own = np.append(self._own, self._kernel(np.stack([fresh, fresh], axis=1)))
        return _one_minus(self._kernel(pairs, progress) / np.sqrt(self._own[pairs].prod(axis=1)))

    def _kernel(self, pairs, progress: Progress = no_progress):
        result = np.ones(len(pairs))
        for index, source, target in self._models.of_pairs(pairs):
            labels = () if source.labels is None else (source.labels, target.labels)
            sides = source.transition, target.transition, source.size, target.size
            result[index] = walks_in_common(*sides, labels, anchored=self._anchored)
            progress(len(index))
        return result


class _ByFunction(_WithoutPrograms):
    """What a function of the user's says of two models: whether they are similar, an error, or bounds on one."""

    def __init__(self, models: ClassModels, function: UserRelation):
        super().__init__(models, True)
        self._function = function

    def _bounds(self, pairs, progress):
        known = {number: self._models.alone(number) for number in np.unique(pairs).tolist()}
        bounds = np.zeros((len(pairs), 2))
        for number, (source, target) in enumerate(pairs.tolist()):
            bounds[number] = self._ask(known[source], known[target])
            progress(1)
        return bounds

    def _ask(self, source: LocalModel, target: LocalModel) -> tuple[float, float]:
        said = self._function(source, target)
        lower, upper = map(_error_said, said if isinstance(said, tuple) and len(said) == 2 else (said, said))
        if not 0.0 <= lower <= upper:
            raise ValueError(
                "relation must return a bool, an error of at least 0, or a pair lower <= upper of such; for the local "
                f"models of states {source.states[0]} and {target.states[0]} it returned {checks.in_one_line(said)}"
            )
        return lower, upper


def _error_said(said) -> float:
    """A number, or a boolean as 0 where it is true and 1 where it is not; NaN for anything else."""
    value = said if isinstance(said, str | tuple | None) else np.asarray(said)
    if not isinstance(value, np.ndarray) or value.shape != () or value.dtype.kind not in "bfiu":
        return np.nan
    return float(not value) if value.dtype.kind == "b" else float(value)


def _one_minus(kernel) -> Float[np.ndarray, "Q 2"]:
    """Bounds on 1 - k, which rounding may be below 0."""
    rounding = _ROUNDING * np.finfo(float).eps
    return np.clip(1.0 - kernel, 0.0, 1.0)[:, None] + np.array([-rounding, rounding])
