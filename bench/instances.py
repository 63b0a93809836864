"""Instances by name: of LPAL a model and the feature expectations of B experts, of planning a model and B rewards.

Every lane of LPAL has a reward of its own, the expert that is optimal for it, and its own errors. The expectations of
the expert are either exact, or averages over a few demonstrations (Monte Carlo), or *perturbed*: exact, and each
feature's multiplied by a number uniform on [0.8, 1.2], as if estimated from little data. Planning has the paper's
rewards, and on Garnets (random models) rewards uniform on [0, 1]; its models have features only where rewards need it.
All follow from a seed; a smaller number of lanes is a prefix of a larger one. Discount 0.99, float64 (the caller
enables `jax_enable_x64`).
"""

import dataclasses
import functools
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
_LOOSE_EXPERTS = 0.1  # of the gap per step
_LANES_AT_ONCE = 8  # of experts that are planned for together, which bounds the memory on the largest grid
_TRACK_WEIGHTS = np.array([5.0, 200.0])  # on the road, at the finish (Boularias and Chaib-draa 2010, section VI.B)


@dataclasses.dataclass(frozen=True)
class Instance:
    """How an instance of LPAL is drawn.

    Attributes:
      title: what tables call it.
      build: () -> the model.
      weights: (seed, lane, K) -> reward weights [K] of the lane's expert.
      expectations: "exact", "perturbed" or "monte_carlo".
      horizon: steps of each demonstration, for Monte Carlo.
      gap: that is asked for, as a share of 1 / (1 - discount), all features being within [0, 1]; the library's default
        if None.
      most_lanes: that are measured.
      has_peers: whether other solvers are.
    """

    title: str
    build: Callable[[], jaxhom.MDP]
    weights: Callable[[int, int, int], np.ndarray]
    expectations: str = "perturbed"
    horizon: int = 0
    gap: float | None = None
    most_lanes: int | None = None
    has_peers: bool = True

    def draw(self, seed: int, lanes: int) -> tuple[jaxhom.MDP, np.ndarray]:
        """The model, and expectations [B, K] of `lanes` experts."""
        mdp, parts = self.build(), np.split(np.arange(lanes), range(_LANES_AT_ONCE, lanes, _LANES_AT_ONCE))
        return mdp, np.concatenate([self._expectations(mdp, seed, part.tolist()) for part in parts])

    def _expectations(self, mdp: jaxhom.MDP, seed: int, lanes: list[int]) -> np.ndarray:
        weights = np.stack([self.weights(seed, lane, mdp.num_features) for lane in lanes])
        # Where gaps are wide experts need not be optimal to the last digit, which a million states would wait for.
        loose = {} if self.gap is None else {"tolerance": _LOOSE_EXPERTS * self.gap}
        policies = jaxhom.optimal_policy(mdp, jnp.einsum("sak,bk->bsa", mdp.features, weights), **loose).policy
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


def grid(size: int) -> jaxhom.MDP:
    """A grid without features."""
    return jaxhom.gridworld(size, discount=DISCOUNT, dtype=np.float64).mdp


def regions(size: int, num_regions: int) -> jaxhom.MDP:
    """A grid with indicators of square regions, as even as its size allows."""
    return _with_features(
        grid(size), np.asarray(region_of(size, num_regions)[:, None] == np.arange(num_regions), float)
    )


def region_of(size: int, num_regions: int) -> np.ndarray:
    """The region of every cell of a grid, [S]."""
    side = round(num_regions**0.5)
    line = np.arange(size) * side // size
    return (side * line[:, None] + line).ravel()


def bumps(size: int) -> jaxhom.MDP:
    """A grid with Gaussian bumps on a lattice of 8 x 8 cells, as wide as the lattice's spacing."""
    spacing = size / _BUMPS_PER_SIDE
    line = (np.arange(_BUMPS_PER_SIDE) + 0.5) * spacing - 0.5
    centres, cells = (np.stack(np.meshgrid(at, at, indexing="ij"), -1).reshape(-1, 2) for at in (line, np.arange(size)))
    squares = ((cells[:, None] - centres) ** 2).sum(axis=-1)
    return _with_features(grid(size), np.exp(-0.5 * squares / spacing**2))


def _with_features(mdp: jaxhom.MDP, of_states: np.ndarray) -> jaxhom.MDP:
    """A model with features [S, K], the same for every action."""
    shape = (mdp.num_states, mdp.num_actions, of_states.shape[1])
    return mdp.replace(features=jnp.broadcast_to(jnp.asarray(of_states)[:, None], shape))


