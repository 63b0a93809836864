"""How similar two states of a model are: LP (9) between their local models, for many pairs.

LP (9) of Boularias and Chaib-draa 2010 gives every ordered pair of states an error e >= 0: the best a map f from
M^{s,d} to M^{s',d} can do at commuting with the transitions (`homomorphism_lp` states the program).
e = 0 means that f is an exact homomorphism.

As printed, the program can be empty of meaning: if the target has a distribution that is stationary under every
action, an absorbing state say, mapping everything there gives e = 0 whatever the source. `anchored=True` requires
in addition that the centre is mapped to the centre, which removes that solution; `anchored=False` is the program as
printed.
"""

from __future__ import annotations

import functools
import operator
from typing import TYPE_CHECKING, NamedTuple

import jax
import numpy as np

from jaxhom import checks
from jaxhom.models.disjoint_union import disjoint_union
from jaxhom.models.inputs import as_model, check_labels, check_states
from jaxhom.models.mdp import MDP
from jaxhom.similarity.brackets import Goal, LocalSimilarity
from jaxhom.similarity.given_table import table_for
from jaxhom.similarity.pairs_in_programs import TracedStates, brackets_in_program
from jaxhom.similarity.table import SimilarityTable

if TYPE_CHECKING:
    from jaxtyping import ArrayLike, Int, Num


@checks.eager_where_concrete
def local_similarity(
    mdp: MDP,
    sources: Int[ArrayLike, " P"],
    targets: Int[ArrayLike, " P"],
    *,
    target_mdp: MDP | None = None,
    labels: Num[ArrayLike, "S A L"] | Num[ArrayLike, "S L"] | None = None,
    target_labels: Num[ArrayLike, "S2 A L"] | Num[ArrayLike, "S2 L"] | None = None,
    label_weight: float = 1.0,
    distance: int = 1,
    anchored: bool = True,
    tolerance: float = 1e-4,
    method: str = "auto",
    max_iterations: int = 100_000,
    progress: bool = False,
    table: SimilarityTable | None = None,
) -> LocalSimilarity:
    """Brackets the optimal error e of LP (9) for pairs of states, from M^{s,d} to M^{s',d}.

    Args:
      mdp: the model.
      sources: int [P], the state s of each pair.
      targets: int [P], its s'. The error is not symmetric.
      target_mdp: the model that the targets are states of, with as many actions; `mdp` if None.
      labels: [S, A, L], or [S, L] for labels of the state: what a map has to keep besides transitions. The error also
        bounds |l(i, a) - sum_k f(i, k) l'(k, a)| for every label. A reward [S, A] is one label, `mdp.features` are K.
        They count as they are: in [0, 1] a difference weighs like one of probabilities. None for nothing.
      target_labels: those of `target_mdp`; with it, and for both models or none.
      label_weight: what labels are multiplied by.
      distance: d >= 1, the radius of the local models.
      anchored: require that the centre is mapped to the centre; False is the program as printed.
      tolerance: largest upper - lower to settle for.
      method: "pdhg"; "interior_point", for tight brackets of small models on a CPU (whatever it leaves open, PDHG
        finishes); or "auto", which chooses between them by the sizes and the tolerance, and solves few pairs in NumPy
        before a program would be compiled.
      max_iterations: of PDHG, per pair, 100,000 if not given; a pair that needs more says so in `status` and keeps
        valid bounds. The interior-point method, which "auto" may take, has its own limit, which hardly any pair meets.
      progress: show a progress bar.
      table: what is known already, of the same model, labels, `distance` and `anchored`: asked first, and filled. Made
        anew if None. Inside programs it stands for the graph alone. Two models have one as a `disjoint_union`.

    Returns:
      `LocalSimilarity`, in the order of the pairs; of JAX arrays inside programs.

    Raises:
      ValueError: if a state is out of range, shapes or numbers of actions differ, labels do not fit, an option is
        unknown, out of range or traced, or `table` is another's; on a traced graph without a table, on local models too
        large for a program, and on a second derivative.

    Works under `jit`, `vmap`, `grad` and `jvp`. What has to be concrete there are options and the graph of the model:
    close over the model and trace its arrays by `mdp.replace(...)`; or give `table=SimilarityTable(mdp)`, whose graph
    then counts, which a model that is traced as a whole needs, and one in the dense layout with traced probabilities.
    A successor of the graph counts as one even where its traced probability is 0. Traced numbers are not checked; where
    they are not finite, the bounds are NaN or infinite. With concrete arguments alone the result is a constant.
    Inside, "auto" is PDHG, and each pair of states is solved. Traced states make room for all states' local models.
    There the bounds of float32 are not refined in float64, so large models may stay STALLED.

    `lower` and `upper` both have the envelope theorem's derivative in the probabilities, <y, (dT) f - f (dT')>, and in
    the labels, <y, dl - f dl'>, at the best map f and dual point y that were found. Where the optimum is not unique,
    that is the slope of one piece, a subgradient; it may be zero at e = 0.

    Example:
      >>> import jaxhom, numpy as np
      >>> grid = jaxhom.gridworld(8)
      >>> found = jaxhom.local_similarity(grid, [0, 9], [7, 10])  # two corners; two cells in the middle
      >>> (found.lower > 0.1).tolist(), (found.upper < 1e-4).tolist()
      ([True, False], [False, True])
      >>> goal = np.zeros((64, 1))
      >>> goal[9] = 1.0  # a label tells the two cells apart
      >>> jaxhom.local_similarity(grid, [9], [10], labels=goal).lower.round(3).tolist()
      [1.0]
      >>> import jax
      >>> error = lambda p: jaxhom.local_similarity(grid.mdp.replace(probability=p), [0], [7]).upper[0]
      >>> jax.jit(jax.grad(error))(grid.mdp.probability).shape
      (64, 4, 4)

    Source: Boularias and Chaib-draa 2010, eq. (9); between two models, and with a reward as the label, eq. (7).
    """
    options = {"tolerance": tolerance, "method": method, "max_iterations": max_iterations}
    checks.refuse_traced(distance=distance, anchored=anchored, **options)
    pairs = _Pairs.checked(mdp, sources, targets, target_mdp, labels, target_labels, label_weight)
    kind = {"distance": distance, "anchored": checks.require_switch("anchored", anchored)}
    if pairs.is_traced:
        return pairs.brackets_in_program(Goal.checked(**options), table, name="local_similarity", **kind)
    known, sources, targets = pairs.on_host(table, **kind)
    return known.brackets(sources, targets, progress=progress, **options)


