"""Which way to generalize: the one under which a trajectory that was left out is likeliest.

Nobody knows beforehand which relation between local models carries an expert's actions over best: on one model the
strict ones do, on another those that accept more. Demonstrations can tell: each is left out in turn, the candidates
generalize the others, and what counts is the likelihood of the steps that were left out.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from tqdm import tqdm

from jaxhom import checks
from jaxhom.generalization import evidence
from jaxhom.generalization.algorithm1 import soft_local_homomorphism
from jaxhom.generalization.neighbors import nearest_neighbors
from jaxhom.generalization.result import Generalization
from jaxhom.generalization.uniform import uniform_elsewhere
from jaxhom.generalization.votes import vote_of_rings
from jaxhom.generalization.voting import HostBallots, VotingRule
from jaxhom.models.demonstrations import Demonstrations
from jaxhom.models.inputs import as_model, asked_states, check_policy
from jaxhom.models.mdp import MDP, absorbing_states, uniform_policy
from jaxhom.similarity.given_table import table_for
from jaxhom.similarity.lax_pairs import MAX_ACTIONS
from jaxhom.similarity.table import SimilarityTable
from jaxhom.status import Record

if TYPE_CHECKING:
    from jaxtyping import ArrayLike, Bool, Num

Candidate = Mapping[str, Any] | Callable[[MDP, Demonstrations], Generalization]

_THRESHOLDS = (0.0, 0.1, 0.2)
_PLAIN = str | int | float
_LITTLE = 0.05
_ROUNDING = 1e-12
_MIXINGS = np.geomspace(0.01, 1.0, 33)
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
    left_out, tables = _LeftOut(mdp, demonstrations, asked_states(mdp, states)), _Tables(mdp)
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
        _rule(options)
        options["states"] = asked_states(tables.mdp, options["states"])
        return tables.completed(options, candidate)
    except ValueError as error:
        raise ValueError(f"candidates[{name!r}]: {error}") from None


def _rule(options: dict[str, Any]) -> VotingRule:
    return VotingRule(**{name: options[name] for name in _OF_RULE if name in options})


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


class _Score(NamedTuple):
    """The log-likelihoods of M trajectories, and how many steps of each count, [M]."""

    log: np.ndarray
    length: np.ndarray

    @property
    def mean(self) -> float:
        """Of a step."""
        return float(self.log.sum() / self.length.sum())

    @property
    def error(self) -> float:
        """The standard error of the mean, from the spread between trajectories."""
        count = len(self.log)
        spread = ((self.log - self.mean * self.length) ** 2).sum() * count / (count - 1)
        return float(np.sqrt(spread) / self.length.sum())

    def ahead_of(self, other: _Score) -> float:
        """By how many standard errors of the difference; none where there is no difference but rounding."""
        difference = _Score(self.log - other.log, self.length)
        return 0.0 if difference.mean <= _ROUNDING else difference.mean / max(difference.error, _ROUNDING)


class _LeftOut:
    """What the expert did, by trajectory and state: V different visits of M trajectories, each to one state.

    A visit is left out with all others of its trajectory: what is known of the expert beside it are the counts of all
    trajectories less those of its own.
    """

    def __init__(self, mdp: MDP, demonstrations: Demonstrations, asked: np.ndarray):
        self._mdp, self._demonstrations = mdp, demonstrations
        uniform_elsewhere(mdp, demonstrations)  # which checks them
        shape, mask = (mdp.num_states, mdp.num_actions), np.asarray(demonstrations.mask)
        trajectory = np.broadcast_to(np.arange(len(mask))[:, None], mask.shape)[mask]
        visited, actions = (np.asarray(array)[mask] for array in (demonstrations.states, demonstrations.actions))
        self._key, where = np.unique(trajectory.astype(np.int64) * shape[0] + visited, return_inverse=True)
        self._counts = np.zeros((len(self._key), shape[1]))
        np.add.at(self._counts, (where, actions), 1)
        self._trajectory, self._state = np.divmod(self._key, shape[0])
        self._total = np.zeros(shape)
        np.add.at(self._total, self._state, self._counts)
        is_answer = np.asarray(demonstrations.is_answer)[self._trajectory]
        self._matters = (asked & ~np.asarray(absorbing_states(mdp)))[self._state] & ~is_answer
        if len(np.unique(self._trajectory[self._matters])) < 2:
            raise ValueError(
                "demonstrations must have at least two trajectories with steps in which there is something to decide: "
                "one is left out at a time, and the others are generalized"
            )
        self._owner = np.full(shape[0], -1)  # of states that a single trajectory visits
        is_only = np.bincount(self._state, minlength=shape[0]) == 1
        self._owner[self._state] = np.where(is_only[self._state] & ~is_answer, self._trajectory, -1)

    def policies(self, name: str, candidate: dict[str, Any] | Callable, progress: bool) -> np.ndarray:
        """[V, A]: what a candidate makes, in the state of each visit, of the other trajectories."""
        if callable(candidate) and candidate not in (nearest_neighbors, uniform_elsewhere):
            return self._one_by_one(f"candidates[{name!r}]", candidate)
        policies = self._without(self._trajectory, self._state)
        is_alone = ~policies.any(axis=1)
        elected = uniform_policy(self._mdp).copy()
        if candidate is nearest_neighbors:
            elected = vote_of_rings(self._mdp, *self._ends(elected), self._allowed_votes).policy
        elif isinstance(candidate, dict):
            table = candidate["table"]
            table.classes(np.flatnonzero(self._total.any(axis=1)))
            ballots = HostBallots(self._mdp, table, _rule(candidate), self._votes, progress)
            elected = ballots.elect(*self._ends(elected, candidate["states"]), None).policy
        policies[is_alone] = elected[self._state[is_alone]]
        return policies

    def score(self, policies: np.ndarray, mixing: float | None) -> _Score:
        """The log-likelihood of the steps that matter."""
        shares = _MIXINGS if mixing is None else [mixing]
        log = max((self._log_likelihoods(policies, share) for share in shares), key=np.sum)
        steps = self._counts[self._matters].sum(axis=1)
        number = self._trajectory[self._matters]
        length = np.bincount(number, steps)
        return _Score(np.bincount(number, log)[length > 0], length[length > 0])

    def _log_likelihoods(self, policies: np.ndarray, share: float) -> np.ndarray:
        """Of each visit that matters."""
        share = np.where(self._owner[self._state] >= 0, share, _LITTLE)[:, None]
        mixed = (1.0 - share) * policies + share * uniform_policy(self._mdp)[self._state]
        return (self._counts * np.log(np.where(self._counts > 0, mixed, 1.0))).sum(axis=1)[self._matters]

    def _ends(self, uniform: np.ndarray, states=None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The visited states, the policy where nothing is found, and the states that ask: those of one trajectory."""
        asking = self._owner >= 0
        return self._total.any(axis=1), uniform, asking if states is None else asking & states

    def _votes(self, states: np.ndarray, experts: np.ndarray) -> np.ndarray:
        """Policies of visited states for states that single trajectories visit, without these."""
        decides = ~np.asarray(absorbing_states(self._mdp))
        return self._without(self._owner[states], experts) * decides[experts][:, None]

    def _allowed_votes(self, states: np.ndarray, experts: np.ndarray) -> np.ndarray:
        return evidence.allowed_part(self._mdp, states, self._votes(states, experts))

    def _without(self, trajectory: np.ndarray, state: np.ndarray) -> np.ndarray:
        """[P, A]: the expert's policies in states [P] without one trajectory each; zero where it was never there."""
        key = trajectory.astype(np.int64) * self._mdp.num_states + state
        place = np.minimum(np.searchsorted(self._key, key), len(self._key) - 1)
        own = np.where((self._key[place] == key)[:, None], self._counts[place], 0.0)
        counts = self._total[state] - own
        return counts / np.maximum(counts.sum(axis=1, keepdims=True), 1.0)

    def _one_by_one(self, name: str, function: Callable) -> np.ndarray:
        """What a function makes of the demonstrations without each trajectory in turn."""
        policies = np.zeros_like(self._counts)
        everyone = np.arange(len(self._demonstrations))
        for number in np.unique(self._trajectory[self._matters]):
            own = self._trajectory == number
            found = function(self._mdp, self._demonstrations[everyone != number])
            policy = check_policy(self._mdp, found, f"the policy of {name}", batch=False)
            policies[own] = np.asarray(policy)[self._state[own]]
        return policies
