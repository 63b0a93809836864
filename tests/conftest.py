"""float64 for every test, and the small models that the tests share (see `small_models`)."""

import jax
import numpy as np
import pytest
import small_models

jax.config.update("jax_enable_x64", True)


@pytest.fixture(params=small_models.NAMES)
def case(request):
    """Every small model in turn."""
    return small_models.case(request.param)


@pytest.fixture
def rng():
    return np.random.default_rng(0)