def track(name: str) -> jaxhom.MDP:
    """A racetrack."""
    return jaxhom.racetrack(name, discount=DISCOUNT, dtype=np.float64).mdp


def dense_garnet() -> jaxhom.MDP:
    """Every state follows every pair, rows uniform on the simplex; 32 features uniform on [0, 1]."""
    rng, num_states = np.random.default_rng([0, 500]), 500
    transition = rng.dirichlet(np.ones(num_states), (num_states, NUM_ACTIONS))
    features = rng.random((num_states, NUM_ACTIONS, 32))
    return jaxhom.MDP.from_dense(transition, discount=DISCOUNT, features=features)


def sparse_garnet() -> jaxhom.MDP:
    """Five random successors for every pair, their probabilities uniform on the simplex; no features."""
    num_states, successors = 10_000, 5
    rng = np.random.default_rng([0, num_states, successors])
    next_state = rng.integers(num_states, size=(num_states, NUM_ACTIONS, successors))
    probability = rng.dirichlet(np.ones(successors), (num_states, NUM_ACTIONS))
    return jaxhom.MDP.from_successors(next_state, probability, discount=DISCOUNT)


# ------------------------------------------------------------------------------------------------------------ rewards


def region_weights(seed: int, lane: int, num_regions: int) -> np.ndarray:
    """The paper's draw: one weight in ten is not 0."""
    return np.asarray(jaxhom.sample_weights(jax.random.fold_in(jax.random.key(seed), lane), num_regions), float)


def track_weights(seed: int, lane: int, num_features: int) -> np.ndarray:
    """The paper's two rewards, each times a number uniform on [0.5, 1.5]."""
    return _TRACK_WEIGHTS * np.random.default_rng([seed, lane]).uniform(0.5, 1.5, num_features)


def uniform(seed: int, lane: int, shape) -> np.ndarray:
    """Weights or rewards uniform on [0, 1]."""
    return np.random.default_rng([seed, lane]).random(shape)


# ------------------------------------------------------------------------------------------------------------- tables


def _regions(size: int, num_regions: int, expectations: str = "perturbed", horizon: int = 0) -> Instance:
    title = f"{size}x{size}, {num_regions} regions, {expectations.replace('_', ' ')}"
    return Instance(title, functools.partial(regions, size, num_regions), region_weights, expectations, horizon)


def _bumps(size: int) -> Instance:
    return Instance(f"{size}x{size}, 64 bumps, perturbed", functools.partial(bumps, size), uniform)


def _track(name: str) -> Instance:
    title = f"racetrack {name}, Monte Carlo"
    return Instance(title, functools.partial(track, name), track_weights, "monte_carlo", horizon=30)


LPAL = {
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
    "grid1000": dataclasses.replace(_regions(1000, 100), gap=0.01, most_lanes=1, has_peers=False),  # 3.2 GB of features
    "garnet": Instance("dense Garnet, S = 500, K = 32", dense_garnet, uniform),
    "racetrack_a": _track("a"),
    "racetrack_b": _track("b"),
}


def _grid(size: int, num_regions: int) -> tuple:
    def reward(mdp: jaxhom.MDP, *draw: int) -> np.ndarray:
        of_cells = region_weights(*draw, num_regions)[region_of(size, num_regions)]
        return np.repeat(of_cells[:, None], mdp.num_actions, axis=1)

    return f"{size}x{size} grid", functools.partial(grid, size), reward


def _random_reward(mdp: jaxhom.MDP, *draw: int) -> np.ndarray:
    return uniform(*draw, (mdp.num_states, mdp.num_actions))


def _track_reward(mdp: jaxhom.MDP, *draw: int) -> np.ndarray:
    return np.asarray(mdp.features @ track_weights(*draw, mdp.num_features))


PLANNING = {  # title, () -> model, (model, seed, lane) -> reward [S, A]
    **{f"grid{size}": _grid(size, 64) for size in (16, 32, 48)},
    **{f"grid{size}": _grid(size, 100) for size in (100, 316)},
    "racetrack_a": ("racetrack a", functools.partial(track, "a"), _track_reward),
    "garnet_dense": ("dense Garnet", dense_garnet, _random_reward),
    "garnet_sparse": ("Garnet, 5 successors", sparse_garnet, _random_reward),
}
