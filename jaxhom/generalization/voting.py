"""Who votes in Algorithm 1 and its variations, and with which weight: the rule, and the ballots that it makes.

The rule of the paper is that of the nearest: at the first radius at which some demonstrated state is similar, all that
are similar vote alike. Others wait for k voters, or ask everybody, wherever they are; and votes may weigh more the
smaller the error.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxhom import checks
from jaxhom.generalization import evidence
from jaxhom.generalization.grouped_votes import are_searched, vote_of_nearest_by_group
from jaxhom.generalization.votes import Ballots, Votes, vote_of_all, vote_of_rings
from jaxhom.models.mdp import MDP
from jaxhom.similarity.brackets import Goal
from jaxhom.similarity.table import SimilarityTable
from jaxhom.status import Status

if TYPE_CHECKING:
    from jaxtyping import Float, Int

WEIGHTS = ("equal", "similarity")


@dataclasses.dataclass(frozen=True)
class VotingRule:
    """Which demonstrated states vote in another.

    Attributes:
      threshold: largest error at which two states count as similar. mutual: in both directions.
      tolerance: of decisions, and of the errors that weights are made of.
      voters: "nearest", "all", or how many of the nearest at least.
      weights: "equal", or "similarity": exp(-e / temperature), times what is the same for all voters of a state.
      temperature: see `weights`.
    """

    threshold: float = 0.0
    mutual: bool = False
    tolerance: float = 1e-4
    voters: str | int = "nearest"
    weights: str = "equal"
    temperature: float = 0.05

    def __post_init__(self) -> None:
        checks.refuse_traced(**dataclasses.asdict(self))
        for name in ("threshold", "tolerance", "temperature"):
            object.__setattr__(self, name, checks.require_number(name, getattr(self, name)))
        Goal.checked(threshold=self.threshold, tolerance=self.tolerance)
        if isinstance(self.voters, str) and self.voters not in ("nearest", "all"):
            raise ValueError(f'voters must be "nearest", "all" or a number, got {self.voters!r}')
        if not isinstance(self.voters, str):
            object.__setattr__(self, "voters", checks.require_count("voters", self.voters))
        if self.weights not in WEIGHTS:
            raise ValueError(f"weights must be one of {WEIGHTS}, got {self.weights!r}")
        if not 0 < self.temperature < np.inf:
            raise ValueError(f"temperature must be positive and finite, got {self.temperature}")

    @classmethod
    def of(cls, options: Mapping[str, Any]) -> VotingRule:
        """That of options of which some are not about votes."""
        return cls(**{field.name: options[field.name] for field in dataclasses.fields(cls) if field.name in options})

    @property
    def of_table(self) -> dict:
        """What decisions depend on."""
        return {"threshold": self.threshold, "mutual": self.mutual, "tolerance": self.tolerance}

    @property
    def is_weighted(self) -> bool:
        """Whether errors weigh."""
        return self.weights == "similarity"

    @property
    def least_voters(self) -> int | None:
        """How many voters to look for in the rings around a state; None for all, wherever they are."""
        return {"nearest": 1, "all": None}.get(self.voters, self.voters)

    def weight(self, error, least, xp=np):
        """What a vote of some error counts beside one of the `least` error: neither nothing nor infinitely much."""
        most = 0.9 * float(np.log(np.finfo(error.dtype).max))
        return xp.exp(xp.clip((least - error) / self.temperature, -most, most))


class HostBallots:
    """The ballots of a rule, decided by a table; counts what stays undecided.

    Args:
      mdp: the model.
      table: of its similarities.
      rule: who votes.
      policy_of: policies [P, A] of demonstrated states [P] beside states [P] that ask; zero where one must not vote.
      progress: show a progress bar while programs are solved.

    Attributes:
      undecided: int32 [S], for how many demonstrated states it could not be decided whether they vote.
      status: why, or SOLVED.
    """

    def __init__(self, mdp: MDP, table: SimilarityTable, rule: VotingRule, policy_of: Ballots, progress: bool = False):
        self._mdp, self._table, self._rule, self._policy_of = mdp, table, rule, policy_of
        self._progress = progress
        self.undecided, self.status = np.zeros(mdp.num_states, np.int32), Status.SOLVED
        self._least = np.full(mdp.num_states, np.inf)  # error of the first voters of each state

    def elect(self, visited, policy, asking, group: Int[np.ndarray, " S"] | None) -> Votes:
        """The votes in the states that ask, bool [S]; `group` as in `vote_of_all`."""
        least = self._rule.least_voters
        is_plain = least == 1 and group is not None and not self._rule.is_weighted
        if is_plain and are_searched(self._mdp.num_states, int(visited.sum()), group[asking]):
            votes = vote_of_nearest_by_group(self._mdp, visited, policy, asking, self, group, self._progress)
            if votes is not None and not self.undecided.any():
                return votes
            self.undecided[:], self.status = 0, Status.SOLVED  # to be counted within the radii alone
        if least is not None:
            return vote_of_rings(self._mdp, visited, policy, asking, self, least)
        votes = vote_of_all(visited, policy, asking, self, group)
        if group is not None:  # one was asked for all of its group
            counts = np.zeros(group.max(initial=0) + 1, np.int32)
            np.maximum.at(counts, group[asking], self.undecided[asking])
            self.undecided[asking] = counts[group[asking]]
        return votes

    def __call__(self, states, experts) -> Float[np.ndarray, "P A"]:
        rule, table = self._rule, self._table
        votes = np.asarray(self._policy_of(states, experts), float)
        asked = votes.any(axis=1) if table.renames else evidence.allowed_part(self._mdp, states, votes).any(axis=1)
        (asked,) = np.nonzero(asked)
        options = {**rule.of_table, "with_errors": rule.is_weighted, "progress": self._progress}
        found = table.decisions(states[asked], experts[asked], **options)
        np.add.at(self.undecided, states[asked], found.status != Status.SOLVED)
        self.status = Status(max(self.status, found.status.max(initial=Status.SOLVED)))
        chosen, result = asked[found.similar], np.zeros_like(votes)
        states, experts, votes = states[chosen], experts[chosen], votes[chosen]
        if table.renames:
            votes = np.take_along_axis(votes, table.renamings(states, experts), axis=1)
        if rule.is_weighted:
            votes = votes * self._weights(states, found.error[found.similar].astype(float))[:, None]
        result[chosen] = evidence.allowed_part(self._mdp, states, votes)
        return result

    def _weights(self, states, error) -> Float[np.ndarray, " P"]:
        """Of votes in states [P]: relative to the least error of those that voted there first."""
        is_first = np.isinf(self._least[states])
        np.minimum.at(self._least, states[is_first], error[is_first])
        return self._rule.weight(error, self._least[states])
