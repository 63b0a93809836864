"""The table of similarities: what is known of the errors of LP (9) between classes of local models.

From a pair of classes to certified bounds, filled as pairs are met. Decisions, brackets, maps and explanations read the
same table, and bounds that were found for one threshold serve every other.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import numpy as np

from jaxhom import checks
from jaxhom.models.graph import host_graph
from jaxhom.models.inputs import as_model, check_states
from jaxhom.models.mdp import MDP
from jaxhom.similarity.brackets import Goal, LocalSimilarity
from jaxhom.similarity.class_pairs import ClassPairs
from jaxhom.similarity.classes import ClassBook
from jaxhom.similarity.local_models import LocalModelMaker, require_concrete
from jaxhom.similarity.maps import CertifiedMaps, carry_maps
from jaxhom.similarity.pair_bounds import PairBounds, pair_keys
from jaxhom.solvers.lane_queue import is_settled
from jaxhom.status import Record, Status

if TYPE_CHECKING:
    from jaxtyping import ArrayLike, Int

_MAP_TOLERANCE = {"float64": 1e-6, "float32": 1e-4}  # below what an explanation prints


class Decisions(Record):
    """Which of P pairs of states are similar.

    Attributes:
      similar: bool [P].
      status: int32 [P], a `jaxhom.Status`: SOLVED where the bounds decide, or else why they do not.
    """

    similar: np.ndarray
    status: np.ndarray


class SimilarityTable:
    """Errors between the local models of a model's states, each pair of classes solved at most once for what is asked.

    Args:
      mdp: the model, concrete; or what has one as `.mdp`.
      distance: d >= 1, the radius of the local models.
      anchored: require that the centre is mapped to the centre; False is the program as printed.

    Attributes:
      mdp, distance, anchored: as given.
      num_solved: how many programs have been solved, each for a pair of classes.

    Raises:
      ValueError: if the model is traced or the distance below 1.

    The table grows by what it is asked; it belongs to the host and is no pytree. Outside jit, vmap and grad only.

    Example:
      >>> import jaxhom
      >>> grid = jaxhom.gridworld(8)
      >>> table = jaxhom.SimilarityTable(grid)
      >>> table.decide([0, 9], [7, 10], threshold=0.0).tolist()  # two corners; two cells in the middle
      [False, True]
      >>> found = table.brackets([0], [7])
      >>> bool(found.lower[0] > 0.0)
      True

    Source: Boularias and Chaib-draa 2010, eq. (9) and section V.
    """

    def __init__(self, mdp: MDP, *, distance: int = 1, anchored: bool = True):
        self.mdp = as_model(mdp)
        require_concrete(self.mdp)
        self.distance, self.anchored = checks.require_count("distance", distance), bool(anchored)
        self._maker = LocalModelMaker(host_graph(self.mdp), self.distance)
        self._book = ClassBook(self._maker)
        self._pairs = ClassPairs(self._maker, self._book, self.anchored)
        self._known = PairBounds(self.mdp.dtype)
        self._maps: dict[tuple[int, int], tuple[np.ndarray, LocalSimilarity]] = {}

    def __repr__(self) -> str:
        kind = "anchored" if self.anchored else "as printed"
        return (
            f"SimilarityTable({self.mdp.num_states} states, distance {self.distance}, {kind}; so far "
            f"{self.num_classes} classes, {len(self._known)} pairs of them)"
        )

    @property
    def num_classes(self) -> int:
        """How many different local models have been met."""
        return len(self._book)

    @property
    def num_solved(self) -> int:
        """How many programs have been solved."""
        return self._pairs.num_solved

    def classes(self, states: Int[ArrayLike, " P"] | None = None) -> np.ndarray:
        """int32 [P]: the class of the local model of each of the given states, all states if None.

        Classes are numbered as they are met; states of one class share every error.
        """
        if states is None:
            return self._book.labels(np.arange(self.mdp.num_states))
        return self._book.labels(check_states(self.mdp, states))

    def brackets(
        self,
        sources: Int[ArrayLike, " P"],
        targets: Int[ArrayLike, " P"],
        *,
        tolerance: float = 1e-4,
        method: str = "auto",
        max_iterations: int = 100_000,
        progress: bool = False,
    ) -> LocalSimilarity:
        """Brackets the optimal error e of LP (9) for pairs of states, from M^{s,d} to M^{s',d}.

        Arguments, result and errors are those of `local_similarity`. Only pairs of classes whose bounds are not yet
        that close are solved.
        """
        goal = Goal.checked(tolerance=tolerance, method=method, max_iterations=max_iterations)
        pairs, where = self._pairs_of(*self._validated_pairs(sources, targets))
        self._settle(pairs, goal, progress)
        return jax.tree.map(lambda leaf: leaf[where], self._widened(pairs, goal))

    def decide(
        self,
        sources: Int[ArrayLike, " P"],
        targets: Int[ArrayLike, " P"],
        threshold: float = 0.0,
        *,
        mutual: bool = False,
        tolerance: float = 1e-4,
        progress: bool = False,
    ) -> np.ndarray:
        """bool [P]: decides e <= threshold for pairs of states.

        Arguments, result and errors are those of `locally_similar`. Only pairs of classes that the bounds so far do not
        decide are solved.
        """
        options = {"mutual": mutual, "tolerance": tolerance, "progress": progress}
        return self.decisions(sources, targets, threshold, **options).similar

    def decisions(
        self,
        sources: Int[ArrayLike, " P"],
        targets: Int[ArrayLike, " P"],
        threshold: float = 0.0,
        *,
        mutual: bool = False,
        tolerance: float = 1e-4,
        progress: bool = False,
    ) -> Decisions:
        """As `decide`, and says which of the pairs that count as different could not be decided, and why."""
        goal = Goal.checked(tolerance=tolerance, threshold=threshold)
        pairs, where = self._pairs_of(*self._validated_pairs(sources, targets))
        back = pairs[:, ::-1]
        is_asked = ~self._is_far(back, goal) if mutual else np.ones(len(pairs), bool)
        self._settle(pairs[is_asked], goal, progress)
        similar, is_far = is_asked & self._is_similar(pairs, goal), self._is_far(pairs, goal)
        status = self._known.look_up(pairs).status
        if mutual:
            self._settle(back[similar], goal, progress)
            is_far |= self._is_far(back, goal)
            status = np.where(similar, self._known.look_up(back).status, status)
            similar &= self._is_similar(back, goal)
        return Decisions(similar=similar[where], status=_status(similar | is_far, status)[where])

    def complete(self, threshold: float = 0.0, *, tolerance: float = 1e-4, progress: bool = False) -> SimilarityTable:
        """Decides e <= threshold for all ordered pairs of classes of the model, and returns the table."""
        goal = Goal.checked(tolerance=tolerance, threshold=threshold)
        self.classes()
        self._settle(np.indices((self.num_classes,) * 2).reshape(2, -1).T, goal, progress)
        return self

    def maps(self, sources: Int[ArrayLike, " P"], targets: Int[ArrayLike, " P"]) -> CertifiedMaps:
        """Maps M^{s,d} to M^{s',d} for pairs (s, s') of states, each with as small an error as can be certified.

        Args:
          sources: int [P], the state s of each pair.
          targets: int [P], its s'.

        Returns:
          `CertifiedMaps`; the bounds are 1e-6 apart (1e-4 in float32), or `status` says why not.

        Raises:
          ValueError: as `local_similarity`.

        A map between the models that stand for two classes is solved for once, and carried over by renaming states.

        Source: Boularias and Chaib-draa 2010, eq. (9).
        """
        sources, targets = self._validated_pairs(sources, targets)
        pairs, where = self._pairs_of(sources, targets)
        goal = Goal(tolerance=_MAP_TOLERANCE[np.dtype(self.mdp.dtype).name], method="pdhg")
        for pair in pairs:
            key = tuple(pair.tolist())
            if key not in self._maps:
                found, f = self._pairs.map_of(pair, goal)
                self._known.add(pair[None], found)
                self._maps[key] = f, found
        # The upper bound is that of the map, which a better one that is known need not prove.
        own = [self._maps[tuple(pair)] for pair in pairs.tolist()]
        upper = np.array([found.upper[0] for _, found in own], self.mdp.dtype) + self._pairs.slack(pairs)
        known = self._widened(pairs, goal).replace(upper=upper)
        bounds = known.replace(status=_status(goal.is_met(known.lower, upper), known.status))
        return carry_maps(
            self._maker,
            (sources, targets),
            self._book.representative[pairs[where]],
            [own[k][0] for k in where],
            jax.tree.map(lambda leaf: leaf[where], bounds),
        )

    def known(self) -> tuple[np.ndarray, LocalSimilarity]:
        """All pairs of classes that were asked for, int [Q, 2], and the bounds on their errors, [Q].

        The bounds are those of the models that stand for the classes. Numbers are those of `classes`.
        """
        pairs = self._known.pairs()
        return pairs, self._known.look_up(pairs)

    def _settle(self, pairs: np.ndarray, goal: Goal, progress: bool) -> None:
        """Solves those of different pairs of classes [Q, 2] that are open, unless that was tried before."""
        known = self._known.look_up(pairs)
        tolerance = self._pairs.tolerance(goal, self._pairs.slack(pairs))
        is_open = ~is_settled(known.lower, known.upper, tolerance, goal.threshold)
        pairs = pairs[is_open & ~self._known.was_tried(pairs, goal)]
        if len(pairs):
            self._known.add(pairs, self._pairs.brackets(pairs, goal, progress=progress), goal)

    def _is_similar(self, pairs: np.ndarray, goal: Goal) -> np.ndarray:
        return self._known.look_up(pairs).upper <= goal.threshold + goal.tolerance

    def _is_far(self, pairs: np.ndarray, goal: Goal) -> np.ndarray:
        return (self._known.look_up(pairs).lower > goal.threshold) & ~self._is_similar(pairs, goal)

    def _widened(self, pairs: np.ndarray, goal: Goal) -> LocalSimilarity:
        """What is known of pairs of classes, for all states of these classes."""
        known, slack = self._known.look_up(pairs), self._pairs.slack(pairs)
        lower, upper = np.maximum(known.lower - slack, 0), known.upper + slack
        return known.replace(lower=lower, upper=upper, status=_status(goal.is_met(lower, upper), known.status))

    def _pairs_of(self, sources: np.ndarray, targets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The different pairs of classes [Q, 2] of pairs of states, and which of them each is, [P]."""
        label = self._book.labels(np.append(sources, targets))
        pairs = np.stack([label[: len(sources)], label[len(sources) :]], axis=1)
        _, first, where = np.unique(pair_keys(pairs), return_index=True, return_inverse=True)
        return pairs[first], where

    def _validated_pairs(self, sources, targets) -> tuple[np.ndarray, np.ndarray]:
        sources, targets = check_states(self.mdp, sources, "sources"), check_states(self.mdp, targets, "targets")
        checks.require_shape("targets", targets, str(sources.shape), len(sources) == len(targets))
        return sources, targets


def table_for(table: SimilarityTable | None, mdp: MDP, distance: int, anchored: bool) -> SimilarityTable:
    """The table that was given, if it is one for this model and these options, or else `ValueError`; a new one if None.

    Options that differ from a table's are refused rather than overruled.
    """
    if table is None:
        return SimilarityTable(mdp, distance=distance, anchored=anchored)
    if not isinstance(table, SimilarityTable):
        raise ValueError(f"table must be a SimilarityTable, got {type(table).__name__}")
    if not _same_transitions(table.mdp, as_model(mdp)):
        raise ValueError("table was made for another model")
    if (table.distance, table.anchored) != (distance, bool(anchored)):
        raise ValueError(
            f"table was made with distance={table.distance} and anchored={table.anchored}, "
            f"not with distance={distance} and anchored={anchored}"
        )
    return table


def _same_transitions(one: MDP, other: MDP) -> bool:
    """Whether a concrete model has the local models of another, as far as that is concrete too.

    Features, discount and initial distribution may differ.
    """

    def parts(mdp):
        return mdp.next_state, mdp.probability, mdp.allowed

    return one is other or all(
        a is b or (a.shape == b.shape and a.dtype == b.dtype and (checks.is_traced(a) or np.array_equal(a, b)))
        for a, b in zip(parts(other), parts(one), strict=True)
    )


def _status(is_met: np.ndarray, status: np.ndarray) -> np.ndarray:
    """The status of bounds that are wider than they were found; where that keeps them open, rounding is to blame."""
    return np.where(is_met, Status.SOLVED, np.where(status == Status.SOLVED, Status.STALLED, status)).astype(np.int32)
