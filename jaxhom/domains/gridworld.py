"""The gridworld of Boularias and Chaib-draa (2010), section VI.A, after Abbeel and Ng (2004).

A robot on a size x size grid takes one of four compass moves. With probability `noise` the action
fails and a move drawn uniformly from the four (the chosen one among them) happens instead, so that
the chosen move happens with probability 1 - noise + noise / 4. A move into the wall stays.

The grid is cut into square, non-overlapping regions, with one indicator feature each: phi_i(s, a) =
1 if s lies in region i. The reward sum_i w_i phi_i has weights that are 0 with probability 0.9 and
uniform on (0, 1) otherwise (`sample_weights`).
"""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom import checks
from jaxhom.models.mdp import MDP
from jaxhom.programs import quick_jit
from jaxhom.status import Record

if TYPE_CHECKING:
    from jax.typing import DTypeLike
    from jaxtyping import Array, Float, Int, Key

ACTIONS = ("up", "down", "left", "right")
_MOVES = np.array([(-1, 0), (1, 0), (0, -1), (0, 1)])
_REWARDED_FRACTION = 0.1  # probability that a region's weight is not zero: the paper's


class Gridworld(Record):
    """A gridworld and its geometry; state = row * size + column, row 0 on top. See `gridworld`.

    Attributes:
      mdp: the model, S = size * size states, A = 4 actions in the order of `ACTIONS`, K =
        num_regions features.
      coordinates: int32 [S, 2], (row, column) of every state.
      region: int32 [S], the region of every state, numbered row by row; all 0 where there are no
        regions.
      size: number of rows, and of columns.
    """

    mdp: MDP
    coordinates: Int[Array, "S 2"]
    region: Int[Array, " S"]
    size: int = dataclasses.field(metadata={"static": True})


def gridworld(
    size: int,
    *,
    num_regions: int | None = None,
    noise: float = 0.3,
    discount: float = 0.99,
    start: tuple[int, int] = (0, 0),
    dtype: DTypeLike | None = None,
) -> Gridworld:
    """Builds the gridworld of section VI.A. On the host: not under `jit`, `vmap` or `grad`.

    Args:
      size: number of rows and of columns, at least 1.
      num_regions: number of square regions K; its root must divide `size`. None: no features (K =
        0).
      noise: probability in [0, 1] that the action fails and a uniformly random move happens.
      discount: scalar, strictly between 0 and 1.
      start: (row, column) of the cell that the robot starts in.
      dtype: floating-point type of the model; JAX's default if None (float64 needs
        `jax_enable_x64`).

    Returns:
      The gridworld; its `mdp.features` [S, A, K] are the indicators of the regions.

    Raises:
      ValueError: if `size` or `noise` is out of range, `start` lies outside the grid, or
        `num_regions` is not a square number whose root divides `size`.

    Example:
      >>> world = gridworld(16, num_regions=64)
      >>> world.mdp.num_states, world.mdp.num_features
      (256, 64)

    Source: Boularias and Chaib-draa 2010, section VI.A.
    """
    size = checks.require_count("size", size)
    if not 0.0 <= checks.require_number("noise", noise) <= 1.0:
        raise ValueError(f"noise must lie in [0, 1], got {noise}")
    row, column = checks.require_cell("start", start)
    if not (0 <= row < size and 0 <= column < size):
        raise ValueError(f"start must be a cell of the {size} x {size} grid, got {tuple(start)}")
    checks.require_float_type("dtype", dtype)
    coordinates = np.stack(np.divmod(np.arange(size * size), size), axis=-1)
    region, features = np.zeros(size * size, np.int64), None
    if num_regions is not None:
        side = _region_side(size, num_regions)
        region = (coordinates // side) @ np.array([size // side, 1])
        features = region[:, None] == np.arange(num_regions)
    next_state, probability = _transition(coordinates, size, noise)
    initial = np.zeros(size * size)
    initial[row * size + column] = 1.0
    mdp = MDP.from_successors(
        next_state,
        np.asarray(probability, dtype),
        discount=discount,
        initial=initial,
        features=features,
    )
    return Gridworld(
        mdp=mdp,
        coordinates=checks.to_device(coordinates, jnp.int32),
        region=checks.to_device(region, jnp.int32),
        size=size,
    )


@checks.eager_where_concrete
def sample_weights(key: Key[Array, ""], num_regions: int) -> Float[Array, " K"]:
    """Draws one weight per region: 0 with probability 0.9, otherwise uniform on (0, 1).

    A draw of nothing but zeros would make every policy optimal, so it is repeated until a weight is
    positive (with 16 regions 19% of draws are repeated). Works under `vmap` over keys, and under
    `jit` with `num_regions` static.

    Args:
      key: a `jax.random` key; the same key gives the same weights.
      num_regions: K, at least 1.

    Returns:
      float [K] in JAX's default type, the w of the reward sum_i w_i phi_i; not normalised.

    Raises:
      ValueError: if `num_regions` is below 1, or `key` is none.

    Example:
      >>> weights = sample_weights(jax.random.key(0), 64)
      >>> weights.shape, bool((weights > 0).any()), bool((weights < 1).all())
      ((64,), True, True)

    Source: Boularias and Chaib-draa 2010, section VI.A.
    """
    checks.require_key(key)
    num_regions = checks.require_count("num_regions", num_regions)
    return (_weights_at_hand if checks.is_at_hand(key) else _weights)(key, num_regions)


def _draws(key: Key[Array, ""], num_regions: int) -> Float[Array, " K"]:
    """Draws until one is positive."""

    def draw(key):
        which, value = jax.random.split(key)
        rewarded = jax.random.bernoulli(which, _REWARDED_FRACTION, (num_regions,))
        return jnp.where(rewarded, jax.random.uniform(value, (num_regions,)), 0.0)

    def redraw(state):
        key, now = jax.random.split(state[0])
        return key, draw(now)

    def is_zero(state):
        return ~jnp.any(state[1] > 0)

    _, weights = jax.lax.while_loop(is_zero, redraw, redraw((key, None)))
    return weights


_weights, _weights_at_hand = jax.jit(_draws, static_argnums=1), quick_jit(_draws, static_argnums=1)


def _transition(coordinates, size: int, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Successors, probabilities [S, 4, 5]: slot 0 is the chosen move, 1-4 the random one."""
    moved = np.clip(coordinates[:, None] + _MOVES, 0, size - 1)  # [S, 4, 2]
    landing = moved @ np.array([size, 1])
    at_random = np.broadcast_to(landing[:, None], (size * size, 4, 4))
    next_state = np.concatenate([landing[..., None], at_random], axis=-1)
    probability = np.array([1.0 - noise] + [noise / 4] * 4)
    return next_state, np.broadcast_to(probability, next_state.shape)


def _region_side(size: int, num_regions: int) -> int:
    """Returns the side of a region in cells, or raises."""
    root = math.isqrt(checks.require_count("num_regions", num_regions))
    if root * root != num_regions or size % root:
        raise ValueError(
            f"num_regions must be a square number whose root divides the size: got {num_regions} for size {size}"
        )
    return size // root
