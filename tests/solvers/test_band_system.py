"""The compiled systems of interior-point steps over a band: dense NumPy on the same matrices."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse

from jaxhom.solvers.band_system import Gathered, band_system
from jaxhom.solvers.inverse_factor import inverse_factor_in_loops

RNG = np.random.default_rng(0)


def chain(num_states, depends_on_action):
    """F of a chain with three actions, and features by group: of states, or of pairs."""
    pair = np.arange(3 * num_states)
    state, move = pair // 3, pair % 3 - 1
    after = np.clip(state + move, 0, num_states - 1)
    flow = scipy.sparse.coo_array(
        (np.r_[np.ones(len(pair)), np.full(len(pair), -0.95)], (np.r_[state, after], np.r_[pair, pair]))
    ).tocsr()
    group = pair if depends_on_action else state
    return flow, RNG.random((group.max() + 1, 5)), group


@pytest.mark.parametrize("depends_on_action", [False, True])
@pytest.mark.parametrize("num_states", [128, 150])  # whole blocks; a last one that is filled up
def test_solutions_are_those_of_dense_matrices(num_states, depends_on_action):
    flow, features, group = chain(num_states, depends_on_action)
    free_column = -1.0 / np.arange(1, 6)
    system, blocks = band_system(flow, features, group, free_column)
    assert blocks.count > 1
    lanes, pairs = 3, flow.shape[1]
    d = np.exp(RNG.normal(size=(lanes, pairs + 5)))
    right, others, free = RNG.normal(size=(lanes, num_states)), RNG.normal(size=(lanes, 5)), RNG.normal(size=lanes)
    placed = np.zeros((lanes, blocks.count * blocks.size))
    placed[:, blocks.place] = right
    y, w, f = jax.jit(lambda *a: system.solve(system.factor(a[0]), *a[1:]))(d, placed, others, free)
    matrix = np.block([[flow.toarray(), np.zeros((num_states, 5))], [features[group].T, -np.eye(5)]])
    column = np.concatenate([np.zeros(num_states), free_column])[:, None]
    for lane in range(lanes):
        whole = np.block([[(matrix * d[lane]) @ matrix.T, column], [column.T, np.zeros((1, 1))]])
        expected = np.linalg.solve(whole, np.concatenate([right[lane], others[lane], free[lane : lane + 1]]))
        found = np.concatenate([np.asarray(y)[lane, blocks.place], w[lane], f[lane : lane + 1]])
        np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-9)
    products = np.concatenate([np.asarray(part) for part in system.products(jnp.asarray(d))], axis=1)
    place = np.concatenate([blocks.place, placed.shape[1] + np.arange(5)])
    np.testing.assert_allclose(products[:, place], d @ matrix.T, atol=1e-12)
    both = np.concatenate([right, others], axis=1)
    np.testing.assert_allclose(system.transposed(placed, jnp.asarray(others)), both @ matrix, atol=1e-12)


def test_gathered_rows_of_all_lengths():
    matrix = scipy.sparse.random_array((40, 30), density=0.2, rng=RNG).tolil()
    matrix[3], matrix[7] = 0.0, 1.0
    matrix = matrix.tocsr()
    vectors = RNG.normal(size=(2, 30))
    np.testing.assert_allclose(Gathered.of(matrix) @ jnp.asarray(vectors), vectors @ matrix.toarray().T, atol=1e-13)


@pytest.mark.parametrize("size", [1, 16, 23, 64, 96, 130])
def test_inverse_factors_in_loops(size):
    half = RNG.normal(size=(2, size, size))
    matrix = half @ half.transpose(0, 2, 1) + size * np.eye(size)
    found = np.asarray(jax.jit(inverse_factor_in_loops)(matrix))
    np.testing.assert_allclose(found, np.linalg.inv(np.linalg.cholesky(matrix)), atol=1e-10)
