"""The factorisation behind the flow method, made once on the host: (M M^T)^-1 for `FlowProjection`.

F F^T links states that share a successor or follow one another: on grids a band. Reverse Cuthill-McKee finds the order,
and the band is cut into blocks as wide as itself; where it is not narrow, one block and the whole inverse.
"""

import jax.numpy as jnp
import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.sparse.linalg
from scipy.sparse.csgraph import reverse_cuthill_mckee

from jaxhom.mdp import MDP
from jaxhom.pdhg.flow_lp import FEATURE_SCALE, FlowProjection
from jaxhom.sparse_interior_point import flow_matrix

_MIN_BLOCKS = 4  # fewer, and the one product with the whole inverse is faster
_MAX_ENTRIES = 2**28  # of the factor: 2 GB in float64


def factor_flow(mdp: MDP, features: np.ndarray) -> FlowProjection:
    """Factorises the rows of the affine set.

    Args:
      mdp: the model.
      features: [S, A, K], as scaled in the program.

    Raises:
      ValueError: if the factor would take more than 2 GB.
    """
    flow, phi = flow_matrix(mdp), np.asarray(features, float).reshape(-1, features.shape[-1])
    if mdp.is_dense:  # a sparse product of full matrices takes seconds
        flow = flow.toarray()
    normal, cross = scipy.sparse.csr_array(flow @ flow.T), flow @ phi
    order, size = _order_in_blocks(normal)
    lower, diagonal = _factor_blocks(normal[order][:, order], size)
    is_whole = len(diagonal) == 1
    behind = diagonal[0] @ cross if is_whole else scipy.sparse.linalg.splu(normal.tocsc()).solve(cross)
    schur = phi.T @ phi + FEATURE_SCALE**2 * np.eye(phi.shape[1]) - cross.T @ behind
    padding = np.full(len(diagonal) * size - len(order), mdp.num_states)
    arrays = {"lower": lower, "diagonal": diagonal, "behind": behind, "schur": np.linalg.inv(schur)}
    return FlowProjection(
        order=jnp.asarray(np.concatenate([order, padding]), jnp.int32),
        place=jnp.asarray(np.argsort(order), jnp.int32),
        **{name: jnp.asarray(array, mdp.dtype) for name, array in arrays.items()},
    )


def _order_in_blocks(normal: scipy.sparse.csr_array) -> tuple[np.ndarray, int]:
    """The order of the states, and the block size that makes the matrix block tridiagonal."""
    num_states = normal.shape[0]
    order = reverse_cuthill_mckee(normal, symmetric_mode=True)
    place, pattern = np.argsort(order), normal.tocoo()
    size = max(int(np.abs(place[pattern.row] - place[pattern.col]).max()), 1)
    if _MIN_BLOCKS * size > num_states:
        order, size = np.arange(num_states), num_states
    entries = 2 * -(-num_states // size) * size**2
    if entries > _MAX_ENTRIES:
        raise ValueError(
            f"method='flow' needs a factor of {entries:.1e} entries for this model of {num_states} states, "
            f"more than {_MAX_ENTRIES:.1e}: use method='columns'"
        )
    return order, size


def _factor_blocks(matrix: scipy.sparse.csr_array, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Block Cholesky factorisation with unit diagonal: the blocks left of it, and the inverses of the middle factor."""
    count = -(-matrix.shape[0] // size)
    lower, diagonal = np.zeros((2, count, size, size))
    for i in range(count):
        here, before = slice(i * size, (i + 1) * size), slice((i - 1) * size, i * size)
        block = matrix[here, here].toarray()
        used = len(block)
        if i:
            left = matrix[here, before].toarray()
            lower[i, :used] = left @ diagonal[i - 1]
            block -= lower[i, :used] @ left.T
        diagonal[i, :used, :used] = scipy.linalg.inv(0.5 * (block + block.T))
    return lower, diagonal
