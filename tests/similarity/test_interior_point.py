"""The interior-point method's linear algebra against dense NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxhom.similarity import interior_point
from jaxhom.similarity.homomorphism_lp import HomomorphismProblem, plain_forward
from jaxhom.similarity.newton import factorise, normal_matrix
from jaxhom.solvers.inverse_factor import inverse_factor


@pytest.mark.parametrize("size", [1, 7, 10, 11, 25, 47])
def test_inverse_factor(size, rng):
    roots = rng.normal(size=(3, size, size))
    matrices = roots @ roots.transpose(0, 2, 1) + np.eye(size)
    found = np.asarray(jax.vmap(inverse_factor)(jnp.asarray(matrices)))
    np.testing.assert_allclose(found, np.linalg.inv(np.linalg.cholesky(matrices)), rtol=0, atol=1e-12)


def test_inverse_factor_of_an_indefinite_matrix_is_nan():
    assert np.isnan(inverse_factor(jnp.diag(jnp.asarray([1.0, -1.0])))).any()


def models(rng, n, m, num_actions=2):
    return rng.dirichlet(np.ones(n), (n, num_actions)), rng.dirichlet(np.ones(m), (m, num_actions))


def operator(source, target):
    """K as a matrix, column by column."""
    n, m = len(source), len(target)
    units = np.eye(n * m).reshape(-1, n, m)
    return np.stack([np.asarray(plain_forward(source, target, unit)).ravel() for unit in units], axis=1)


@pytest.mark.parametrize("first", [0, 1])
@pytest.mark.parametrize(("n", "m"), [(3, 3), (2, 4), (5, 1)])
def test_normal_matrix(n, m, first, rng):
    source, target = models(rng, n, m)
    weight = rng.random((n, 2, m))
    matrix = operator(source, target)[:, first * m :]
    expected = matrix.T @ (weight.reshape(-1, 1) * matrix)
    np.testing.assert_allclose(normal_matrix(source, target, weight, first), expected, rtol=0, atol=1e-13)


@pytest.mark.parametrize("anchored", [False, True])
def test_newton_direction(anchored, rng):
    """It solves the linearised central path, written out with a dense K; the second lane is padded."""
    n, m, num_actions, size = 4, 3, 2, (3, 2)
    lanes = [models(rng, n, m), models(rng, *size)]
    source, target = np.zeros((n, num_actions, n, 2)), np.zeros((m, num_actions, m, 2))
    for lane, (T, T_there) in enumerate(lanes):
        source[: len(T), :, : len(T), lane], target[: len(T_there), :, : len(T_there), lane] = T, T_there
    problem = HomomorphismProblem(
        source=jnp.asarray(source),
        target=jnp.asarray(target),
        source_size=jnp.asarray([n, size[0]]),
        target_size=jnp.asarray([m, size[1]]),
        anchored=anchored,
    )
    real = np.zeros((n, m, 2), bool)
    real[:, :, 0], real[: size[0], : size[1], 1] = True, True
    free = real.copy()
    free[0] &= not anchored
    is_row = np.broadcast_to(real[:, None], (n, num_actions, m, 2))
    d_plus, d_minus, r_plus, r_minus = (np.where(is_row, rng.random(is_row.shape), 0.0) for _ in range(4))
    d_f, r_f = rng.random((2, n, m, 2))
    direction = factorise(problem, is_row, free, jnp.asarray(d_plus), jnp.asarray(d_minus), jnp.asarray(d_f))
    df, change, de, plus, minus, z = map(np.asarray, direction(jnp.asarray(r_plus), jnp.asarray(r_minus), r_f))
    for lane in range(2):
        matrix = operator(source[..., lane], target[..., lane])
        product = (matrix @ df[..., lane].ravel()).reshape(n, num_actions, m)
        np.testing.assert_allclose(change[..., lane], product, rtol=0, atol=1e-12)
        at = is_row[..., lane]
        expected = (r_plus - d_plus * (de - change))[..., lane], (r_minus - d_minus * (de + change))[..., lane]
        np.testing.assert_allclose(plus[..., lane], np.where(at, expected[0], 0.0), rtol=0, atol=1e-12)
        np.testing.assert_allclose(minus[..., lane], np.where(at, expected[1], 0.0), rtol=0, atol=1e-12)
        np.testing.assert_allclose((plus + minus)[..., lane].sum(), 1.0, rtol=1e-11)
        np.testing.assert_allclose(df[..., lane].sum(axis=1), 0.0, rtol=0, atol=1e-11)
        np.testing.assert_array_equal(df[..., lane][~free[..., lane]], 0.0)
        # Dual feasibility: K^T y - z is constant along the free part of every row.
        rest = (matrix.T @ (plus - minus)[..., lane].ravel()).reshape(n, m) - z[..., lane]
        for row, columns in zip(rest, free[..., lane], strict=True):
            if columns.any():
                np.testing.assert_allclose(row[columns], row[columns][0], rtol=0, atol=1e-11)


def test_a_refused_step_leaves_a_valid_bracket(rng):
    """A model with NaN has no step: the lane stops, the other one goes on."""
    pairs = [models(rng, 3, 3) for _ in range(2)]
    source, target = (jnp.asarray(np.stack(side, axis=-1)) for side in zip(*pairs, strict=True))
    sizes = jnp.full(2, 3)
    options = {"source_size": sizes, "target_size": sizes, "anchored": True}
    problem = HomomorphismProblem(source=source, target=target, **options)
    broken = HomomorphismProblem(source=source.at[0, 0, 0, 1].set(jnp.nan), target=target, **options)
    started = interior_point.init(problem)
    moved = interior_point.step(broken, started)
    np.testing.assert_array_equal(moved.alive, [True, False])
    np.testing.assert_array_equal(moved.f[..., 1], started.f[..., 1])
    assert moved.upper[0] < started.upper[0]
