"""How each way to generalize explains itself: from a state and what its method remembers to an `Explanation`.

An explainer is called with a generalization (its policy, visited states and radii) and a state that was not
demonstrated. What the methods decided is looked up or repeated; brackets and maps of Algorithm 1, which decides about
classes of states, are computed for the few voters of the state that is asked about.
"""

import dataclasses
from typing import Protocol

import numpy as np

from jaxhom.generalization import evidence
from jaxhom.generalization.explanation import Explanation
from jaxhom.generalization.votes import nearest, policies_that_count, square_distances
from jaxhom.generalization.voting import HostBallots, VotingRule
from jaxhom.models.graph import steps_from
from jaxhom.models.mdp import MDP, deciding_states
from jaxhom.similarity.table import SimilarityTable

LEAST_SHARE = 1e-3  # of the global map, for a demonstrated state to count as a voter


class Generalized(Protocol):
    """What an explainer reads of a generalization: policy [S, A], visited [S], radius [S] and undecided [S]."""

    policy: np.ndarray
    visited: np.ndarray
    radius: np.ndarray
    undecided: np.ndarray | None


@dataclasses.dataclass(frozen=True, eq=False)
class ByHomomorphism:
    """Algorithm 1; `asking`, bool [S], are the states that a policy was looked for in."""

    mdp: MDP
    table: SimilarityTable
    asking: np.ndarray
    rule: VotingRule

    def __call__(self, general: Generalized, state: int) -> Explanation:
        if not self.asking[state]:
            return _uniform(general, state, self._method(), "no policy was asked for here (`states` leaves it out)")
        steps = steps_from(self.mdp, state)
        radius = int(general.radius[state])
        if radius < 0:
            why = _met(self.mdp, general, state, steps, ", none locally similar")
            return _uniform(general, state, self._method(), why, _undecided(general, state))
        candidates, votes = self._voters(general, state, steps, radius)
        voters, votes = candidates[votes.any(axis=1)], votes[votes.any(axis=1)]
        here = np.full(len(voters), state)
        where = "wherever they are" if self.rule.least_voters is None else self._where(steps[voters])
        reason = f"{_voted(voters)}, {where}.{_undecided(general, state)}"
        table = self.table
        return dataclasses.replace(
            _mean_of(general, state, self._method(), reason, voters, steps[voters], votes, self.mdp),
            forward=table.maps(here, voters) if table.has_maps else None,
            backward=table.maps(voters, here) if table.has_maps and self.rule.mutual else None,
            errors=None if table.has_maps else table.brackets(here, voters),
            renamings=table.renamings(here, voters),
        )

    def _voters(self, general: Generalized, state: int, steps: np.ndarray, radius: int):
        """Demonstrated states, and their votes [E, A] as they were counted."""
        candidates = np.flatnonzero(np.asarray(general.visited))
        if self.rule.least_voters is not None:
            candidates = candidates[steps[candidates] <= radius]
        policies = policies_that_count(self.mdp, np.asarray(general.visited), np.asarray(general.policy))
        ballots = HostBallots(self.mdp, self.table, self.rule, policies)
        return candidates, ballots(np.full(len(candidates), state), candidates)

    def _where(self, steps: np.ndarray) -> str:
        nearest, farthest = int(steps.min()), int(steps.max())
        return f"{_steps(farthest)} away" if nearest == farthest else f"{nearest} to {_steps(farthest)} away"

    def _method(self) -> str:
        table, rule = self.table, self.rule
        parts = [
            f"d = {table.distance}",
            f"epsilon = {rule.threshold:g}",
            "anchored" if table.anchored else "as printed",
        ]
        parts += ["both directions"] * rule.mutual + [f"{table.compares} models"] * (table.compares != "homomorphism")
        parts += [] if table.labels is None else [_counted(table.labels.shape[2], "label")]
        parts += [] if rule.voters == "nearest" else [f"voters: {rule.voters}"]
        parts += [f"weights exp(-e / {rule.temperature:g})"] * rule.is_weighted
        return f"Algorithm 1 ({', '.join(parts)})"


@dataclasses.dataclass(frozen=True, eq=False)
class ByHops:
    """k-NN by steps in the model."""

    mdp: MDP

    def __call__(self, general: Generalized, state: int) -> Explanation:
        method = "nearest neighbours (steps)"
        steps = steps_from(self.mdp, state)
        radius = int(general.radius[state])
        if radius < 0:
            return _uniform(general, state, method, _met(self.mdp, general, state, steps))
        voters = _experts(self.mdp, general, state)
        voters = voters[steps[voters] == radius]
        reason = f"{_voted(voters)}, {_steps(radius)} away."
        return _mean_of(general, state, method, reason, voters, steps[voters], mdp=self.mdp)


@dataclasses.dataclass(frozen=True, eq=False)
class ByCoordinates:
    """k-NN by Euclidean distance; `coordinates` is [S, D]."""

    mdp: MDP
    coordinates: np.ndarray

    def __call__(self, general: Generalized, state: int) -> Explanation:
        method = "nearest neighbours (Euclidean)"
        experts = _experts(self.mdp, general, state)
        if int(general.radius[state]) < 0:
            return _uniform(general, state, method, "no demonstrated state has a vote here")
        square = square_distances(self.coordinates[[state]].astype(float), self.coordinates[experts])
        votes_for = nearest(square, self.coordinates)[0][0]
        voters, distances = experts[votes_for], np.sqrt(square[0, votes_for])
        reason = f"{_voted(voters)}, at distance {distances[0]:.4g}."
        return _mean_of(general, state, method, reason, voters, distances, mdp=self.mdp)