@checks.eager_where_concrete
def locally_similar(
    mdp: MDP,
    sources: Int[ArrayLike, " P"],
    targets: Int[ArrayLike, " P"],
    threshold: float = 0.0,
    *,
    target_mdp: MDP | None = None,
    labels: Num[ArrayLike, "S A L"] | Num[ArrayLike, "S L"] | None = None,
    target_labels: Num[ArrayLike, "S2 A L"] | Num[ArrayLike, "S2 L"] | None = None,
    label_weight: float = 1.0,
    distance: int = 1,
    anchored: bool = True,
    mutual: bool = False,
    tolerance: float = 1e-4,
    progress: bool = False,
    table: SimilarityTable | None = None,
) -> np.ndarray | jax.Array:
    """Decides e <= threshold for pairs of states, stopping each pair as soon as its bounds settle it.

    A pair counts as similar if e <= threshold is proved up to the tolerance (upper <= threshold + tolerance), and
    as different if lower > threshold. Where both hold, the upper bound decides: within the band
    (threshold, threshold + tolerance] either answer is possible. A pair that is not settled after the iteration
    limit counts as different. Of local models that are equal to about 12 digits (6 in float32) one stands for all.

    Args:
      mdp: the model.
      sources: int [P], the state s of each pair.
      targets: int [P], its s'.
      threshold: epsilon >= 0.
      target_mdp: as in `local_similarity`.
      labels: likewise.
      target_labels: likewise.
      label_weight: likewise.
      distance: d >= 1, likewise.
      anchored: as in `local_similarity`.
      mutual: require the error of both directions to be within the threshold.
      tolerance: width of the band.
      progress: show a progress bar.
      table: as in `local_similarity`.

    Returns:
      bool [P].

    Raises:
      ValueError: as `local_similarity`.

    Works under `jit` and `vmap` as `local_similarity` does, and gives a JAX array there.

    Example:
      >>> import jaxhom
      >>> grid = jaxhom.gridworld(8)
      >>> jaxhom.locally_similar(grid, [0, 9], [7, 10], threshold=0.1).tolist()
      [False, True]

    Source: Boularias and Chaib-draa 2010, section V.
    """
    options = {"tolerance": tolerance, "threshold": threshold}
    checks.refuse_traced(distance=distance, anchored=anchored, mutual=mutual, **options)
    pairs = _Pairs.checked(mdp, sources, targets, target_mdp, labels, target_labels, label_weight)
    mutual = checks.require_switch("mutual", mutual)
    kind = {"distance": distance, "anchored": checks.require_switch("anchored", anchored)}
    if pairs.is_traced:
        kind |= {"name": "locally_similar", "table": table}
        ways = [pairs, pairs.turned()][: 1 + mutual]
        found = [way.brackets_in_program(Goal.checked(**options), **kind) for way in ways]
        return functools.reduce(operator.and_, (bounds.upper <= threshold + tolerance for bounds in found))
    known, sources, targets = pairs.on_host(table, **kind)
    asked = {"mutual": mutual, "tolerance": tolerance, "progress": progress}
    return known.decide(sources, targets, threshold, **asked)


