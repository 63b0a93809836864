"""Instances of planning by name: a model, and one reward per lane.

Grids have the paper's rewards over square regions, racetracks its two rewards with other weights, Garnets (random
models) rewards uniform on [0, 1]. Discount 0.99, float64 (the caller enables `jax_enable_x64`).
"""

import functools

import numpy as np

import jaxhom
from bench.lpal_instances import (
    DISCOUNT,
    dense_garnet,
    region_of,
    region_weights,
    sparse_garnet,
    track,
    track_weights,
)

_GRIDS = {"grid16": 16, "grid32": 32, "grid48": 48, "grid100": 100, "grid316": 316}
TITLES = {name: f"{size}x{size} grid" for name, size in _GRIDS.items()} | {
    "racetrack_a": "racetrack a",
    "garnet_dense": "dense Garnet",
    "garnet_sparse": "Garnet, 5 successors",
}


@functools.cache
def build(name: str) -> jaxhom.MDP:
    """The model of an instance, without features where they are not needed for the rewards."""
    if name in _GRIDS:
        return jaxhom.gridworld(_GRIDS[name], discount=DISCOUNT, dtype=np.float64).mdp
    if name == "racetrack_a":
        return track("a")
    return dense_garnet() if name == "garnet_dense" else sparse_garnet(10_000)


def rewards(name: str, seed: int, lanes: int) -> np.ndarray:
    """[B, S, A]; fewer lanes are a prefix of more."""
    return np.stack([_reward(name, seed, lane) for lane in range(lanes)])


def _reward(name: str, seed: int, lane: int) -> np.ndarray:
    mdp = build(name)
    if name in _GRIDS:
        num_regions = 64 if _GRIDS[name] < 100 else 100
        weights = region_weights(seed, lane, num_regions)
        return np.repeat(weights[region_of(_GRIDS[name], num_regions)][:, None], mdp.num_actions, axis=1)
    if name == "racetrack_a":
        return np.asarray(mdp.features @ track_weights(seed, lane, mdp.num_features))
    return np.random.default_rng([seed, lane]).random((mdp.num_states, mdp.num_actions))
