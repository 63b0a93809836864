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
from typing import TYPE_CHECKING

import jax
import numpy as np

from jaxhom import checks
from jaxhom.models.inputs import as_model
from jaxhom.models.mdp import MDP
from jaxhom.similarity.brackets import Goal, LocalSimilarity
from jaxhom.similarity.given_table import table_for
from jaxhom.similarity.pairs_in_programs import brackets_in_program
from jaxhom.similarity.table import SimilarityTable

if TYPE_CHECKING:
    from jaxtyping import ArrayLike, Int


@checks.eager_where_concrete
def local_similarity(
    mdp: MDP,
    sources: Int[ArrayLike, " P"],
    targets: Int[ArrayLike, " P"],
    *,
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
      distance: d >= 1, the radius of the local models.
      anchored: require that the centre is mapped to the centre; False is the program as printed.
      tolerance: largest upper - lower to settle for.
      method: "pdhg"; "interior_point", for tight brackets of small models on a CPU (whatever it leaves open, PDHG
        finishes); or "auto", which chooses between them by the sizes and the tolerance, and solves few pairs in NumPy
        before a program would be compiled.
      max_iterations: per pair, 100,000 if not given; a pair that needs more says so in `status` and keeps valid bounds.
      progress: show a progress bar.
      table: what is known already, of the same model, `distance` and `anchored`: asked first, and filled. Made anew if
        None. Inside programs it stands for the graph alone.

    Returns:
      `LocalSimilarity`, in the order of the pairs; of JAX arrays inside programs.

    Raises:
      ValueError: if a state is out of range, the shapes differ, an option is unknown, out of
        range or traced, or `table` is another's; on a traced graph without a table, on local models too large for a
        program, and on a second derivative.

    Works under `jit`, `vmap`, `grad` and `jvp`. What has to be concrete there are options and the graph of the model:
    close over the model and trace its arrays by `mdp.replace(...)`; or give `table=SimilarityTable(mdp)`, whose graph
    then counts, which a model that is traced as a whole needs, and one in the dense layout with traced probabilities.
    A successor of the graph counts as one even where its traced probability is 0. Traced numbers are not checked; where
    they are not finite, the bounds are NaN or infinite. With concrete arguments alone the result is a constant.
    Inside, "auto" is PDHG, and each pair of states is solved. Traced states make room for all states' local models.
    There the bounds of float32 are not refined in float64, so large models may stay STALLED.

    `lower` and `upper` both have the envelope theorem's derivative in the probabilities, <y, (dT) f - f (dT')> at the
    best map f and dual point y that were found. Where the optimum is not unique, that is the slope of one piece, a
    subgradient; it may be zero at e = 0.

    Example:
      >>> import jaxhom
      >>> grid = jaxhom.gridworld(8)
      >>> found = jaxhom.local_similarity(grid, [0, 9], [7, 10])  # two corners; two cells in the middle
      >>> (found.lower > 0.1).tolist(), (found.upper < 1e-4).tolist()
      ([True, False], [False, True])
      >>> import jax
      >>> error = lambda p: jaxhom.local_similarity(grid.mdp.replace(probability=p), [0], [7]).upper[0]
      >>> jax.jit(jax.grad(error))(grid.mdp.probability).shape
      (64, 4, 4)

    Source: Boularias and Chaib-draa 2010, eq. (9).
    """
    options = {"tolerance": tolerance, "method": method, "max_iterations": max_iterations}
    checks.refuse_traced(distance=distance, anchored=anchored, **options)
    if checks.is_traced(as_model(mdp), sources, targets):
        kind = {"distance": distance, "anchored": anchored, "name": "local_similarity"}
        goal, graph_of = Goal.checked(**options), _graph_of(table, mdp, distance, anchored)
        return brackets_in_program(as_model(mdp), sources, targets, goal, graph_of=graph_of, **kind)
    options["progress"] = progress
    return table_for(table, mdp, distance, anchored).brackets(sources, targets, **options)


@checks.eager_where_concrete
def locally_similar(
    mdp: MDP,
    sources: Int[ArrayLike, " P"],
    targets: Int[ArrayLike, " P"],
    threshold: float = 0.0,
    *,
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
      distance: d >= 1, as in `local_similarity`.
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
    if checks.is_traced(as_model(mdp), sources, targets):
        kind = {"distance": distance, "anchored": anchored, "name": "locally_similar"}
        goal, graph_of = Goal.checked(**options), _graph_of(table, mdp, distance, anchored)
        ways = [(sources, targets), (targets, sources)][: 1 + mutual]
        found = [brackets_in_program(as_model(mdp), *way, goal, graph_of=graph_of, **kind) for way in ways]
        return functools.reduce(operator.and_, (bounds.upper <= threshold + tolerance for bounds in found))
    asked = {"mutual": mutual, "tolerance": tolerance, "progress": progress}
    return table_for(table, mdp, distance, anchored).decide(sources, targets, threshold, **asked)


def _graph_of(table: SimilarityTable | None, mdp: MDP, distance: int, anchored: bool) -> MDP:
    """The model whose graph counts inside a program."""
    return as_model(mdp) if table is None else table_for(table, mdp, distance, anchored).mdp
