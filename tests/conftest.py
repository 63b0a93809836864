"""float64 for every test, the small models that the tests share (see `small_models`), and a bound on memory."""

import gc
import os
import pathlib

import jax
import numpy as np
import pytest
import small_models

jax.config.update("jax_enable_x64", True)

_MUCH = float(os.environ.get("JAXHOM_TESTS_BYTES", 1.5e9))


@pytest.fixture(params=small_models.NAMES)
def case(request):
    """Every small model in turn."""
    return small_models.case(request.param)


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture(autouse=True, scope="module")
def compiled_programs_leave():
    """Compiled programs of former files add up to gigabytes: they go where a process has become large."""
    yield
    statistics = pathlib.Path("/proc/self/statm")
    if statistics.exists():
        resident = int(statistics.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
        if resident > _MUCH:
            jax.clear_caches()
            gc.collect()
