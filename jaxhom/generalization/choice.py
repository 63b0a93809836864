"""Which way to generalize: the one under which a trajectory that was left out is likeliest.

Nobody knows beforehand which relation between local models carries an expert's actions over best: on one model the
strict ones do, on another those that accept more. Demonstrations can tell: each is left out in turn, the candidates
generalize the others, and what counts is the likelihood of the steps that were left out.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from jaxhom import checks
from jaxhom.generalization.algorithm1 import soft_local_homomorphism
from jaxhom.generalization.left_out import LeftOut
from jaxhom.generalization.neighbors import nearest_neighbors
from jaxhom.generalization.result import Generalization
from jaxhom.generalization.uniform import uniform_elsewhere
from jaxhom.generalization.voting import VotingRule
from jaxhom.models.demonstrations import Demonstrations
from jaxhom.models.inputs import as_model, asked_states
from jaxhom.models.mdp import MDP
from jaxhom.similarity.given_table import table_for
from jaxhom.similarity.lax_pairs import MAX_ACTIONS
from jaxhom.similarity.table import SimilarityTable
from jaxhom.status import Record

if TYPE_CHECKING:
    from jaxtyping import ArrayLike, Bool, Num

Candidate = Mapping[str, Any] | Callable[[MDP, Demonstrations], Generalization]

_THRESHOLDS = (0.0, 0.1, 0.2)
_PLAIN = str | int | float
_OF_TABLE = ("distance", "anchored", "labels", "label_weight", "relation")
_OF_RULE = tuple(field.name for field in dataclasses.fields(VotingRule))


class Choice(Record):
    """The generalization that was chosen, and the scores of all candidates.

    Attributes:
      best: the winner, fitted to all demonstrations.
      name: its name.
      scores: by name, the mean log-likelihood of a step that was left out, in nats.
      standard_errors: by name, those of the scores, from the spread between trajectories.
    """

    best: Generalization
    name: str = dataclasses.field(metadata={"static": True})
    scores: dict[str, float]
    standard_errors: dict[str, float]


def choose_generalization(
    mdp: MDP,
    demonstrations: Demonstrations,
    candidates: Mapping[str, Candidate] | None = None,
    *,
    distance: int = 1,
    labels: Num[ArrayLike, "S A L"] | Num[ArrayLike, "S L"] | None = None,
    label_weight: float = 1.0,
    states: Bool[ArrayLike, " S"] | None = None,
    mixing: float | None = None,
    caution: float = 0.0,
    progress: bool = False,
) -> Choice:
    """Chooses among ways to generalize by the likelihood of trajectories that were left out.

    Each trajectory is left out in turn; answers about single states (`Demonstrations.with_answers`) never are, and are
    known to the candidates at every time. A candidate's score is the mean, over all their steps, of log((1 - mixing)
    pi(s, a) + mixing u(s, a)): pi is what it makes of the others, u is uniform over the allowed actions. The highest
    score wins, the first one of equal ones; among the defaults those come first that accept least. What is likeliest
    need not be worth most: `bench/results/report.md` has how far the choice is from the best.

    Args:
      mdp: the model.
      demonstrations: M >= 2 trajectories with steps.
      candidates: by name, the options of `soft_local_homomorphism` as a mapping, a `table` among them; or a function of
        a model and demonstrations, such as `nearest_neighbors`, `uniform_elsewhere` or one of the user's. If None
        `default_candidates` says which: isomorphism, and Weisfeiler-Lehman, LP (9), random walks and, for up to 6
        actions, "lax" at three thresholds, k-NN, and uniform; with labels also LP (9) and random walks with all voters,
        weighted.
      distance: as `soft_local_homomorphism` takes it, for candidates that do not say otherwise.
      labels: likewise.
      label_weight: likewise.
      states: likewise; steps in states that are left out do not count.
      mixing: in (0, 1], the share of the uniform policy, without which one wrong step would decide. If None each
        candidate has the share, from 1 % on, under which it is likeliest: with little of it one that is right in half
        of the states, which may be by far the best, would score below `uniform_elsewhere`. In states that other
        trajectories visit too, where there is nothing to generalize, it is 5 %.
      caution: at least 0. The winner is the first candidate whose score is within so many standard errors, those of the
        difference between trajectories, of the highest one: with 1 or 2 an earlier candidate has to be beaten clearly.
      progress: show a progress bar.

    Returns:
      `Choice`.

    Raises:
      ValueError: if fewer than two trajectories have steps that count, there is no candidate, an option is out of range
        or traced, or a demonstration does not fit the model.

    On the host, not under jit, vmap or grad. Candidates that vote, those given by options and the two functions named
    above, are asked about all states of all trajectories at once, and share tables of similarities; other functions are
    called M times.

    Example:
      >>> import jaxhom
      >>> grid = jaxhom.gridworld(6)
      >>> walks = [([0, 1, 2, 3], [2, 2, 2, 2]), ([6, 7, 8, 9], [2, 2, 2, 2]), ([12, 13, 14], [2, 2, 2])]
      >>> shown = jaxhom.Demonstrations.from_trajectories(walks)
      >>> choice = jaxhom.choose_generalization(grid, shown)
      >>> choice.scores["uniform"] < choice.scores["homomorphism 0"] <= choice.scores[choice.name]
      True
      >>> choice.best.policy.shape
      (36, 4)

    Source: cross-validation (Stone 1974) by trajectories, with the rule of standard errors of Breiman, Friedman, Olshen
    and Stone 1984.
    """
    mdp = as_model(mdp)
    if checks.is_traced(mdp, demonstrations):
        raise ValueError("candidates are compared on the host: call choose_generalization outside jit, vmap and grad")
    checks.refuse_traced(mixing=mixing, caution=caution)
    if mixing is not None and not 0 < checks.require_number("mixing", mixing) <= 1:
        raise ValueError(f"mixing must lie in (0, 1], got {mixing}")
    if not checks.require_number("caution", caution) >= 0:
        raise ValueError(f"caution must not be negative, got {caution}")
    shared = {"distance": distance, "labels": labels, "label_weight": label_weight, "states": states}
    if candidates is None:
        candidates = default_candidates(mdp, labels is not None)
    if not isinstance(candidates, Mapping) or not candidates:
        raise ValueError("candidates must be a mapping that is not empty, from names to options or functions")
    left_out, tables = LeftOut(mdp, demonstrations, asked_states(mdp, states)), _Tables(mdp)
    known = {name: _checked(name, candidate, shared, tables) for name, candidate in candidates.items()}
    scores = {}
    for name, candidate in tqdm(known.items(), desc="candidates", leave=False, disable=not progress):
        scores[name] = left_out.score(left_out.policies(name, candidate, progress), mixing)
    highest = max(scores.values(), key=lambda score: score.mean)
    name = next(name for name, score in scores.items() if highest.ahead_of(score) <= caution)
    best = known[name]
    if isinstance(best, dict):
        best = functools.partial(soft_local_homomorphism, **best, progress=progress)
    return Choice(
        best=best(mdp, demonstrations),
        name=name,
        scores={key: score.mean for key, score in scores.items()},
        standard_errors={key: score.error for key, score in scores.items()},
    )


def default_candidates(mdp: MDP, has_labels: bool = False) -> dict[str, Candidate]:
    """What is chosen from if nothing else is said: strict relations first, k-NN and uniform last."""
    chosen: dict[str, Candidate] = {}
    for relation in ("isomorphic", "weisfeiler_lehman", "homomorphism", "random_walk", "lax"):
        if relation == "lax" and as_model(mdp).num_actions > MAX_ACTIONS:
            continue
        for threshold in _THRESHOLDS[: 1 if relation == "isomorphic" else None]:
            chosen[f"{relation} {threshold:g}"] = {"relation": relation, "threshold": threshold}
    if has_labels:
        everybody = {"threshold": 1.0, "voters": "all", "weights": "similarity"}
        for relation in ("homomorphism", "random_walk"):
            chosen[f"{relation} all, weighted"] = {"relation": relation, **everybody}
    return chosen | {"k-NN": nearest_neighbors, "uniform": uniform_elsewhere}


def _checked(name: str, candidate: Any, shared: dict[str, Any], tables: _Tables) -> dict[str, Any] | Callable:
    """A function, or all options of a candidate, its table among them; or `ValueError` that names it."""
    if callable(candidate):
        return candidate
    if not isinstance(candidate, Mapping):
        raise ValueError(f"candidates[{name!r}] must be a mapping of options or a function, got {candidate!r}")
    allowed = (*_OF_TABLE, *_OF_RULE, "states", "table")
    for option in candidate:
        if option not in allowed:
            raise ValueError(f"candidates[{name!r}] has the option {option!r}, which is none of {', '.join(allowed)}")
    options = {**shared, **candidate}
    try:
        VotingRule.of(options)
        options["states"] = asked_states(tables.mdp, options["states"])
        return tables.completed(options, candidate)
    except ValueError as error:
        raise ValueError(f"candidates[{name!r}]: {error}") from None


class _Tables:
    """Tables of similarities by their options, one for all candidates that share them."""

    def __init__(self, mdp: MDP):
        self.mdp = mdp
        self._known: dict[tuple, SimilarityTable] = {}

    def completed(self, options: dict[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
        """The options of a candidate with its table; one that was given says what is not `given` beside it."""
        table = options.get("table")
        if table is not None:
            of_table = {"distance": table.distance, "anchored": table.anchored, "relation": table.given_relation}
            if "labels" not in given:
                of_table |= {"labels": table.labels, "label_weight": 1.0}
            options = {**options, **{name: value for name, value in of_table.items() if name not in given}}
        kind = {name: options[name] for name in _OF_TABLE if name in options}
        if table is not None:
            return options | {"table": table_for(table, self.mdp, **kind)}
        # Arrays and functions are the same if they are one.
        key = tuple((name, value if isinstance(value, _PLAIN) else id(value)) for name, value in kind.items())
        if key not in self._known:
            self._known[key] = SimilarityTable(self.mdp, **kind)
        return options | {"table": self._known[key]}
