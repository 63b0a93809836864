"""Instances of LPAL by name: a model and the feature expectations of B experts, one per lane.

Every lane has a reward of its own, the expert that is optimal for it, and its own errors. The expectations of the
expert are either exact, or averages over a few demonstrations (Monte Carlo), or *perturbed*: exact, and each feature's
multiplied by a number uniform on [0.8, 1.2], as if estimated from little data. All follow from a seed; a smaller number
of lanes is a prefix of a larger one. Discount 0.99, float64 (the caller enables `jax_enable_x64`).
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

import jaxhom

DISCOUNT = 0.99  # the paper's
NUM_ACTIONS = 4  # of Garnets
_PERTURBATION = 0.2
_BUMPS_PER_SIDE = 8
_DEMONSTRATIONS = 10  # the paper's
_LANES_AT_ONCE = 8  # of experts that are planned for together, which bounds the memory on the largest grid
_TRACK_WEIGHTS = np.array([5.0, 200.0])  # on the road, at the finish (Boularias and Chaib-draa 2010, section VI.B)


@dataclasses.dataclass(frozen=True)
class Instance:
    """How an instance is drawn.

    Attributes:
      title: what tables call it.
      build: () -> the model.
      weights: (seed, lane, K) -> reward weights [K] of the lane's expert.
      expectations: "exact", "perturbed" or "monte_carlo".
      horizon: steps of each demonstration, for Monte Carlo.
    """

    title: str
    build: Callable[[], jaxhom.MDP]
    weights: Callable[[int, int, int], np.ndarray]
    expectations: str = "perturbed"
    horizon: int = 0

    def draw(self, seed: int, lanes: int) -> tuple[jaxhom.MDP, np.ndarray]:
        """The model, and expectations [B, K] of `lanes` experts."""
        mdp, parts = self.build(), np.split(np.arange(lanes), range(_LANES_AT_ONCE, lanes, _LANES_AT_ONCE))
        return mdp, np.concatenate([self._expectations(mdp, seed, part.tolist()) for part in parts])

    def _expectations(self, mdp: jaxhom.MDP, seed: int, lanes: list[int]) -> np.ndarray:
        weights = np.stack([self.weights(seed, lane, mdp.num_features) for lane in lanes])
        policies = jaxhom.optimal_policy(mdp, jnp.einsum("sak,bk->bsa", mdp.features, weights)).policy
        if self.expectations == "monte_carlo":
            return np.stack([self._monte_carlo(mdp, seed, *pair) for pair in zip(lanes, policies, strict=True)])
        found = np.asarray(jaxhom.feature_expectations(mdp, policies))
        if self.expectations == "exact":
            return found
        bounds = 1.0 - _PERTURBATION, 1.0 + _PERTURBATION, mdp.num_features
        return found * np.stack([np.random.default_rng([seed, lane, 1]).uniform(*bounds) for lane in lanes])

    def _monte_carlo(self, mdp: jaxhom.MDP, seed: int, lane: int, policy) -> np.ndarray:
        key = jax.random.fold_in(jax.random.key(seed), lane)
        shown = jaxhom.sample_demonstrations(key, mdp, policy, _DEMONSTRATIONS, self.horizon)
        return np.asarray(jaxhom.monte_carlo_feature_expectations(mdp, shown))


# ------------------------------------------------------------------------------------------------------------- models


def regions(size: int, num_regions: int) -> jaxhom.MDP:
    """A grid with indicators of square regions, as even as its size allows."""
    world = jaxhom.gridworld(size, discount=DISCOUNT, dtype=np.float64)
    features = jnp.asarray(region_of(size, num_regions)[:, None] == np.arange(num_regions), float)
    shape = (world.mdp.num_states, world.mdp.num_actions, num_regions)
    return world.mdp.replace(features=jnp.broadcast_to(features[:, None], shape))


def region_of(size: int, num_regions: int) -> np.ndarray:
    """The region of every cell of a grid, [S]."""
    side = round(num_regions**0.5)
    line = np.arange(size) * side // size
    return (side * line[:, None] + line).ravel()


def bumps(size: int) -> jaxhom.MDP:
    """A grid with Gaussian bumps on a lattice of 8 x 8 cells, as wide as the lattice's spacing."""
    world = jaxhom.gridworld(size, discount=DISCOUNT, dtype=np.float64)
    spacing = size / _BUMPS_PER_SIDE
    line = (np.arange(_BUMPS_PER_SIDE) + 0.5) * spacing - 0.5
    centres = np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2)
    squares = ((np.asarray(world.coordinates)[:, None] - centres) ** 2).sum(axis=-1)
    features = jnp.asarray(np.exp(-0.5 * squares / spacing**2))
    return world.mdp.replace(features=jnp.repeat(features[:, None], world.mdp.num_actions, axis=1))


