"""AdaHedge: exponential weights that need to know neither how many rounds there will be nor how large losses are.

With L the sums of the losses so far, weights are w_k ~ exp(-eta L_k), and

    eta = ln K / Delta,     Delta = sum over rounds of   w . l - m,     m = -1/eta ln(w . exp(-eta l)),

where Delta is what the weights have lost to rounds that went against them (de Rooij, van Erven, Grünwald and Koolen
2014, section 2). Losses of one round that all grow by a constant, or of all rounds by a factor, leave the weights
alone. After T rounds whose losses spread by at most S each, the average of w . l is within

    S (sqrt(ln K / T) + (4/3 ln K + 2) / T)

of the smallest entry of the average loss (their Theorem 6, whose variances are at most S^2 / 4).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float


class AdaHedge:
    """The weights of K alternatives; in NumPy."""

    def __init__(self, count: int):
        self._total, self._lost = np.zeros(count), 0.0

    def weights(self) -> Float[np.ndarray, " K"]:
        """For the next round: not negative, sum 1."""
        above = self._total - self._total.min()
        likely = np.exp(-self._rate * above) if self._lost > 0 else (above == 0).astype(float)
        return likely / likely.sum()

    def update(self, losses: Float[np.ndarray, " K"]) -> None:
        """Takes the losses [K] of a round, in any unit."""
        weights, least = self.weights(), self._total.min()
        if self._lost > 0:
            low = losses[weights > 0].min()  # exponents from there on: none overflows, and one at least is 0
            mixed = low - np.log(weights @ np.exp(-self._rate * np.maximum(losses - low, 0.0))) / self._rate
        else:
            mixed = (self._total + losses).min() - least
        self._lost += max(0.0, float(weights @ losses - mixed))  # rounding alone makes it negative
        self._total += losses

    @property
    def _rate(self) -> float:
        """eta."""
        return np.log(len(self._total)) / self._lost


def regret_bound(count: int, rounds: int, spread: float) -> float:
    """What the average of w . l may be above the best alternative's, for K alternatives and losses that spread by S."""
    share = np.log(count)
    return float(spread * (np.sqrt(share / rounds) + (4.0 / 3.0 * share + 2.0) / rounds))
