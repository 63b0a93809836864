"""Programs that the host calls in loops of its own, and that take XLA long to compile."""

import functools

import jax

# XLA's newer way of making loops out of fused operations on CPUs takes half as long again to compile. Interior points
# run as fast without (4,096 pairs of 5 states, 512 of 13), PDHG and best responses a fifth slower.
_OPTIONS = {"xla_cpu_use_fusion_emitters": False}


def host_jit(function, **options):
    """`jax.jit` for what is never called inside another program, compiled in about two thirds of the time."""

    @functools.cache
    def compiled():
        return jax.jit(function, compiler_options=_known_options(), **options)

    @functools.wraps(function)
    def call(*args, **keywords):
        return compiled()(*args, **keywords)

    return call


@functools.cache
def _known_options() -> dict | None:
    """The options, where this release of XLA has them."""
    try:
        jax.jit(lambda: 0, compiler_options=_OPTIONS).lower().compile()
    except Exception:  # each release has its own way of saying so
        return None
    return _OPTIONS