def track(name: str) -> jaxhom.MDP:
    """A racetrack."""
    return jaxhom.racetrack(name, discount=DISCOUNT, dtype=np.float64).mdp


def dense_garnet(num_states: int = 500, num_features: int = 32) -> jaxhom.MDP:
    """Every state follows every pair, rows uniform on the simplex; features uniform on [0, 1]."""
    rng = np.random.default_rng([0, num_states])
    transition = rng.dirichlet(np.ones(num_states), (num_states, NUM_ACTIONS))
    features = rng.random((num_states, NUM_ACTIONS, num_features))
    return jaxhom.MDP.from_dense(transition, discount=DISCOUNT, features=features)


def sparse_garnet(num_states: int, successors: int = 5) -> jaxhom.MDP:
    """Random successors for every pair, their probabilities uniform on the simplex; no features."""
    rng = np.random.default_rng([0, num_states, successors])
    next_state = rng.integers(num_states, size=(num_states, NUM_ACTIONS, successors))
    probability = rng.dirichlet(np.ones(successors), (num_states, NUM_ACTIONS))
    return jaxhom.MDP.from_successors(next_state, probability, discount=DISCOUNT)


# ------------------------------------------------------------------------------------------------------------ experts


def region_weights(seed: int, lane: int, num_regions: int) -> np.ndarray:
    """The paper's draw: one weight in ten is not 0."""
    return np.asarray(jaxhom.sample_weights(jax.random.fold_in(jax.random.key(seed), lane), num_regions), float)


def track_weights(seed: int, lane: int, num_features: int) -> np.ndarray:
    """The paper's two rewards, each times a number uniform on [0.5, 1.5]."""
    return _TRACK_WEIGHTS * np.random.default_rng([seed, lane]).uniform(0.5, 1.5, num_features)


def _positive_weights(seed: int, lane: int, num_features: int) -> np.ndarray:
    return np.random.default_rng([seed, lane]).random(num_features)


def _regions(size: int, num_regions: int, expectations: str = "perturbed", horizon: int = 0) -> Instance:
    title = f"{size}x{size}, {num_regions} regions, {expectations.replace('_', ' ')}"
    return Instance(title, lambda: regions(size, num_regions), region_weights, expectations, horizon)


def _bumps(size: int) -> Instance:
    return Instance(f"{size}x{size}, 64 bumps, perturbed", lambda: bumps(size), _positive_weights)


def _track(name: str) -> Instance:
    return Instance(f"racetrack {name}, Monte Carlo", lambda: track(name), track_weights, "monte_carlo", 30)


INSTANCES = {
    "grid16": _regions(16, 64),
    "grid16_exact": _regions(16, 64, "exact"),
    "grid16_monte_carlo": _regions(16, 64, "monte_carlo", 50),
    "grid24": _regions(24, 64),
    "bumps24": _bumps(24),
    "grid32": _regions(32, 64),
    "grid48": _regions(48, 64),
    "grid48_exact": _regions(48, 64, "exact"),
    "grid48_monte_carlo": _regions(48, 64, "monte_carlo", 200),
    "bumps48": _bumps(48),
    "grid100": _regions(100, 100),
    "grid316": _regions(316, 100),
    "garnet": Instance("dense Garnet, S = 500, K = 32", dense_garnet, _positive_weights),
    "racetrack_a": _track("a"),
    "racetrack_b": _track("b"),
}
