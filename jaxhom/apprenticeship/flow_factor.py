"""What PDHG on the flow shares between lanes, made once on the host: a model in block order, and its factor."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
import scipy

from jaxhom import checks
from jaxhom.apprenticeship.exact import compact_features
from jaxhom.apprenticeship.flow_splitting import FlowFactor, Splitting
from jaxhom.models.construction import make_dynamics
from jaxhom.models.mdp import MDP
from jaxhom.planning.flow_matrix import flow_matrix
from jaxhom.solvers.block_tridiagonal import BlockCholesky, Blocks, order_in_blocks

if TYPE_CHECKING:
    from jax.typing import DTypeLike
    from jaxtyping import Array, Float, Int

_REGULARISATIONS = (0.0, 1e-14, 1e-12, 1e-10, 1e-8)  # shares of the diagonal, to be tried in turn
MAX_ENTRIES = 2**28  # of the factor: 2 GB in float64


def factor_entries(mdp: MDP) -> tuple[Blocks, int]:
    """The order of the states for a model's factor, and how many numbers that takes."""
    flow = abs(flow_matrix(mdp))
    pattern = flow.toarray() @ flow.toarray().T if mdp.is_dense else flow @ flow.T
    blocks = order_in_blocks(scipy.sparse.csr_array(pattern)).rounded()
    return blocks, 2 * blocks.count * blocks.size**2


def feature_units(size: Float[np.ndarray, " K"] | Float[Array, " K"]) -> Float[np.ndarray, " K"] | Float[Array, " K"]:
    """c [K]: one unit for features of sizes [K] that hardly differ, and for those that do one a power of 16 smaller."""
    numpy = np if isinstance(size, np.ndarray) else jnp
    largest = numpy.where(size.max() > 0, size.max(), 1.0)
    smaller = numpy.floor(numpy.log2(largest / numpy.where(size > 0, size, largest)) / 4.0)
    return largest * 16.0**-smaller


def split_flow(mdp: MDP, unit: Float[np.ndarray, " K"], dtype: DTypeLike) -> tuple[Splitting, Int[np.ndarray, " S"]]:
    """The program of a model without its expectations, and the order in which it has the states.

    Args:
      mdp: the model.
      unit: [K], that of each feature.
      dtype: of the iterations.

    Raises:
      ValueError: if the factor would take more than 2 GB.
    """
    blocks, entries = factor_entries(mdp)
    if entries > MAX_ENTRIES:
        raise ValueError(
            f"method='pdhg' needs a factor of {entries:.1e} entries for this model of {mdp.num_states} states, "
            f"more than {MAX_ENTRIES:.1e}: use method='columns'"
        )
    features = np.asarray(mdp.features, np.float64) / unit
    share = None if (unit == unit[0]).all() else checks.to_device(unit.min() / unit, dtype)
    ordered = compact_features(features, np.asarray(mdp.allowed))[blocks.order]
    splitting = Splitting(
        mdp=_reordered(mdp, blocks, dtype),
        features=checks.to_device(ordered, dtype),
        factor=_factor(mdp, features, blocks, dtype),
        share=share,
    )
    return splitting, blocks.order


def _factor(mdp: MDP, features: Float[np.ndarray, "S A K"], blocks: Blocks, dtype: DTypeLike) -> FlowFactor:
    flow, phi = flow_matrix(mdp), features.reshape(-1, features.shape[-1])  # 0 where not allowed
    if mdp.is_dense:  # a sparse product of full matrices takes seconds
        flow = flow.toarray()
    factor, cross = _cholesky(scipy.sparse.csr_array(flow @ flow.T), blocks), flow @ phi
    behind = factor.solve(cross)
    schur = phi.T @ phi + np.eye(phi.shape[1]) - cross.T @ behind
    lower, diagonal = factor.unit_factor()
    ordered = behind[blocks.order]
    arrays = {"lower": lower, "diagonal": diagonal, "behind": ordered, "schur": np.linalg.inv(schur)}
    return FlowFactor(**{name: checks.to_device(np.ascontiguousarray(array), dtype) for name, array in arrays.items()})


def _cholesky(normal: scipy.sparse.sparray, blocks: Blocks) -> BlockCholesky:
    """With as little regularisation as rounding asks for: certificates do not need exact projections."""
    for share in _REGULARISATIONS:
        try:
            return BlockCholesky(blocks.cut(normal), blocks, share)
        except np.linalg.LinAlgError:
            continue
    return BlockCholesky(blocks.cut(normal), blocks, 1.0)


def _reordered(mdp: MDP, blocks: Blocks, dtype: DTypeLike) -> MDP:
    """The model without features, in the given order of the states."""
    order, nothing = blocks.order, np.zeros((mdp.num_states, mdp.num_actions, 0))
    probability = np.asarray(mdp.probability)[order]
    if mdp.is_dense:
        next_state, probability = np.asarray(mdp.next_state), probability[..., order]
    else:
        next_state = np.where(probability > 0, blocks.place[np.asarray(mdp.next_state)[order]], 0)
        ascending = np.argsort(np.where(probability > 0, next_state, len(order)), axis=-1, kind="stable")
        next_state, probability = (np.take_along_axis(a, ascending, axis=-1) for a in (next_state, probability))
    return dataclasses.replace(
        mdp,
        dynamics=make_dynamics(next_state, probability, dtype),
        initial=checks.to_device(np.asarray(mdp.initial)[order], dtype),
        features=checks.to_device(nothing, dtype),
        discount=checks.to_device(np.asarray(mdp.discount), dtype),
        allowed=checks.to_device(np.asarray(mdp.allowed)[order], jnp.bool_),
    )
