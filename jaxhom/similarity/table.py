"""The table of similarities: what is known of the errors of LP (9) between classes of local models.

From a pair of classes to certified bounds, filled as pairs are met. Decisions, brackets, maps and explanations read the
same table, and bounds that were found for one threshold serve every other.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, TypeVar

import jax
import numpy as np

from jaxhom import checks
from jaxhom.models.graph import host_graph
from jaxhom.models.inputs import as_model, check_labels, check_states
from jaxhom.models.mdp import MDP
from jaxhom.similarity.brackets import Goal, LocalSimilarity
from jaxhom.similarity.class_pairs import ClassModels
from jaxhom.similarity.classes import ClassBook
from jaxhom.similarity.decisions import (
    Decisions,
    Relation,
    decisions_of,
    every_pair,
    honest_status,
    is_far,
    is_similar,
    require_decided,
)
from jaxhom.similarity.lax_pairs import LaxPairs
from jaxhom.similarity.local_models import LocalModelMaker, require_concrete
from jaxhom.similarity.maps import CertifiedMaps, carry_maps
from jaxhom.similarity.pair_bounds import PairBounds, pair_keys, pair_set
from jaxhom.similarity.relations import UserRelation, pair_errors
from jaxhom.similarity.settling import Settling
from jaxhom.similarity.table_contents import heading, identity, options_in

if TYPE_CHECKING:
    from jaxtyping import ArrayLike, Int, Num

F = TypeVar("F", bound=Callable)

_MAP_TOLERANCE = {"float64": 1e-6, "float32": 1e-4}  # below what an explanation prints


def _one_at_a_time(method: F) -> F:
    """A method of a table, which several threads may share: they wait for one another."""

    @functools.wraps(method)
    def call(self, *args, **options):
        with self._lock:
            return method(self, *args, **options)

    return call


class SimilarityTable:
    """Errors between the local models of a model's states, each pair of classes solved at most once for what is asked.

    Args:
      mdp: the model, concrete; or what has one as `.mdp`.
      distance: d >= 1, the radius of the local models.
      anchored: require that the centre is mapped to the centre; False is the program as printed. Graph kernels then
        tell the centre from other states no more.
      labels: [S, A, L], or [S, L] for labels of the state, what a map has to keep besides transitions: the error also
        bounds |l(i, a) - sum_k f(i, k) l'(k, a)| for every label. A reward [S, A] is one label, `mdp.features` are K.
        They count as they are: in [0, 1] a difference weighs like one of probabilities.
      label_weight: what labels are multiplied by.
      relation: what the errors of a pair of local models are.

        * "homomorphism": the error of LP (9).
        * "isomorphic": 0 if the models are equal up to a renaming of states that keeps the centre, or else 1.
        * "weisfeiler_lehman": 1 - k for the subtree kernel of colours in three rounds of refinement (Shervashidze et
          al. 2011), normalised; colours are of probabilities, labels and actions, along transitions both ways.
        * "random_walk": 1 - k for the walks that both models have in common (Vishwanathan et al. 2007), normalised.
        * "lax": the error of LP (9), the least over all permutations of the target's actions, up to 6 of them
          (Taylor et al. 2008). Votes are renamed back by the permutation.
        * a function of two local models, source and target, with `.states`, `.transition` [n, A, n] and `.labels`
          [n, A, L] or None in NumPy: it returns whether they are similar, an error of at least 0, or bounds on one.
      across_processes: share the work out to all processes of `jax.distributed`. All of them have to ask their tables
        the same, in the same order, and all get the whole answer. An error or Ctrl-C in one ends the call in all.

    Attributes:
      mdp, distance, anchored, across_processes: as given.
      labels: [S, A, L], weighted; None if none were given.
      compares: the relation as given; its name if it is a function.
      num_solved: how many programs have been solved, each for a pair of classes; by this process.

    Raises:
      ValueError: if the model is traced, an option out of range, or labels do not fit.

    The table grows by what it is asked; it belongs to the host and is no pytree. Threads may share it. It takes
    concrete values alone, inside jit, vmap and grad too. Completed, it answers for traced demonstrations: see
    `complete`. What was solved stays when a call is interrupted: asked again, the table goes on from there.
    `interop.save_similarity` and `interop.load_similarity` keep it in a file.

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

    @checks.eager_where_concrete
    def __init__(
        self,
        mdp: MDP,
        *,
        distance: int = 1,
        anchored: bool = True,
        labels: Num[ArrayLike, "S A L"] | Num[ArrayLike, "S L"] | None = None,
        label_weight: float = 1.0,
        relation: str | UserRelation = "homomorphism",
        across_processes: bool = False,
    ):
        self.mdp = as_model(mdp)
        require_concrete(self.mdp)
        checks.refuse_traced(labels=labels, label_weight=label_weight)
        self.distance = checks.require_count("distance", distance)
        self.anchored = checks.require_switch("anchored", anchored)
        self.labels = None if labels is None else check_labels(self.mdp, labels, label_weight)
        if labels is None and checks.require_number("label_weight", label_weight) != 1.0:
            raise ValueError(f"label_weight is {checks.in_one_line(label_weight)}, and there are no labels")
        self.given_relation, self.across_processes = (
            relation,
            checks.require_switch("across_processes", across_processes),
        )
        if across_processes and self.renames:
            raise ValueError('relation="lax" is not shared by processes: give each a table of its own')
        self._maker = LocalModelMaker(host_graph(self.mdp), self.distance, self.labels)
        self._book = ClassBook(self._maker)
        self._pairs = pair_errors(relation, ClassModels(self._maker, self._book), self.anchored)
        self._known = PairBounds(self.mdp.dtype)
        about = (self.mdp, self.compares, self.distance, self.anchored, self.labels)
        self._settling = Settling(self._pairs, self._book, identity(*about) if self.across_processes else None)
        self._lock = threading.RLock()
        self._maps: dict[tuple[int, int], tuple[np.ndarray, LocalSimilarity]] = {}

    @_one_at_a_time
    def contents(self) -> dict[str, np.ndarray]:
        """All that is known of the errors, by name, as plain arrays: `restored` makes a table of them.

        Maps and models are not among them.

        Raises:
          ValueError: if the relation is a function.
        """
        renamings = self._pairs.contents() if isinstance(self._pairs, LaxPairs) else {}
        about = heading(self.mdp, self.given_relation, self.distance, self.anchored, self.labels)
        return {**about, **self._book.contents(), **self._known.contents(), **renamings}

    @classmethod
    @checks.eager_where_concrete
    def restored(
        cls, mdp: MDP, contents: Mapping[str, np.ndarray], *, across_processes: bool = False
    ) -> SimilarityTable:
        """A table that knows what another one did, whose `contents` these are; it solves none of it again.

        Args:
          mdp: the model that it was made for: its transitions, allowed actions and number type.
          contents: arrays by name.
          across_processes: as in `SimilarityTable`; all processes have to come with the same contents.

        Raises:
          ValueError: if they are a table's for another model, or no table's.

        Example:
          >>> import jaxhom
          >>> grid = jaxhom.gridworld(4)
          >>> table = jaxhom.SimilarityTable(grid).complete(threshold=0.2)
          >>> again = jaxhom.SimilarityTable.restored(grid, table.contents())
          >>> again.complete(threshold=0.2).num_solved
          0
        """
        model = as_model(mdp)
        require_concrete(model)
        table = cls(model, **options_in(contents, model), across_processes=across_processes)
        table._book.restore(contents)
        table._known.restore(contents, table.num_classes)
        if isinstance(table._pairs, LaxPairs):
            table._pairs.restore(contents, table.num_classes)
        return table

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "_lock"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, _lock=threading.RLock())

    def __repr__(self) -> str:
        kind = "anchored" if self.anchored else "as printed"
        kind += "" if self.compares == "homomorphism" else f", {self.compares}"
        kind += "" if self.labels is None else f", labels: {self.labels.shape[2]}"
        return (
            f"SimilarityTable({self.mdp.num_states} states, distance {self.distance}, {kind}; so far "
            f"{self.num_classes} classes, {len(self._known)} pairs of them)"
        )

    @property
    def compares(self) -> str:
        """The name of the relation."""
        given = self.given_relation
        return given if isinstance(given, str) else getattr(given, "__name__", type(given).__name__)

    @property
    def has_maps(self) -> bool:
        """Whether a map stands behind an error: of LP (9), "homomorphism" and "lax"."""
        return self._pairs.has_maps

    @property
    def renames(self) -> bool:
        """Whether actions of a target may stand for others of a source: the relation "lax"."""
        return self.given_relation == "lax"

    @property
    def num_classes(self) -> int:
        """How many different local models have been met."""
        return len(self._book)

    @property
    def num_solved(self) -> int:
        """How many programs have been solved."""
        return self._pairs.num_solved

    @checks.eager_where_concrete
    @_one_at_a_time
    def classes(self, states: Int[ArrayLike, " P"] | None = None) -> np.ndarray:
        """int32 [P]: the class of the local model of each of the given states, all states if None.

        Classes are numbered as they are met; states of one class share every error.
        """
        if states is None:
            return self._book.labels(np.arange(self.mdp.num_states))
        return self._book.labels(check_states(self.mdp, states))

    @checks.eager_where_concrete
    @_one_at_a_time
    def brackets(
        self,
        sources: Int[ArrayLike, " P"],
        targets: Int[ArrayLike, " P"],
        *,
        tolerance: float = 1e-4,
        method: str = "auto",
        max_iterations: int = 100_000,
        progress: bool = False,
        keep: bool = True,
    ) -> LocalSimilarity:
        """Brackets the optimal error e of LP (9) for pairs of states, from M^{s,d} to M^{s',d}.

        Arguments, result and errors are those of `local_similarity`. Only pairs of classes whose bounds are not yet
        that close are solved. With keep=False their bounds are not kept, for more pairs than memory holds.
        """
        goal = Goal.checked(tolerance=tolerance, method=method, max_iterations=max_iterations)
        pairs, where = self._pairs_of(*self._validated_pairs(sources, targets))
        known = self._known if keep else self._known.part(pairs)
        self._settling.settle(pairs, goal, known, progress=progress)
        return jax.tree.map(lambda leaf: leaf[where], self._settling.widened(pairs, goal, known))

    @checks.eager_where_concrete
    @_one_at_a_time
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

    @checks.eager_where_concrete
    @_one_at_a_time
    def decisions(
        self,
        sources: Int[ArrayLike, " P"],
        targets: Int[ArrayLike, " P"],
        threshold: float = 0.0,
        *,
        mutual: bool = False,
        tolerance: float = 1e-4,
        with_errors: bool = False,
        progress: bool = False,
    ) -> Decisions:
        """As `decide`, and says which of the pairs that count as different could not be decided, and why.

        With errors, those of similar pairs are bracketed to the tolerance; if mutual, the larger of both directions.
        """
        goal = Goal.checked(tolerance=tolerance, threshold=threshold)
        pairs, where = self._pairs_of(*self._validated_pairs(sources, targets))
        back = pairs[:, ::-1]
        if mutual:
            is_asked = ~is_far(self._known.look_up(back), goal)
            self._settle(pairs[is_asked], goal, progress)
            self._settle(back[is_asked & is_similar(self._known.look_up(pairs), goal)], goal, progress)
        else:
            self._settle(pairs, goal, progress)
        found = self._decided(pairs, goal, mutual)
        if with_errors:
            ways = [pairs, back][: 1 + mutual]
            self._settle(pair_set(np.concatenate([way[found.similar] for way in ways])), Goal(tolerance), progress)
            found = found.replace(error=self._errors_of(ways, tolerance))
        return jax.tree.map(lambda leaf: leaf[where], found)

    @checks.eager_where_concrete
    @_one_at_a_time
    def complete(
        self, threshold: float = 0.0, *, tolerance: float = 1e-4, with_errors: bool = False, progress: bool = False
    ) -> SimilarityTable:
        """Decides e <= threshold for all ordered pairs of classes of the model, and returns the table.

        Then `soft_local_homomorphism(..., threshold=threshold, table=table)` solves nothing any more, for whatever
        demonstrations, and runs inside jit and vmap. A table may be completed for several thresholds, one after the
        other.

        Args:
          threshold: epsilon >= 0.
          tolerance: an error up to threshold + tolerance may count as similar.
          with_errors: bracket the errors of similar pairs to the tolerance too, which weights="similarity" needs.
          progress: show a progress bar.

        Raises:
          ValueError: if an option is out of range, or the model has more than 4096 classes of local models.

        Example:
          >>> import jaxhom
          >>> table = jaxhom.SimilarityTable(jaxhom.gridworld(4)).complete(threshold=0.2)
          >>> table.relation(threshold=0.2).similar.shape
          (9, 9)
        """
        goal = Goal.checked(tolerance=tolerance, threshold=threshold)
        self.classes()
        pairs = every_pair(self.num_classes)
        self._settle(pairs, goal, progress)
        similar = pairs[is_similar(self._known.look_up(pairs), goal)]
        if with_errors:
            self._settle(similar, Goal(tolerance), progress)
        self._pairs.renamings(similar)
        return self

    @checks.eager_where_concrete
    @_one_at_a_time
    def relation(
        self, threshold: float = 0.0, *, mutual: bool = False, tolerance: float = 1e-4, with_errors: bool = False
    ) -> Relation:
        """Which classes are similar, as `decisions` says it of their states; of a completed table, without solving.

        Args:
          threshold: epsilon >= 0, one that the table was completed for.
          mutual: require the error of both directions to be within the threshold.
          tolerance: as it was when the table was completed.
          with_errors: likewise.

        Returns:
          `Relation`.

        Raises:
          ValueError: if an option is out of range, or pairs of classes are not decided and were not tried: call
            `complete` first.
        """
        goal = Goal.checked(tolerance=tolerance, threshold=threshold)
        label = self._book.known_labels()
        if (label < 0).any():
            raise ValueError(
                f"the table knows the classes of {int((label >= 0).sum())} of {len(label)} states: call "
                f"table.complete(threshold={checks.in_one_line(threshold)}) first, outside jit, vmap and grad"
            )
        pairs = every_pair(self.num_classes)
        require_decided(self._is_to_solve(pairs, goal), threshold, tolerance)
        found, square = self._decided(pairs, goal, mutual), (self.num_classes,) * 2
        relation = Relation(label=label, similar=found.similar.reshape(square), status=found.status.reshape(square))
        if with_errors:
            ways = [pairs, pairs[:, ::-1]][: 1 + mutual]
            is_open = [found.similar & self._is_to_solve(way, Goal(tolerance)) for way in ways]
            require_decided(np.concatenate(is_open), threshold, tolerance, ", with_errors=True")
            relation = relation.replace(error=self._errors_of(ways, tolerance).reshape(square))
        if self.renames:
            renaming = np.zeros((*square, self.mdp.num_actions), np.int32)
            renaming[relation.similar] = self._pairs.renamings(pairs[found.similar])
            relation = relation.replace(renaming=renaming)
        return relation

    @checks.eager_where_concrete
    @_one_at_a_time
    def renamings(self, sources: Int[ArrayLike, " P"], targets: Int[ArrayLike, " P"]) -> np.ndarray | None:
        """int [P, A]: which action of the target stands for each of the source's; None where each is itself.

        For the relation "lax": the permutation of least error, of those as good to 1e-4 the first one that renames the
        fewest actions.

        Raises:
          ValueError: as `local_similarity`.
        """
        pairs, where = self._pairs_of(*self._validated_pairs(sources, targets))
        found = self._pairs.renamings(pairs)
        return None if found is None else found[where]

    @checks.eager_where_concrete
    @_one_at_a_time
    def maps(self, sources: Int[ArrayLike, " P"], targets: Int[ArrayLike, " P"]) -> CertifiedMaps:
        """Maps M^{s,d} to M^{s',d} for pairs (s, s') of states, each with as small an error as can be certified.

        Args:
          sources: int [P], the state s of each pair.
          targets: int [P], its s'.

        Returns:
          `CertifiedMaps`; the bounds are 1e-6 apart (1e-4 in float32), or `status` says why not. Of the relation "lax"
          they are the maps to models with renamed actions, see `renamings`.

        Raises:
          ValueError: as `local_similarity`; or if the relation is one without maps.

        A map between the models that stand for two classes is solved for once, and carried over by renaming states.

        Source: Boularias and Chaib-draa 2010, eq. (9).
        """
        if not self.has_maps:
            raise ValueError(f"there are no maps behind the relation {self.compares}")
        sources, targets = self._validated_pairs(sources, targets)
        pairs, where = self._pairs_of(sources, targets)
        goal = Goal(tolerance=_MAP_TOLERANCE[np.dtype(self.mdp.dtype).name], method="pdhg")
        # One process may explain alone: tables that processes share stay the same.
        known = self._known.part(pairs) if self.across_processes else self._known
        for pair in pairs:
            key = tuple(pair.tolist())
            if key not in self._maps:
                found, f = self._pairs.map_of(pair, goal)
                self._maps[key] = f, found
            known.add(pair[None], self._maps[key][1])
        # The upper bound is that of the map, which a better one that is known need not prove.
        own = [self._maps[tuple(pair)] for pair in pairs.tolist()]
        upper = np.array([found.upper[0] for _, found in own], self.mdp.dtype) + self._pairs.slack(pairs)
        bounds = self._settling.widened(pairs, goal, known).replace(upper=upper)
        bounds = bounds.replace(status=honest_status(goal.is_met(bounds.lower, upper), bounds.status))
        return carry_maps(
            self._maker,
            (sources, targets),
            self._book.representative[pairs[where]],
            [own[k][0] for k in where],
            jax.tree.map(lambda leaf: leaf[where], bounds),
        )

    @_one_at_a_time
    def known(self) -> tuple[np.ndarray, LocalSimilarity]:
        """All pairs of classes that were asked for, int [Q, 2], and the bounds on their errors, [Q].

        The bounds are those of the models that stand for the classes. Numbers are those of `classes`.
        """
        pairs = self._known.pairs()
        return pairs, self._known.look_up(pairs)

    def _settle(self, pairs: np.ndarray, goal: Goal, progress: bool) -> None:
        """Solves those of different pairs of classes [Q, 2] that are open, unless that was tried before."""
        self._settling.settle(pairs, goal, self._known, progress=progress)

    def _is_to_solve(self, pairs: np.ndarray, goal: Goal) -> np.ndarray:
        """bool [Q]: whether pairs of classes are open, and were not tried before."""
        return self._settling.is_to_solve(pairs, goal, self._known)

    def _decided(self, pairs: np.ndarray, goal: Goal, mutual: bool) -> Decisions:
        """What is known of pairs of classes [Q, 2], in both directions if `mutual`."""
        back = self._known.look_up(pairs[:, ::-1]) if mutual else None
        return decisions_of(self._known.look_up(pairs), goal, back)

    def _errors_of(self, ways: list[np.ndarray], tolerance: float) -> np.ndarray:
        """[Q]: upper bounds on the errors of pairs of classes [Q, 2]; the largest of those of each pair's ways."""
        return np.maximum.reduce([self._widened(way, Goal(tolerance)).upper for way in ways])

    def _widened(self, pairs: np.ndarray, goal: Goal) -> LocalSimilarity:
        """What is known of pairs of classes, for all states of these classes."""
        return self._settling.widened(pairs, goal, self._known)

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