class _Side(NamedTuple):
    """States [P] of a model, and its labels [S, A, L] or None."""

    mdp: MDP
    states: Int[ArrayLike, " P"]
    labels: Num[ArrayLike, "S A L"] | None


class _Pairs(NamedTuple):
    """What is compared; `is_one` if both sides are of one model."""

    source: _Side
    target: _Side
    is_one: bool

    @classmethod
    def checked(cls, mdp, sources, targets, target_mdp, labels, target_labels, label_weight) -> _Pairs:
        """The pairs, or `ValueError` where models or labels do not fit each other."""
        is_one, mdp = target_mdp is None, as_model(mdp)
        other = mdp if target_mdp is None else as_model(target_mdp)
        if is_one and target_labels is not None:
            raise ValueError("target_labels are those of target_mdp, which is not given")
        if not is_one and (labels is None) != (target_labels is None):
            raise ValueError("labels and target_labels must be given together")
        own = None if labels is None else check_labels(mdp, labels, label_weight)
        others = own if is_one else None
        if target_labels is not None:
            others = check_labels(other, target_labels, label_weight, "target_labels")
            expected = f"(..., {own.shape[2]}) as labels"
            checks.require_shape("target_labels", target_labels, expected, own.shape[2] == others.shape[2])
        if mdp.num_actions != other.num_actions:
            raise ValueError(f"target_mdp has {other.num_actions} actions, and mdp {mdp.num_actions}")
        return cls(_Side(mdp, sources, own), _Side(other, targets, others), is_one)

    @property
    def is_traced(self) -> bool:
        return checks.is_traced(self.source, self.target)

    def turned(self) -> _Pairs:
        """The pairs the other way round."""
        return _Pairs(self.target, self.source, self.is_one)

    def on_host(self, table: SimilarityTable | None, **kind) -> tuple[SimilarityTable, np.ndarray, np.ndarray]:
        """The table that knows both sides, and the states as it numbers them."""
        source, target = self.source, self.target
        if self.is_one:
            return table_for(table, source.mdp, labels=source.labels, **kind), source.states, target.states
        _refuse_table(table)
        # Of one discount and without features, which local models do not depend on.
        bare = {"discount": source.mdp.discount}
        both = disjoint_union([side.mdp.replace(features=side.mdp.features[..., :0], **bare) for side in self[:2]])
        labels = None if source.labels is None else np.concatenate([source.labels, target.labels])
        states = (check_states(side.mdp, side.states, name) for side, name in zip(self[:2], _NAMES, strict=True))
        sources, targets = (own + first for own, first in zip(states, both.offsets.tolist(), strict=True))
        return SimilarityTable(both, labels=labels, **kind), sources, targets

    def brackets_in_program(self, goal: Goal, table: SimilarityTable | None, *, name: str, **kind) -> LocalSimilarity:
        """As `SimilarityTable.brackets`, where something is traced."""
        if not self.is_one:
            _refuse_table(table)
        sides = []
        for (mdp, states, labels), which in zip(self[:2], _NAMES, strict=True):
            graph_of = mdp if table is None else table_for(table, mdp, for_graph=True, **kind).mdp
            sides.append(TracedStates(mdp, states, labels, graph_of, which))
        return brackets_in_program(*sides, goal, name=name, **kind)


_NAMES = ("sources", "targets")


def _refuse_table(table: SimilarityTable | None) -> None:
    if table is not None:
        raise ValueError(
            "a table is about one model: give both models as one, by disjoint_union, instead of target_mdp"
        )
