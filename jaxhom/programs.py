"""How programs are compiled that the host calls, and never another program.

XLA takes seconds over what runs for milliseconds. Where the same work comes in bulk that is well spent, and `jax.jit`
is right; elsewhere less is enough.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax

# XLA's newer way of making loops out of fused operations on CPUs takes half as long again to compile. Interior points
# run as fast without (4,096 pairs of 5 states, 512 of 13), PDHG and best responses a fifth slower.
_FEWER_PASSES = {"xla_cpu_use_fusion_emitters": False}
# Without LLVM's optimisations as well: walks of demonstrations compile in 0.18 s instead of 0.6, and run half as fast.
_NO_PASSES = _FEWER_PASSES | {"xla_backend_optimization_level": 0}


def host_jit(function: Callable, **options: Any) -> Callable:
    """`jax.jit`, compiled in about two thirds of the time."""
    return _jit_with(_FEWER_PASSES, function, options)


def quick_jit(function: Callable, **options: Any) -> Callable:
    """`jax.jit` for little work, compiled in a third of the time; it runs half as fast."""
    return _jit_with(_NO_PASSES, function, options)


def _jit_with(passes: dict, function: Callable, options: dict) -> Callable:
    @functools.cache
    def compiled():
        return jax.jit(function, compiler_options=_known(tuple(passes.items())), **options)

    @functools.wraps(function)
    def call(*args, **keywords):
        return compiled()(*args, **keywords)

    return call


@functools.cache
def _known(passes: tuple) -> dict | None:
    """The options, where this release of XLA has them."""
    try:
        jax.jit(lambda: 0, compiler_options=dict(passes)).lower().compile()
    except Exception:  # each release has its own way of saying so
        return None
    return dict(passes)
