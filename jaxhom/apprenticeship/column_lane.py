"""The state of one lane of LPAL on columns: its game over the policies that it knows, and its two bounds.

A lane is one problem of a batch. The *pool* holds the policies that any lane has met (`policy_pool`); a lane's columns
are those of them that its game is played over. A lane is *slow* when its gap no longer shrinks although much of it is
open: then its best policy mixes about as many deterministic ones as there are features, and each column adds one.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jaxtyping import Float, Int

SLACK = 0.02  # share of the tolerance that is left to columns that are not quite exact
_PATIENCE = 40  # rounds without any progress, after which rounding has won
# Instances are those of bench/results/speed_lpal.csv; iterations count columns and steps of the other method.
_ROUNDS, _SOME_ROUNDS = 6, 3  # a lane whose bound has not moved by then is slow if its gap has not for so many:
# three lanes of grid48, one by one, take 67 iterations, and 91 if they are all given the rounds below
_MANY_ROUNDS, _MORE_ROUNDS = 12, 5  # likewise, wherever the bound is: a bound that moves is a sign that columns get on.
# With the rounds above for all, bumps48 takes 711 iterations for 32 lanes and 55 for the third alone, not 686 and 37;
# grids take as many, bumps24 takes fewer
_LITTLE = 0.9  # a gap that is still larger than this share has not moved
_YOUNG = 8  # newest columns, never dropped


@dataclasses.dataclass(eq=False)
class Lane:
    """One problem, and where it stands.

    Attributes:
      expectations: [K]. tolerance: the gap to reach.
      value: [S], the optimal values of the last response.
      weights: [K], those of the best bound so far, or to begin with. bound: that bound. actions: [S], their optimal
        actions. best_value: [S], their optimal values.
      columns: numbers of policies of the pool. row_probabilities, probabilities: w and q of the last game; q is 0
        where a column is new.
      lower, mixture: the best lower bound so far, and the policies and probabilities that prove it.
      guess: [K] or None, the next query instead of a mixture.
      gaps: after each round. made: policies added by this lane. idle: rounds without progress.
      has_asked: there was a query that was no guess. has_moved: the bound is better than that of the first query.
    """

    expectations: Float[np.ndarray, " K"]
    tolerance: float
    value: Float[np.ndarray, " S"]
    weights: Float[np.ndarray, " K"]
    made: int = 0
    bound: float = np.inf
    actions: Int[np.ndarray, " S"] | None = None
    best_value: Float[np.ndarray, " S"] | None = None
    columns: Int[np.ndarray, " C"] = dataclasses.field(default_factory=lambda: np.zeros(0, int))
    probabilities: Float[np.ndarray, " C"] = dataclasses.field(default_factory=lambda: np.zeros(0))
    row_probabilities: Float[np.ndarray, " K"] | None = None
    lower: float = -np.inf
    mixture: tuple[Int[np.ndarray, " C"], Float[np.ndarray, " C"]] | None = None
    guess: Float[np.ndarray, " K"] | None = None
    gaps: list[float] = dataclasses.field(default_factory=list)
    idle: int = 0
    has_asked: bool = False
    has_moved: bool = False

    @property
    def gap(self) -> float:
        """What is left between the bounds."""
        return self.bound - self.lower

    def is_done(self, limit: int) -> bool:
        """Closed, out of columns, or stuck."""
        return self.gap <= (1.0 - SLACK) * self.tolerance or self.made >= limit or self.idle >= _PATIENCE

    def is_slow(self) -> bool:
        """Whether columns will have to be many."""
        rounds, back = (_MANY_ROUNDS, _MORE_ROUNDS) if self.has_moved else (_ROUNDS, _SOME_ROUNDS)
        if len(self.gaps) < rounds:
            return False
        return self.gap > _LITTLE * self.gaps[-1 - back]

    def query(self, pull: float) -> Float[np.ndarray, " K"]:
        """Weights between those of the best bound and those of the last game."""
        if self.guess is not None:
            return self.guess
        if self.row_probabilities is None:
            return self.weights
        return pull * self.weights + (1.0 - pull) * self.row_probabilities

    def add(self, numbers: Sequence[int], room: int) -> None:
        """New columns. If there is no room, those go that the last game used least."""
        self.columns = np.append(self.columns, np.asarray(numbers, int))
        self.probabilities = np.append(self.probabilities, np.zeros(len(numbers)))
        if len(self.columns) > room:
            rank = self.probabilities.copy()
            rank[-_YOUNG:] = np.inf
            kept = np.sort(np.argsort(-rank, kind="stable")[: 3 * room // 4])
            self.columns, self.probabilities = self.columns[kept], self.probabilities[kept]

    def take_bound(self, answer: dict[str, np.ndarray]) -> None:
        """The upper bound that a best response proves, if it is better than the one so far."""
        if not answer["margin_bound"] < self.bound:
            return
        gain = self.bound - answer["margin_bound"]
        self.has_moved |= bool(SLACK * self.tolerance < gain < np.inf)
        self.bound, self.weights, self.actions = answer["margin_bound"], answer["weights"], answer["actions"]
        self.best_value, self.idle = answer["value"], 0

    def take_game(self, w: Float[np.ndarray, " K"], q: Float[np.ndarray, " M"], lower: float) -> None:
        """The strategies of a game over the columns, and the lower bound that they prove; q may be padded."""
        self.row_probabilities, self.probabilities = w, q[: len(self.columns)]
        if lower > self.lower:
            self.lower, self.mixture, self.idle = lower, (self.columns, self.probabilities), 0
