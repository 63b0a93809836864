"""A sum of minima of linear functions, less a penalty, made largest in a box: a small linear program for HiGHS.

    max_w  sum_g min_{j in g} d_j . w  -  lambda |w|_1     over  |w_k| <= M  (or 0 <= w_k <= M),  E w = 0,

and, where that is asked for, no minimum below 0. Each minimum is a variable m_g <= d_j . w, and w = p - n.

What multipliers prove. Multipliers y_j >= 0 of the rows whose sums over every group are 1 (at least 1 where no minimum
may be below 0), and any z of E w = 0, make g = D' y + E' z, and no weights are worth more than
M sum_k max(0, |g_k| - lambda), with g_k in place of |g_k| if w >= 0.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import TYPE_CHECKING

import numpy as np
import scipy

if TYPE_CHECKING:
    from jaxtyping import Float, Int

_ACCURACY = 1e-9  # of HiGHS, with rows of numbers of at most 1


@dataclasses.dataclass(frozen=True, eq=False)
class SumOfMinima:
    """The program.

    Attributes:
      rows: [J, K], the d_j. groups: [J], the group of each, 0 to G - 1, none of them empty.
      equal: [E, K].
      penalty: lambda. largest: M.
      nonnegative: whether weights may not be negative. is_floored: whether minima may not be.
    """

    rows: Float[np.ndarray, "J K"]
    groups: Int[np.ndarray, " J"]
    equal: Float[np.ndarray, "E K"]
    penalty: float
    largest: float
    nonnegative: bool
    is_floored: bool

    def value(self, weights: Float[np.ndarray, " K"]) -> float:
        """What weights reach, whether or not they keep to the constraints."""
        least = np.full(self._num_groups, np.inf)
        np.minimum.at(least, self.groups, self.rows @ weights)
        return float(least.sum()) - self.penalty * float(np.abs(weights).sum())

    def violation(self, weights: Float[np.ndarray, " K"]) -> float:
        """By how much E w misses 0, or a minimum is below 0 that must not be."""
        below = float(-(self.rows @ weights).min(initial=0.0)) if self.is_floored else 0.0
        return max(below, float(np.abs(self.equal @ weights).max(initial=0.0)))

    @functools.cached_property
    def unit(self) -> float:
        """The largest number of the rows; 1 if there is none but 0."""
        return max(np.abs(self.rows).max(initial=0.0), np.abs(self.equal).max(initial=0.0)) or 1.0

    def solve(self) -> tuple[Float[np.ndarray, " K"], float]:
        """Weights [K] in the box, and a bound: up to the rounding of a product, no weights reach more.

        Where HiGHS fails the weights are 0, which keeps to all constraints, and the bound holds all the same.
        """
        count, groups = self.rows.shape[1], self._num_groups
        signs = (1.0,) if self.nonnegative else (1.0, -1.0)
        numbers = (np.arange(len(self.rows)), self.groups)
        of_group = scipy.sparse.csr_array((np.ones(len(self.rows)), numbers), shape=(len(self.rows), groups))
        rows = scipy.sparse.hstack([*(-sign * self.rows / self.unit for sign in signs), of_group], format="csc")
        nothing = np.zeros((len(self.equal), groups))
        equal = np.hstack([*(sign * self.equal / self.unit for sign in signs), nothing])
        # In units of M and of the largest number: what the whole objective is divided by changes no multiplier.
        cost = np.append(np.full(len(signs) * count, self.penalty / self.unit), np.full(groups, -1.0))
        bounds = [(0.0, 1.0)] * (len(signs) * count) + [(0.0 if self.is_floored else None, None)] * groups
        result = _highs(cost, rows, equal, bounds)
        if result.x is None:
            return np.zeros(count), self._bound(np.zeros(len(self.rows)), np.zeros(len(self.equal)))
        parts = result.x[: len(cost) - groups].reshape(len(signs), count)
        weights = self.largest * np.clip(np.array(signs) @ parts, 0.0 if self.nonnegative else -1.0, 1.0)
        return weights, self._bound(np.maximum(-result.ineqlin.marginals, 0.0), result.eqlin.marginals)

    def _bound(self, multipliers: Float[np.ndarray, " J"], free: Float[np.ndarray, " E"]) -> float:
        """What multipliers prove, brought to the sums that they need."""
        total = np.bincount(self.groups, multipliers, self._num_groups)[self.groups]
        sizes = np.bincount(self.groups, minlength=self._num_groups)[self.groups]
        share = np.where(total > 0, multipliers / np.where(total > 0, total, 1.0), 1.0 / sizes)
        if self.is_floored:
            share = np.where(total >= 1.0, multipliers, share)
        slope = self.rows.T @ share + self.equal.T @ free
        slope = slope if self.nonnegative else np.abs(slope)
        return self.largest * float(np.maximum(slope - self.penalty, 0.0).sum())

    @property
    def _num_groups(self) -> int:
        return int(self.groups.max(initial=-1)) + 1


def _highs(cost, rows, equal, bounds):
    """min cost . x over rows x <= 0, equal x = 0 and bounds."""
    from scipy.optimize import linprog  # takes as long to import as much of the library, and few calls need it

    return linprog(
        cost,
        A_ub=rows if rows.shape[0] else None,
        b_ub=np.zeros(rows.shape[0]) if rows.shape[0] else None,
        A_eq=equal if equal.shape[0] else None,
        b_eq=np.zeros(equal.shape[0]) if equal.shape[0] else None,
        bounds=bounds,
        method="highs",
        options={"primal_feasibility_tolerance": _ACCURACY, "dual_feasibility_tolerance": _ACCURACY},
    )
