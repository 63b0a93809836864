"""LP (9) minimised over permutations of actions: local models that are alike once the target's actions are renamed.

Lax homomorphisms let every state have actions of its own that stand for those of its image (Taylor, Precup and
Panangaden 2008, after Ravindran and Barto 2004); here one permutation serves a whole local model. The error of a pair
is the least over all permutations, found by going through them, those first that rename the fewest actions; whatever a
bound already excludes is not solved. The permutation that is carried over to votes is the first one with that error.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import TYPE_CHECKING

import jax
import numpy as np

from jaxhom import checks
from jaxhom.similarity.brackets import Goal, LocalSimilarity, Progress, no_progress
from jaxhom.similarity.canonical_forms import canonical_forms
from jaxhom.similarity.class_pairs import ClassModels, ClassPairs
from jaxhom.similarity.classes import quantum_bits
from jaxhom.similarity.local_models import LocalModels, is_oversized
from jaxhom.similarity.pair_bounds import PairBounds, pair_set
from jaxhom.status import Status

if TYPE_CHECKING:
    from jaxtyping import Float, Int

MAX_ACTIONS = 6  # 720 permutations
_CHUNK = 2**24  # permutations of pairs at a time
_TOLERANCE = 1e-4  # to which errors are told apart for the choice of a permutation


class LaxPairs:
    """Solves LP (9) between classes for the best permutation of the target's actions.

    Args:
      models: those that stand for the classes.
      anchored: require that the centre is mapped to the centre.

    Raises:
      ValueError: if there are more than 6 actions.
    """

    has_maps = True

    def __init__(self, models: ClassModels, anchored: bool):
        num_actions = models.num_actions
        if num_actions > MAX_ACTIONS:
            raise ValueError(
                f'relation="lax" tries all permutations of at most {MAX_ACTIONS} actions, and the model has '
                f"{num_actions}"
            )
        orders = list(itertools.permutations(range(num_actions)))
        self._orders = np.array(sorted(orders, key=lambda order: sum(a != b for a, b in enumerate(order))), np.int32)
        self._anchored, self._models, self._actions = anchored, models, _Actions(models)
        self._programs = ClassPairs(_RenamedModels(models, self._orders), anchored)
        self._chosen: dict[tuple[int, int], int] = {}

    @property
    def num_solved(self) -> int:
        """How many programs have been solved."""
        return self._programs.num_solved

    def brackets(self, pairs: Int[np.ndarray, "Q 2"], goal: Goal, progress: Progress = no_progress) -> LocalSimilarity:
        """Bounds on the least errors of different ordered pairs of classes."""
        apart = self._errors_of_actions(pairs, goal)
        # Every action stands for some other, and some other for it, whatever the permutation.
        floor = np.maximum(apart.min(axis=2).max(axis=1), apart.min(axis=1).max(axis=1)).astype(self._programs.dtype)
        result = LocalSimilarity(
            lower=floor,
            upper=np.full(len(pairs), self._programs.most, floor.dtype),
            iterations=np.zeros(len(pairs), np.int32),
            status=np.full(len(pairs), Status.SOLVED, np.int32),
        )
        (waiting,) = np.nonzero(~(floor > goal.threshold))
        progress(len(pairs) - len(waiting))
        for part in np.array_split(waiting, 1 + len(waiting) * len(self._orders) // _CHUNK):
            found = self._least_errors(pairs[part], apart[part], goal)
            progress(len(part))
            jax.tree.map(lambda place, new, part=part: np.put(place, part, new), result, found)
        return result

    def _least_errors(self, pairs, apart: Float[np.ndarray, "Q A A"], goal: Goal) -> LocalSimilarity:
        lower, best = self._bounds_by_actions(apart), np.full(len(pairs), np.inf)
        chosen_upper, chosen = np.full(len(pairs), np.inf), np.zeros(len(pairs), int)
        iterations, status = np.zeros(len(pairs), np.int32), np.full(len(pairs), Status.SOLVED, np.int32)
        for rank in range(len(self._orders)):
            is_open = lower[:, rank] < best - goal.tolerance
            if goal.decides:
                is_open &= (lower[:, rank] <= goal.threshold) & ~(best <= goal.threshold + goal.tolerance)
            (asked,) = np.nonzero(is_open)
            if not asked.size:
                continue
            found = self._programs.brackets(self._renamed(pairs[asked], rank), goal)
            lower[asked, rank] = np.fmax(lower[asked, rank], found.lower)
            best[asked] = np.minimum(best[asked], found.upper)
            iterations[asked] += found.iterations
            status[asked] = np.maximum(status[asked], found.status)
            is_better = found.upper < chosen_upper[asked] - max(goal.tolerance, _TOLERANCE)
            chosen[asked[is_better]], chosen_upper[asked[is_better]] = rank, found.upper[is_better]
        # Final where no other permutation is better by more than the tolerance, as decisions with small errors are.
        is_final = lower.min(axis=1) >= chosen_upper - _TOLERANCE
        is_final |= not goal.decides and goal.tolerance <= _TOLERANCE
        for pair, rank in zip(pairs[is_final].tolist(), chosen[is_final].tolist(), strict=True):
            self._chosen.setdefault(tuple(pair), rank)
        dtype = self._programs.dtype
        least = np.minimum(lower.min(axis=1), best).astype(dtype)
        upper = np.where(np.isfinite(best), best, self._programs.most).astype(dtype)
        status = np.where(goal.is_met(least, upper), Status.SOLVED, status).astype(np.int32)
        return LocalSimilarity(lower=least, upper=upper, iterations=iterations, status=status)

    def slack(self, pairs: Int[np.ndarray, "Q 2"]) -> Float[np.ndarray, " Q"]:
        """As `ClassPairs.slack`."""
        return self._programs.slack(self._renamed(pairs, 0))

    def tolerance(self, goal: Goal, slack):
        """As `ClassPairs.tolerance`."""
        return self._programs.tolerance(goal, slack)

    def map_of(self, pair: Int[np.ndarray, " 2"], goal: Goal) -> tuple[LocalSimilarity, Float[np.ndarray, "n m"]]:
        """Bounds [1] for one pair of classes, and a map [n, m] to the renamed model."""
        self.renamings(pair[None])
        rank = self._chosen[tuple(pair.tolist())]
        found, f = self._programs.map_of(self._renamed(pair[None], rank)[0], goal)
        least = self.brackets(pair[None], goal._replace(method="auto"))
        return found.replace(lower=np.minimum(found.lower, least.lower)), f  # another may be better by the tolerance

    def renamings(self, pairs: Int[np.ndarray, "Q 2"]) -> Int[np.ndarray, "Q A"]:
        """Which action of the target stands for each of the source's."""
        keys = list(map(tuple, pairs.tolist()))
        missing = sorted({key for key in keys if key not in self._chosen})
        if missing:
            self.brackets(np.array(missing), Goal(tolerance=_TOLERANCE))
        return self._orders[[self._chosen[key] for key in keys]]

    def contents(self) -> dict[str, np.ndarray]:
        """The permutations that were chosen, as plain arrays for `restore`."""
        pairs = np.array(list(self._chosen), np.int32).reshape(-1, 2)
        return {"renamed_pairs": pairs, "renaming": np.array(list(self._chosen.values()), np.int32)}

    def restore(self, contents: Mapping[str, np.ndarray], num_classes: int) -> None:
        """Fills in the `contents` of another; `ValueError` where they are none."""
        pairs, rank = (contents.get(name, np.zeros(0, bool)) for name in ("renamed_pairs", "renaming"))
        checks.require_shape("renamed_pairs", pairs, "[Q, 2]", pairs.ndim == 2 and pairs.shape[1] == 2)
        checks.require_shape("renaming", rank, f"({len(pairs)},)", rank.shape == (len(pairs),))
        pairs = checks.require_integers("renamed_pairs", pairs, upper=num_classes)
        rank = checks.require_integers("renaming", rank, upper=len(self._orders))
        self._chosen = dict(zip(map(tuple, pairs.tolist()), rank.tolist(), strict=True))

    def _renamed(self, pairs, rank) -> Int[np.ndarray, "Q 2"]:
        """The pairs with the actions of the targets renamed, as `_RenamedModels` numbers them."""
        return pairs + np.array([0, rank * len(self._models.size)])

    def _errors_of_actions(self, pairs, goal: Goal) -> Float[np.ndarray, "Q A A"]:
        """Lower bounds where an action of the target stands for one of the source, as far as the goal asks for."""
        if not self._anchored:  # a single action then has little to say
            return np.zeros((len(pairs), *(self._orders.shape[1],) * 2))
        return self._actions.errors(pairs, goal._replace(threshold=goal.threshold if goal.decides else 0.0))

    def _bounds_by_actions(self, apart: Float[np.ndarray, "Q A A"]) -> Float[np.ndarray, "Q R"]:
        """Lower bounds for every permutation: no error is below that of any one action with the one renamed to it."""
        result, actions = np.zeros((len(apart), len(self._orders))), np.arange(self._orders.shape[1])
        for order, bounds in zip(self._orders, result.T, strict=True):
            bounds[:] = apart[:, actions, order].max(axis=1)
        return result


