"""The regularised map: against a fine solve by SciPy, its error against HiGHS, its derivative against differences."""

import sys

import chex
import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest

from jaxhom import homomorphism_map
from jaxhom.similarity.homomorphism_lp import plain_forward

homomorphism_map_module = sys.modules["jaxhom.similarity.regularized_map"]


def pair(seed, n=3, m=2, num_actions=2):
    rng = np.random.default_rng(seed)
    return (jnp.asarray(rng.dirichlet(np.ones(k), (k, num_actions))) for k in (n, m))


def value(source, target, f, rho):
    """rho / 2 |f|^2 + max_y <y, K f> - rho / 2 |y|^2 over |y|_1 <= 1, the inner problem by bisection."""
    size = np.abs(np.asarray(plain_forward(source, target, f))).ravel()
    low, high = 0.0, size.max()
    for _ in range(200):  # |y| = max(size - t, 0) / rho with t >= 0 such that its sum is at most 1
        middle = 0.5 * (low + high)
        low, high = (middle, high) if np.maximum(size - middle, 0).sum() > rho else (low, middle)
    y = np.maximum(size - (high if np.maximum(size, 0).sum() > rho else 0.0), 0) / rho
    return 0.5 * rho * (f**2).sum() + (y * size).sum() - 0.5 * rho * (y**2).sum()


@pytest.mark.parametrize("anchored", [True, False])
@pytest.mark.parametrize("seed", range(3))
def test_no_map_is_better(seed, anchored, rng):
    source, target = pair(seed)
    f = np.asarray(homomorphism_map(source, target, regularization=0.05, anchored=anchored))
    np.testing.assert_allclose(f.sum(axis=1), 1.0, atol=1e-12)
    assert f.min() >= 0 and (not anchored or f[0, 0] == 1)
    best = value(source, target, f, 0.05)
    for scale in (1e-3, 1e-1, 1.0):
        for _ in range(50):
            other = rng.dirichlet(np.ones(2), 3)
            if anchored:
                other[0] = [1, 0]
            assert value(source, target, (1 - scale) * f + scale * other, 0.05) >= best - 1e-9


@pytest.mark.parametrize("anchored", [True, False])
def test_error_is_near_the_optimum(anchored):
    source, target = pair(5, 4, 4)
    f = homomorphism_map(source, target, regularization=1e-3, anchored=anchored)
    optimum, _ = oracles.homomorphism_lp(np.asarray(source), np.asarray(target), anchored)
    error = oracles.homomorphism_residual(np.asarray(source), np.asarray(target), np.asarray(f))
    assert optimum - 1e-9 <= error <= optimum + 0.5e-3 * 5


@pytest.mark.parametrize("argument", [0, 1])
def test_derivative_against_differences(argument, rng):
    models = list(pair(2))
    weight = jnp.asarray(rng.normal(size=(3, 2)))
    direction = rng.normal(size=models[argument].shape)
    direction = jnp.asarray(direction - direction.mean(axis=-1, keepdims=True))

    def score(step):
        moved = list(models)
        moved[argument] = moved[argument] + step * direction
        return (weight * homomorphism_map(*moved, regularization=0.05)).sum()

    numeric = (score(1e-5) - score(-1e-5)) / 2e-5
    assert abs(numeric) > 1e-3
    np.testing.assert_allclose(jax.grad(score)(0.0), numeric, rtol=1e-4)


def test_a_map_that_is_not_found_is_no_number(monkeypatch):
    monkeypatch.setattr(homomorphism_map_module, "_MAX_ITERATIONS", 10)
    assert np.isnan(homomorphism_map(*pair(1, 4, 3, 1), regularization=0.03)).all()


def test_vmap_agrees():
    pairs = [tuple(pair(seed)) for seed in range(3)]
    sources, targets = (jnp.stack(models) for models in zip(*pairs, strict=True))
    batched = jax.vmap(homomorphism_map)(sources, targets)
    chex.assert_trees_all_close(batched, jnp.stack([homomorphism_map(*models) for models in pairs]), atol=1e-10)


def test_rejections():
    source, target = pair(0)
    with pytest.raises(ValueError, match="regularization must be positive"):
        homomorphism_map(source, target, regularization=0.0)
    for option in ("regularization", "anchored"):
        with pytest.raises(ValueError, match=f"{option} is a traced value"):
            jax.jit(lambda value, name=option: homomorphism_map(source, target, **{name: value}))(1.0)
    np.testing.assert_array_equal(homomorphism_map(source, target, regularization=jnp.float64(0.05)).shape, (3, 2))
    with pytest.raises(ValueError, match=r"target must have shape \[m, 2, m\]"):
        homomorphism_map(source, jnp.ones((2, 3, 2)) / 2)
