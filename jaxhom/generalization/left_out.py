"""What the expert did in trajectories that are left out, what candidates make of the others, and how likely that is."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from jaxhom.generalization import evidence
from jaxhom.generalization.neighbors import nearest_neighbors
from jaxhom.generalization.uniform import uniform_elsewhere
from jaxhom.generalization.votes import vote_of_rings
from jaxhom.generalization.voting import HostBallots, VotingRule
from jaxhom.models.demonstrations import Demonstrations
from jaxhom.models.inputs import check_policy
from jaxhom.models.mdp import MDP, absorbing_states, uniform_policy

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

_LITTLE = 0.05  # the share of the uniform policy in states that other trajectories visit too
_ROUNDING = 1e-12  # nats: mean likelihoods that are so close are the same
_MIXINGS = np.geomspace(0.01, 1.0, 33)  # shares from which each candidate takes its best


class Score(NamedTuple):
    """The log-likelihoods of M trajectories, and how many steps of each count, [M]."""

    log: Float[np.ndarray, " M"]
    length: Float[np.ndarray, " M"]

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

    def ahead_of(self, other: Score) -> float:
        """By how many standard errors of the difference; none where there is no difference but rounding."""
        difference = Score(self.log - other.log, self.length)
        return 0.0 if difference.mean <= _ROUNDING else difference.mean / max(difference.error, _ROUNDING)


class LeftOut:
    """What the expert did, by trajectory and state: V different visits of M trajectories, each to one state.

    A visit is left out with all others of its trajectory: what is known of the expert beside it are the counts of all
    trajectories less those of its own.
    """

    def __init__(self, mdp: MDP, demonstrations: Demonstrations, asked: Bool[np.ndarray, " S"]):
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

    def policies(self, name: str, candidate: dict[str, Any] | Callable, progress: bool) -> Float[np.ndarray, "V A"]:
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
            ballots = HostBallots(self._mdp, table, VotingRule.of(candidate), self._votes, progress)
            elected = ballots.elect(*self._ends(elected, candidate["states"]), None).policy
        policies[is_alone] = elected[self._state[is_alone]]
        return policies

    def score(self, policies: Float[np.ndarray, "V A"], mixing: float | None) -> Score:
        """The log-likelihood of the steps that matter."""
        shares = _MIXINGS if mixing is None else [mixing]
        log = max((self._log_likelihoods(policies, share) for share in shares), key=np.sum)
        steps = self._counts[self._matters].sum(axis=1)
        number = self._trajectory[self._matters]
        length = np.bincount(number, steps)
        return Score(np.bincount(number, log)[length > 0], length[length > 0])

    def _log_likelihoods(self, policies: np.ndarray, share: float) -> np.ndarray:
        """Of each visit that matters."""
        share = np.where(self._owner[self._state] >= 0, share, _LITTLE)[:, None]
        mixed = (1.0 - share) * policies + share * uniform_policy(self._mdp)[self._state]
        return (self._counts * np.log(np.where(self._counts > 0, mixed, 1.0))).sum(axis=1)[self._matters]

    def _ends(self, uniform: np.ndarray, states=None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The visited states, the policy where nothing is found, and the states that ask: those of one trajectory."""
        asking = self._owner >= 0
        return self._total.any(axis=1), uniform, asking if states is None else asking & states

    def _votes(self, states: Int[np.ndarray, " P"], experts: Int[np.ndarray, " P"]) -> Float[np.ndarray, "P A"]:
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