class _Actions:
    """Lower bounds on the errors of LP (9) for single actions of the source and the target, as if there were no more.

    Args:
      models: those that stand for the classes.
    """

    def __init__(self, models: ClassModels):
        self._models, self._programs = models, ClassPairs(_SingleActions(models), True, iterates=False)
        self._known, self._number_of_key = PairBounds(models.dtype), {}
        self._alike = np.zeros((0, models.num_actions), int)  # of each class and action: one that is the same

    def errors(self, pairs: Int[np.ndarray, "Q 2"], goal: Goal) -> Float[np.ndarray, "Q A A"]:
        """Lower bounds that decide as far as the goal asks for."""
        self._meet()
        own, other = (self._alike[side] for side in pairs.T)
        asked = np.stack(np.broadcast_arrays(own[:, :, None], other[:, None]), axis=-1)
        different = pair_set(asked.reshape(-1, 2))
        known = self._known.look_up(different)
        open_ = different[~goal.is_met(known.lower, known.upper) & ~self._known.was_tried(different, goal)]
        if len(open_):
            self._known.add(open_, self._programs.brackets(open_, goal), goal)
        return self._known.look_up(asked.reshape(-1, 2)).lower.reshape(asked.shape[:-1])

    def _meet(self) -> None:
        """Finds out which actions of new classes are the same as others, up to a renaming of states."""
        for number in range(len(self._alike), len(self._models.size)):
            row = np.arange(self._models.num_actions) + number * self._models.num_actions
            if not is_oversized(self._models.size[number], self._models.num_actions):
                model = self._models.alone(number, is_scaled=True)
                labels = None if model.labels is None else np.moveaxis(model.labels, 1, 0)[:, :, None]
                singles = np.moveaxis(model.transition, 1, 0)[:, :, None]
                keys, _ = canonical_forms(singles, quantum_bits(self._models.dtype), labels)
                row = [self._number_of_key.setdefault(key, int(v)) for key, v in zip(keys, row, strict=True)]
            self._alike = np.append(self._alike, [row], axis=0)