@dataclasses.dataclass(frozen=True, eq=False)
class ByGlobalMap:
    """LP (8): its map [S, E] to `experts` [E], demonstrated states, and the bounds on its optimal error."""

    mdp: MDP
    experts: np.ndarray
    mapping: np.ndarray
    lower: float
    upper: float
    anchored: bool

    def __call__(self, general: Generalized, state: int) -> Explanation:
        kind = "anchored" if self.anchored else "as printed"
        method = f"LP (8), {kind}, one map for all states with {self.lower:.3g} <= error <= {self.upper:.3g}"
        if int(general.radius[state]) < 0:
            why = "no demonstrated state that the map sends it to has a vote here"
            return _uniform(general, state, method, why)
        shares = self.mapping[state] / self.mapping[state].sum()
        chosen = self.mapping[state] > LEAST_SHARE
        voters = self.experts[chosen]
        rest = shares[~chosen].sum()
        others = f", {rest:.2g} of it to others" if rest else ""
        reason = f"the map sends it to {_states(len(voters))}{others}."
        distances = steps_from(self.mdp, state)[voters]
        votes = evidence.allowed_part(self.mdp, np.full(len(voters), state), np.asarray(general.policy)[voters])
        return _mean_of(general, state, method, reason, voters, distances, shares[chosen][:, None] * votes, self.mdp)


@dataclasses.dataclass(frozen=True, eq=False)
class ByOccupancy:
    """The regression; `occupancy` is its x [S, A], `num_experts` how many states its data are."""

    occupancy: np.ndarray
    num_experts: int

    def __call__(self, general: Generalized, state: int) -> Explanation:
        x = self.occupancy[state]
        if int(general.radius[state]) < 0:
            why = f"the fitted occupancy of {x.sum():.2g} is too little to read a policy off"
            return _uniform(general, state, "regression", why)
        reason = (
            f"no state voted: the occupancy fitted to {_states(self.num_experts)} is {x.sum():.3g} here, "
            "and the policy is the share of each action in it."
        )
        return _mean_of(general, state, "regression", reason)


def nothing_is_looked_for(general: Generalized, state: int) -> Explanation:
    """The demonstrations alone: off them the policy is uniform."""
    return _uniform(general, state, "the demonstrations alone", "not demonstrated, and this method looks no further")


def demonstrated(general: Generalized, state: int) -> Explanation:
    """A demonstrated state, whatever the method: it votes for itself."""
    reason = "demonstrated. The policy is how often the expert took each action here."
    return _mean_of(general, state, "the demonstrations alone", reason, [state], [0.0])


def _experts(mdp: MDP, general: Generalized, state: int) -> np.ndarray:
    """The demonstrated states that have a vote in a state, by number."""
    experts = np.flatnonzero(deciding_states(mdp, general.visited))
    return experts[evidence.has_vote(mdp, general.policy, np.full(len(experts), state), experts)]


def _mean_of(general, state: int, method: str, reason: str, voters=(), distances=(), votes=None, mdp=None):
    """The mean of the voters' policies, weighted by votes [E, A]; all alike, of what `mdp` allows, if None."""
    voters = np.asarray(voters, int)
    policies = np.asarray(general.policy)[voters]
    if votes is None:
        is_restricted = mdp is not None and mdp.restricts_actions and len(voters)
        votes = evidence.allowed_part(mdp, np.full(len(voters), state), policies) if is_restricted else policies
    counted = votes.sum(axis=1)
    if mdp is not None and mdp.restricts_actions and (~np.asarray(mdp.allowed)[state] & (policies > 0)).any():
        reason += " Votes for actions that it lacks do not count."
    return Explanation(
        state=state,
        method=method,
        reason=reason,
        radius=int(general.radius[state]),
        policy=np.asarray(general.policy[state]),
        voters=voters,
        weights=counted / max(counted.sum(), np.finfo(float).tiny),
        voter_policies=votes / np.where(counted > 0, counted, 1.0)[:, None],
        distances=np.asarray(distances, float),
    )


def _uniform(general, state: int, method: str, why: str, more: str = "") -> Explanation:
    return _mean_of(general, state, method, f"nothing was found, so the policy is uniform: {why}.{more}")


def _met(mdp: MDP, general, state: int, steps: np.ndarray, qualification: str = "") -> str:
    """What the set of states within t steps had met when it stopped growing."""
    reached = np.isfinite(steps)
    everything = f"all states that it leads to lie within {_steps(int(steps[reached].max()))}"
    count = int((reached & np.asarray(general.visited)).sum())
    if not count:
        return f"{everything}, and no demonstrated state is among them"
    voters = int(reached[_experts(mdp, general, state)].sum())
    if not voters:
        return (
            f"{everything}; {_states(count)} among them, without a vote: they absorb, or took what is not allowed here"
        )
    return f"{everything}; {_states(voters)} among them{qualification}"


def _voted(voters) -> str:
    return f"{_states(len(voters))} voted"


def _states(count: int) -> str:
    return _counted(count, "demonstrated state")


def _steps(count: int) -> str:
    return _counted(count, "step")


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'s' * (count != 1)}"


def _undecided(general, state: int) -> str:
    """How many demonstrated states had no say because their similarity could not be decided."""
    count = 0 if general.undecided is None else int(general.undecided[state])
    return f" The similarity of {_states(count)} could not be decided, which counts as different." if count else ""
