"""The factorisation behind the flow method, made once on the host: (M M^T)^-1 for `FlowProjection`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
import scipy.sparse

from jaxhom import checks
from jaxhom.apprenticeship.flow_lp import FEATURE_SCALE, FlowProjection
from jaxhom.models.mdp import MDP
from jaxhom.planning.flow_matrix import flow_matrix
from jaxhom.solvers.block_tridiagonal import BlockCholesky, order_in_blocks

if TYPE_CHECKING:
    from jaxtyping import Float

_REGULARISATIONS = (0.0, 1e-14, 1e-12, 1e-10, 1e-8)  # shares of the diagonal, to be tried in turn
_MAX_ENTRIES = 2**28  # of the factor: 2 GB in float64


def factor_flow(mdp: MDP, features: Float[np.ndarray, "S A K"]) -> FlowProjection:
    """Factorises the rows of the affine set.

    Args:
      mdp: the model.
      features: [S, A, K], as scaled in the program.

    Raises:
      ValueError: if the factor would take more than 2 GB.
    """
    flow, phi = flow_matrix(mdp), np.asarray(features, float).reshape(-1, features.shape[-1])  # 0 where not allowed
    if mdp.is_dense:  # a sparse product of full matrices takes seconds
        flow = flow.toarray()
    normal, cross = scipy.sparse.csr_array(flow @ flow.T), flow @ phi
    blocks = order_in_blocks(normal)
    entries = 2 * blocks.count * blocks.size**2
    if entries > _MAX_ENTRIES:
        raise ValueError(
            f"method='flow' needs a factor of {entries:.1e} entries for this model of {mdp.num_states} states, "
            f"more than {_MAX_ENTRIES:.1e}: use method='columns'"
        )
    factor = _factor(normal, blocks)
    behind = factor.solve(cross)
    schur = phi.T @ phi + FEATURE_SCALE**2 * np.eye(phi.shape[1]) - cross.T @ behind
    padding = np.full(blocks.count * blocks.size - len(blocks.order), mdp.num_states)
    lower, diagonal = factor.unit_factor()
    arrays = {"lower": lower, "diagonal": diagonal, "behind": behind, "schur": np.linalg.inv(schur)}
    return FlowProjection(
        order=checks.to_device(np.concatenate([blocks.order, padding]), jnp.int32),
        place=checks.to_device(blocks.place, jnp.int32),
        **{name: checks.to_device(array, mdp.dtype) for name, array in arrays.items()},
    )


def _factor(normal, blocks) -> BlockCholesky:
    """With as little regularisation as rounding asks for: certificates do not need exact projections."""
    for share in _REGULARISATIONS:
        try:
            return BlockCholesky(normal, blocks, share)
        except np.linalg.LinAlgError:
            continue
    return BlockCholesky(normal, blocks, 1.0)