class _SingleActions(ClassModels):
    """The models of C classes with one of A actions each: class c A + a."""

    def __init__(self, models: ClassModels):
        vars(self).update(vars(models))
        self._plain, self.num_actions = models, 1

    @property
    def size(self) -> np.ndarray:
        return np.repeat(self._plain.size, self._plain.num_actions)

    def of(self, classes: np.ndarray, width: int) -> LocalModels:
        number, action = np.divmod(classes, self._plain.num_actions)
        models, chosen = self._plain.of(number, width), action[:, None, None, None]
        return models.replace(
            transition=np.take_along_axis(models.transition, chosen, axis=2),
            labels=None if models.labels is None else np.take_along_axis(models.labels, chosen, axis=2),
        )


class _RenamedModels(ClassModels):
    """C classes once more for each of R permutations: class r C + c is class c with action order[a] in place of a."""

    def __init__(self, models: ClassModels, orders: Int[np.ndarray, "R A"]):
        vars(self).update(vars(models))
        self._plain, self._orders = models, orders

    @property
    def size(self) -> np.ndarray:
        return np.tile(self._plain.size, len(self._orders))

    def of(self, classes: np.ndarray, width: int) -> LocalModels:
        rank, number = np.divmod(classes, len(self._plain.size))
        models, order = self._plain.of(number, width), self._orders[rank][:, None]
        labels = models.labels
        return models.replace(
            transition=np.take_along_axis(models.transition, order[..., None], axis=2),
            labels=None if labels is None else np.take_along_axis(labels, order[..., None], axis=2),
        )
