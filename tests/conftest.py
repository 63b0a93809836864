"""float64 for every test, the small models that the tests share (see `small_models`), bounds on time and memory.

Most of the time goes to compiling. Compiled programs are kept in the user's folder for caches, where the other
processes of a run and the next run find them, and are made with fewer passes: a quarter of the time, and the same
numbers up to rounding, which another machine would not give to the last digit either. `JAXHOM_TESTS_AS_USERS=1`
compiles as users do, `JAXHOM_CACHE=off` keeps nothing.
"""

import contextlib
import ctypes
import gc
import os
import pathlib

import jax
import jaxlib
import numpy as np
import pytest
import small_models

from jaxhom.programs import folder_for_programs

_OBJECTS = 100_000  # new ones after which Python looks for cycles; traces are many objects and leave few
_MUCH = 3e9  # bytes of a process from which on it gives memory back; then it compiles again what it had compiled
_FEWER_PASSES = (
    "--xla_backend_optimization_level=0",
    "--xla_cpu_use_fusion_emitters=false",
    "--xla_cpu_parallel_codegen_split_count=1",  # the other processor has tests of its own
    "--xla_llvm_force_inline_before_split=false",
)

gc.set_threshold(_OBJECTS)
jax.config.update("jax_enable_x64", True)

if not os.environ.get("JAXHOM_TESTS_AS_USERS"):
    folder = folder_for_programs()
    if folder is not None:
        os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(folder / "tests"))
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")  # in the processes that tests start
        jax.config.update("jax_compilation_cache_dir", os.environ["JAX_COMPILATION_CACHE_DIR"])
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    if jaxlib.__version__.startswith("0.10."):  # an XLA that does not know a flag aborts
        os.environ.setdefault("XLA_FLAGS", " ".join(_FEWER_PASSES))


@pytest.fixture(params=small_models.NAMES)
def case(request):
    """Every small model in turn."""
    return small_models.case(request.param)


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture(autouse=True)
def memory_is_given_back():
    """What compiling leaves behind adds up to gigabytes, which the C library keeps until it is told to let go."""
    yield
    if _resident() > _MUCH:
        gc.collect()
        _trim()
    if _resident() > _MUCH:
        jax.clear_caches()
        gc.collect()
        _trim()


def _trim():
    with contextlib.suppress(OSError, AttributeError):  # not glibc
        ctypes.CDLL("libc.so.6").malloc_trim(0)


def _resident() -> int:
    """Bytes of this process in memory; 0 where nobody says."""
    statistics = pathlib.Path("/proc/self/statm")
    return int(statistics.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") if statistics.exists() else 0
