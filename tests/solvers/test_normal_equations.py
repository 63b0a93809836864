"""Block factors and the systems of interior-point steps, against NumPy's dense algebra."""

import numpy as np
import pytest
import scipy.sparse

from jaxhom import gridworld
from jaxhom.planning.flow_matrix import flow_matrix
from jaxhom.solvers import normal_equations
from jaxhom.solvers.block_tridiagonal import BlockCholesky, order_in_blocks
from jaxhom.solvers.normal_equations import Rows


def banded(rng, size, width):
    """A positive definite matrix of the given bandwidth, its unknowns shuffled."""
    apart = np.abs(np.arange(size)[:, None] - np.arange(size))
    half = rng.normal(size=(size, size)) * (apart <= width // 2)
    shuffled = rng.permutation(size)
    return (half @ half.T + np.eye(size))[np.ix_(shuffled, shuffled)]


@pytest.mark.parametrize(("size", "width", "min_size", "count"), [(40, 4, 1, 10), (41, 4, 8, 6), (12, 8, 1, 1)])
def test_block_cholesky(size, width, min_size, count, rng):
    """Whole blocks, a last block that is filled up, and one block for all."""
    matrix = banded(rng, size, width)
    blocks = order_in_blocks(matrix, min_size)
    assert blocks.count == count
    factor = BlockCholesky(blocks.cut(scipy.sparse.csr_array(matrix)), blocks)
    for right in (rng.normal(size=size), rng.normal(size=(size, 3))):
        np.testing.assert_allclose(factor.solve(right), np.linalg.solve(matrix, right), rtol=0, atol=1e-10)
    # U C U^T = N in the order of the blocks
    left, inverse = factor.unit_factor()
    unit, middle = np.eye(count * blocks.size), np.zeros((count * blocks.size,) * 2)
    for i in range(count):
        here, before = (slice(j * blocks.size, (j + 1) * blocks.size) for j in (i, i - 1))
        middle[here, here] = np.linalg.inv(inverse[i])
        if i:
            unit[here, before] = left[i]
    ordered = (unit @ middle @ unit.T)[:size, :size]
    np.testing.assert_allclose(ordered, matrix[np.ix_(blocks.order, blocks.order)], rtol=0, atol=1e-10)


@pytest.mark.parametrize("size", [3, 40])
def test_a_matrix_that_is_not_positive_definite(size):
    matrix = np.eye(size)
    matrix[2, 2] = -1.0
    with pytest.raises(np.linalg.LinAlgError, match="minor"):
        blocks = order_in_blocks(matrix)
        BlockCholesky(blocks.cut(matrix), blocks)


def program(kind):
    """Rows of an 8x8 grid's flow and of features: few that share no pair, one per state, or two that overlap."""
    world = gridworld(8, num_regions=4)
    flow, pairs = flow_matrix(world.mdp), 64 * 4
    features = {
        "regions": np.asarray(world.mdp.features).reshape(pairs, 4),
        "states": np.repeat(np.eye(64), 4, axis=0),
        "overlapping": np.random.default_rng(0).uniform(size=(pairs, 2)),
    }[kind]
    count = features.shape[1]
    slack = -scipy.sparse.eye_array(count)
    matrix = scipy.sparse.block_array([[flow, None], [scipy.sparse.csr_array(features.T), slack]])
    return matrix, np.concatenate([np.zeros(64), -np.ones(count)])[:, None]


@pytest.mark.parametrize("kind", ["regions", "states", "overlapping"])
def test_systems_of_a_step(kind, rng):
    """Scales that differ by eight orders of magnitude, as near the end of an interior-point method."""
    matrix, free_columns = program(kind)
    rows, dense = Rows(matrix, free_columns, 64), matrix.toarray()
    if kind != "regions":
        assert isinstance(rows._normal, normal_equations._Before) == (kind == "states")
    num_rows = len(dense)
    d = 10.0 ** rng.uniform(-6, 2, size=dense.shape[1])
    rows.factor(d)
    right, free_right = rng.normal(size=num_rows), rng.normal(size=1)
    y, f = rows.solve(right, free_right)
    normal = (dense * d) @ dense.T
    left_over = right - normal @ y - free_columns @ f
    # what is left over, against the size of what cancels
    assert np.abs(left_over).max() <= 1e-9 * np.abs(normal @ np.abs(y)).max()
    np.testing.assert_allclose(free_columns.T @ y, free_right, rtol=1e-9)


@pytest.mark.parametrize("most", [0, np.inf], ids=["by SciPy", "by known products"])
@pytest.mark.parametrize("kind", ["regions", "states"])
def test_both_orders_of_elimination_agree(kind, most, rng, monkeypatch):
    monkeypatch.setattr(normal_equations, "_MANY_PRODUCTS", most)
    matrix, free_columns = program(kind)
    d = rng.uniform(0.1, 1.0, size=matrix.shape[1])
    right = rng.normal(size=matrix.shape[0])
    normal = (matrix.toarray() * d) @ matrix.toarray().T
    exact = np.linalg.solve(normal, right)
    core, others = matrix.tocsr()[:64], matrix.tocsr()[64:]
    for order in (normal_equations._Before, normal_equations._After):
        system = order(core, others)
        system.prepare()
        system.factor(d)
        np.testing.assert_allclose(system.solve(right), exact, rtol=1e-6)
        np.testing.assert_allclose(system.solve(free_columns), np.linalg.solve(normal, free_columns), rtol=1e-6)
