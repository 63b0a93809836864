"""How far iterations on the device are, on a bar: from where they began to their tolerance, in orders of magnitude."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator

import numpy as np
from tqdm import tqdm

_BAR = "{desc} {percentage:3.0f}%|{bar}| {elapsed}{postfix}"
_shown: list[_Bar] = []  # compiled programs call a function of the module, which finds the bar of the moment here


@contextlib.contextmanager
def progress_of_sweeps(is_wanted: bool) -> Iterator[Callable | None]:
    """What to report residuals to while the bar is shown; None if it is not wanted."""
    if not is_wanted:
        yield None
        return
    bar = _Bar()
    _shown.append(bar)
    try:
        yield _report
    finally:
        _shown.remove(bar)
        bar.close()


def _report(residual: np.ndarray, tolerance: np.ndarray) -> None:
    if _shown:
        _shown[-1].show(float(np.max(residual)), float(np.max(tolerance)))


class _Bar:
    """The bar, which begins where the first report is: there is none without one."""

    def __init__(self) -> None:
        self._first: float | None = None
        self._bar: tqdm | None = None

    def show(self, residual: float, tolerance: float) -> None:
        if not math.isfinite(residual):
            return
        if self._bar is None:
            self._bar = tqdm(total=100, desc="sweeps", bar_format=_BAR)
        self._first = max(residual, self._first or 0.0)
        way = math.log(max(self._first, tolerance) / tolerance) if tolerance > 0 else 0.0
        gone = math.log(self._first / max(residual, tolerance)) if way else 1.0
        self._bar.n = max(self._bar.n, round(100 * min(gone / (way or 1.0), 1.0)))
        self._bar.set_postfix_str(f"residual {residual:.1e} of {tolerance:.1e}", refresh=False)
        self._bar.refresh()

    def close(self) -> None:
        if self._bar is not None:
            self._bar.close()
