"""One thread for every product and factorisation of the host: for small matrices, many at a time.

BLAS starts as many threads as there are cores for each matrix. Where the work is spread over the cores anyway, or where
somebody else uses them, these threads wait for one another: a few dozen pairs of 16 states then take ten times as long.
"""

from __future__ import annotations

import contextlib
import functools
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController


def one_blas_thread() -> contextlib.AbstractContextManager:
    """Within it BLAS uses one thread, in all threads of the process; left by the thread that entered it."""
    return _controller().limit(limits=1, user_api="blas")


@functools.cache
def _controller() -> ThreadpoolController:
    import scipy.linalg  # noqa: F401  its BLAS has to be loaded before it is looked for
    import threadpoolctl

    return threadpoolctl.ThreadpoolController()
