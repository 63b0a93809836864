"""How pairs of classes are settled: those that are open, block by block, by this process or by all of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import numpy as np
from tqdm import tqdm

from jaxhom.similarity.brackets import Goal, LocalSimilarity, Progress
from jaxhom.similarity.classes import ClassBook
from jaxhom.similarity.decisions import honest_status
from jaxhom.similarity.pair_blocks import pair_blocks
from jaxhom.similarity.pair_bounds import PairBounds
from jaxhom.similarity.process_shares import solved_in_shares
from jaxhom.similarity.relations import PairErrors
from jaxhom.solvers.lane_queue import is_settled

if TYPE_CHECKING:
    from jaxtyping import Bool, Int


class Settling:
    """Finds out about the errors of a relation between classes.

    Args:
      relation: whose errors.
      book: the classes.
      identity: what the errors are of, if all processes of `jax.distributed` share the work; None if this one is alone.
    """

    def __init__(self, relation: PairErrors, book: ClassBook, identity: bytes | None):
        self._relation, self._book, self._identity = relation, book, identity

    def is_to_solve(self, pairs: Int[np.ndarray, "Q 2"], goal: Goal, known: PairBounds) -> Bool[np.ndarray, " Q"]:
        """Whether pairs are open, and were not tried before."""
        bounds, tolerance = known.look_up(pairs), self._relation.tolerance(goal, self._relation.slack(pairs))
        is_open = ~is_settled(bounds.lower, bounds.upper, tolerance, goal.threshold)
        return is_open & ~known.was_tried(pairs, goal)

    def settle(self, pairs: Int[np.ndarray, "Q 2"], goal: Goal, known: PairBounds, *, progress: bool) -> None:
        """Solves those of different pairs that are open; what is found is known block by block."""
        pairs = pairs[self.is_to_solve(pairs, goal, known)]
        if not len(pairs):
            return
        solve = self._relation.brackets if self._identity is None else self._in_shares
        shares = 1 if self._identity is None else jax.process_count()
        with tqdm(total=len(pairs), desc="similarity", unit="pair", leave=False, disable=not progress) as bar:
            for block in pair_blocks(pairs, self._book.size, goal, shares):
                known.add(block, solve(block, goal, bar.update), goal)

    def widened(self, pairs: Int[np.ndarray, "Q 2"], goal: Goal, known: PairBounds) -> LocalSimilarity:
        """What is known of pairs, for all states of their classes."""
        bounds, slack = known.look_up(pairs), self._relation.slack(pairs)
        lower, upper = np.maximum(bounds.lower - slack, 0), bounds.upper + slack
        return bounds.replace(lower=lower, upper=upper, status=honest_status(goal.is_met(lower, upper), bounds.status))

    def _in_shares(self, pairs: Int[np.ndarray, "B 2"], goal: Goal, progress: Progress) -> LocalSimilarity:
        """As the relation's `brackets`, of which this process solves a share."""

        def solve(own: Int[np.ndarray, "O 2"]) -> LocalSimilarity:
            progress(len(pairs) - len(own))
            return self._relation.brackets(own, goal, progress)

        states = self._book.representative[pairs].tobytes()
        return solved_in_shares(solve, pairs, (self._identity or b"") + states + repr(goal).encode())
