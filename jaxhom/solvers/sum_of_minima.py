"""A sum of minima of linear functions, less a penalty, made largest in a box: a small linear program for HiGHS.

    max_w  sum_g min_{j in g} d_j . w  -  lambda |w|_1     over  |w_k| <= M  (or 0 <= w_k <= M),  |E w| <= eps,

and, where that is asked for, no minimum below -eps. Each minimum is a variable m_g <= d_j . w, and w = p - n. Where
constraints meet in a line, rounding leaves nothing but 0 if they have to hold exactly: hence eps.

What multipliers prove. Multipliers y_j >= 0 of the rows whose sums T_g over every group are 1 (at least 1 where no
minimum may be below -eps), and any z of E w, make h = D' y + E' z, and no weights are worth more than
M sum_k max(0, |h_k| - lambda) + eps (sum_g (T_g - 1) + |z|_1), with h_k in place of |h_k| if w >= 0.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import TYPE_CHECKING

import numpy as np
import scipy

if TYPE_CHECKING:
    from jaxtyping import Float, Int

_ACCURACY = 1e-10  # of HiGHS, the least that it takes, with rows of numbers of at most 1


@dataclasses.dataclass(frozen=True, eq=False)
class SumOfMinima:
    """The program.

    Attributes:
      rows: [J, K], the d_j. groups: [J], the group of each, 0 to G - 1, none of them empty.
      equal: [E, K].
      penalty: lambda. largest: M.
      nonnegative: whether weights may not be negative. is_floored: whether minima may not be.
      slack: eps, as a share of the largest number of the rows times M.
    """

    rows: Float[np.ndarray, "J K"]
    groups: Int[np.ndarray, " J"]
    equal: Float[np.ndarray, "E K"]
    penalty: float
    largest: float
    nonnegative: bool
    is_floored: bool
    slack: float = 0.0

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
        of_group = scipy.sparse.vstack([of_group, scipy.sparse.csr_array((2 * len(self.equal), groups))])
        linear = np.concatenate([-self.rows, self.equal, -self.equal]) / self.unit
        rows = scipy.sparse.hstack([*(sign * linear for sign in signs), of_group], format="csc")
        right = np.repeat([0.0, self.slack], [len(self.rows), 2 * len(self.equal)])
        # In units of M and of the largest number: what the whole objective is divided by changes no multiplier.
        cost = np.append(np.full(len(signs) * count, self.penalty / self.unit), np.full(groups, -1.0))
        bounds = [(0.0, 1.0)] * (len(signs) * count) + [(-self.slack if self.is_floored else None, None)] * groups
        result = _highs(cost, rows, right, bounds)
        if result.x is None:
            return np.zeros(count), self._bound(np.zeros(len(right)))
        parts = result.x[: len(cost) - groups].reshape(len(signs), count)
        weights = self.largest * np.clip(np.array(signs) @ parts, 0.0 if self.nonnegative else -1.0, 1.0)
        # Twice the weights are worth twice as much: the best are 0, or at the box's wall. What is neither is slack.
        if np.abs(weights).max(initial=0.0) < 0.5 * self.largest:
            weights = np.zeros(count)
        return weights, self._bound(np.maximum(-result.ineqlin.marginals, 0.0))

    def _bound(self, multipliers: Float[np.ndarray, " N"]) -> float:
        """What multipliers of the rows, of E w <= eps and of -E w <= eps prove, brought to the sums that they need."""
        of_rows, above, below = np.split(multipliers, len(self.rows) + np.array([0, len(self.equal)]))
        total = np.bincount(self.groups, of_rows, self._num_groups)[self.groups]
        sizes = np.bincount(self.groups, minlength=self._num_groups)[self.groups]
        share = np.where(total > 0, of_rows / np.where(total > 0, total, 1.0), 1.0 / sizes)
        if self.is_floored:
            share = np.where(total >= 1.0, of_rows, share)
        slope = self.rows.T @ share + self.equal.T @ (below - above)
        slope = slope if self.nonnegative else np.abs(slope)
        extra = max(0.0, share.sum() - self._num_groups) + above.sum() + below.sum()
        proved = self.largest * np.maximum(slope - self.penalty, 0.0).sum()
        return float(proved + self.slack * self.unit * self.largest * extra)

    @property
    def _num_groups(self) -> int:
        return int(self.groups.max(initial=-1)) + 1


def _highs(cost, rows, right, bounds):
    """min cost . x over rows x <= right and bounds."""
    from scipy.optimize import linprog  # takes as long to import as much of the library, and few calls need it

    has_rows = rows.shape[0] > 0
    return linprog(
        cost,
        A_ub=rows if has_rows else None,
        b_ub=right if has_rows else None,
        bounds=bounds,
        method="highs",
        options={"primal_feasibility_tolerance": _ACCURACY, "dual_feasibility_tolerance": _ACCURACY},
    )
