"""`flow_factor` for models whose numbers are traced: the factor of the flow is made inside the program.

Only the graph is read on the host: which blocks there are, and where in them the products of two entries of F go. A
model whose graph is traced too has one block, and so has one whose band is not narrow.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
import scipy

from jaxhom.apprenticeship.flow_splitting import FlowFactor, Splitting
from jaxhom.models.mdp import MDP, push_forward
from jaxhom.solvers.block_tridiagonal import Blocks, order_in_blocks
from jaxhom.solvers.inverse_factor import inverse_factor

if TYPE_CHECKING:
    from jaxtyping import Array, Float, Int

_MOST_STATES = 4096  # of one block: its factor takes S^3 operations
_MOST_PRODUCTS = 2**26  # of two entries of one column of F: half a gigabyte of places
_REGULARISATION = 8.0  # times eps, share of the diagonal: certificates do not need exact projections


def split_flow_in_program(mdp: MDP, features: Float[Array, "S A K"], unit: Float[Array, " K"]) -> Splitting:
    """The program of a traced model without its expectations, its states in their own order.

    Args:
      mdp: the model.
      features: its features, in units of their own.
      unit: [K], these units.

    Raises:
      ValueError: if the graph is no narrow band, or traced, and has more than 4,096 states.
    """
    blocks = _blocks(mdp)
    if blocks.count == 1 and mdp.num_states > _MOST_STATES:
        raise ValueError(
            f"lpal inside a program needs a model whose graph is concrete and a narrow band, or one of up to "
            f"{_MOST_STATES} states, got {mdp.num_states} states: build the model outside, close over it, and exchange "
            f"its arrays by mdp.replace(...)"
        )
    diagonal, left = _one_block(mdp) if blocks.count == 1 else _band(mdp, blocks)
    corners = jnp.arange(blocks.size)
    share = 1.0 + _REGULARISATION * float(jnp.finfo(mdp.dtype).eps)
    diagonal = diagonal.at[:, corners, corners].multiply(share)
    order = None if blocks.count == 1 else jnp.asarray(np.stack([blocks.order, blocks.place]).astype(np.int32))
    nothing = jnp.zeros((*mdp.allowed.shape, 0), mdp.dtype)
    return Splitting(
        mdp=mdp.replace(features=nothing),
        features=features,
        factor=_factor(mdp, features, *_unit_factor(diagonal, left), order),
        share=unit.min() / unit,
    )


def _blocks(mdp: MDP) -> Blocks:
    """The order in which F F^T is block tridiagonal."""
    slots = mdp.dynamics.known_slots()
    everyone = np.arange(mdp.num_states)
    if slots is None or mdp.is_dense:
        return Blocks(order=everyone, place=everyone, size=mdp.num_states)
    pair, _ = divmod(np.flatnonzero(slots), slots.shape[-1])
    successor = np.asarray(mdp.next_state)[slots]
    state = np.arange(slots.shape[0] * slots.shape[1])
    entries = (np.append(pair, state), np.append(successor, state // slots.shape[1]))
    columns = scipy.sparse.csr_array((np.ones(len(entries[0])), entries), shape=(len(state), mdp.num_states))
    blocks = order_in_blocks(columns.T @ columns)
    products = slots.shape[0] * slots.shape[1] * (slots.shape[2] + 1) ** 2
    if products > _MOST_PRODUCTS:
        return Blocks(order=everyone, place=everyone, size=mdp.num_states)
    return blocks


def _one_block(mdp: MDP) -> tuple[Float[Array, "1 S S"], Float[Array, "1 S S"]]:
    """F F^T as a matrix."""
    num_states = mdp.num_states
    moves = mdp.transition.reshape(-1, num_states)
    onward = mdp.discount * mdp.transition.sum(axis=1)
    normal = mdp.discount**2 * (moves.T @ moves) - onward - onward.T
    normal += jnp.diag(mdp.allowed.sum(axis=1).astype(mdp.dtype))
    return normal[None], jnp.zeros_like(normal[None])


def _band(mdp: MDP, blocks: Blocks) -> tuple[Float[Array, "nb n n"], Float[Array, "nb n n"]]:
    """The blocks of F F^T on the diagonal, and those left of it."""
    slots = mdp.dynamics.known_slots()
    num_states, num_actions, _ = slots.shape
    own = np.broadcast_to(np.arange(num_states)[:, None, None], (num_states, num_actions, 1))
    # Every column (s, a) of F has an entry for s itself, and one for each successor; unused slots stand for s, with 0.
    rows = blocks.place[np.concatenate([own, np.where(slots, np.asarray(mdp.next_state), own)], axis=-1)]
    entries = jnp.concatenate([mdp.allowed.astype(mdp.dtype)[..., None], -mdp.discount * mdp.probability], axis=-1)
    products = entries[..., :, None] * entries[..., None, :]
    (i, k), (j, m) = divmod(rows[..., :, None], blocks.size), divmod(rows[..., None, :], blocks.size)
    size = blocks.count * blocks.size**2
    target = np.where(i == j, 0, np.where(i == j + 1, size, 2 * size)) + (i * blocks.size + k) * blocks.size + m
    target = np.where(i < j, 2 * size, np.minimum(target, 2 * size))  # the upper half is the lower one's
    both = jnp.zeros(2 * size + 1, mdp.dtype).at[target.astype(np.int32)].add(products)[:-1]
    diagonal, left = both.reshape(2, blocks.count, blocks.size, blocks.size)
    filling = np.arange(num_states - (blocks.count - 1) * blocks.size, blocks.size)
    return diagonal.at[-1, filling, filling].set(1.0), left


def _unit_factor(
    diagonal: Float[Array, "nb n n"], left: Float[Array, "nb n n"]
) -> tuple[Float[Array, "nb n n"], Float[Array, "nb n n"]]:
    """Blocks left of the unit diagonal of U, and the inverses of those of C, in U C U^T = N."""

    def eliminate(former, blocks):
        diagonal, left = blocks
        lower = left @ former
        root = inverse_factor(diagonal - lower @ left.T)
        inverse = root.T @ root
        return inverse, (lower, inverse)

    return jax.lax.scan(eliminate, jnp.zeros_like(diagonal[0]), (diagonal, left))[1]


def _factor(mdp: MDP, features, lower, diagonal, order: Int[Array, "2 S"] | None) -> FlowFactor:
    num_features = features.shape[-1]
    nothing = jnp.zeros((mdp.num_states, num_features), mdp.dtype)
    factor = FlowFactor(lower=lower, diagonal=diagonal, behind=nothing, schur=nothing[:0], order=order)
    used = jnp.where(mdp.allowed[..., None], features, 0.0)
    cross = used.sum(axis=1) - mdp.discount * push_forward(mdp, used)  # F Phi
    behind = factor.solve_flow(cross)
    flat = used.reshape(-1, num_features)
    root = inverse_factor(flat.T @ flat + jnp.eye(num_features, dtype=mdp.dtype) - cross.T @ behind)
    return factor.replace(behind=behind, schur=root.T @ root)
