"""How programs are compiled that the host calls, and never another program; and where they are kept.

XLA takes seconds over what runs for milliseconds. Where the same work comes in bulk that is well spent, and `jax.jit`
is right; elsewhere less is enough. What is kept in a folder no later process compiles again.
"""

import functools
import hashlib
import os
import pathlib
import platform
import sys
from collections.abc import Callable
from typing import Any

import jax

# XLA's newer way of making loops out of fused operations on CPUs takes half as long again to compile. Interior points
# run as fast without (4,096 pairs of 5 states, 512 of 13), PDHG and best responses a fifth slower.
_FEWER_PASSES = {"xla_cpu_use_fusion_emitters": False}
# Without LLVM's optimisations as well: walks of demonstrations compile in 0.18 s instead of 0.6, and run half as fast.
_NO_PASSES = _FEWER_PASSES | {"xla_backend_optimization_level": 0}
_COMPILING = 2.0  # seconds, of iterations: bench/results/speed_first.csv has 2 to 4 of them cold, and 0.3 to 1 by NumPy
_WORTH_KEEPING = 0.05  # seconds of compiling, up to which reading a file takes about as long


def pays(seconds_on_host: float) -> bool:
    """Whether a program is done before NumPy is: not with what takes that less than a program takes to compile."""
    return seconds_on_host > _COMPILING


def host_jit(function: Callable, **options: Any) -> Callable:
    """`jax.jit`, compiled in about two thirds of the time."""
    return _jit_with(_FEWER_PASSES, function, options)


def quick_jit(function: Callable, **options: Any) -> Callable:
    """`jax.jit` for little work, compiled in a third of the time; it runs half as fast."""
    return _jit_with(_NO_PASSES, function, options)


def keep_programs() -> None:
    """Has JAX keep compiled programs in the user's folder for caches, for the processes to come.

    For command lines; the library changes no setting of JAX by itself. A folder that JAX has been told already stands.
    """
    folder = folder_for_programs()
    if folder is not None and not jax.config.values["jax_compilation_cache_dir"]:
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", _WORTH_KEEPING)


def folder_for_programs() -> pathlib.Path | None:
    """Where to keep programs: `JAXHOM_CACHE`, or a folder of the user's; None if "off", or not to be written to."""
    choice = os.environ.get("JAXHOM_CACHE", "")
    if choice == "off":
        return None
    try:
        folder = (pathlib.Path(choice) if choice else _folder_for_caches() / "jaxhom") / _kind_of_processor()
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # a user without a home
        return None
    return folder if os.access(folder, os.W_OK) else None


def _folder_for_caches() -> pathlib.Path:
    """Where programs of this system and this user keep what can be made again."""
    if sys.platform == "win32":
        return pathlib.Path(os.environ.get("LOCALAPPDATA") or pathlib.Path.home() / "AppData" / "Local")
    if sys.platform == "darwin":
        return pathlib.Path.home() / "Library" / "Caches"
    return pathlib.Path(os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache")


def _kind_of_processor() -> str:
    """A name for what programs are compiled for: homes are shared by machines of several kinds."""
    try:
        lines = pathlib.Path("/proc/cpuinfo").read_text().splitlines()
        features = next((line for line in lines if line.startswith(("flags", "Features"))), "")
    except OSError:
        features = platform.processor()
    return f"{platform.machine()}-{hashlib.sha256(features.encode()).hexdigest()[:12]}"


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
