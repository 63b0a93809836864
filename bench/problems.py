"""Problems: a batch of draws of one setting, with the expert's plans and demonstrations.

Random numbers come from one key per sweep: a setting's key is folded from its `source`, a draw's from its number. A
draw is therefore the same whatever the batch, the method, or what was computed before.
"""

import dataclasses
import functools
import math
import operator
import pathlib
import zlib

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from gymnasium.envs.toy_text.frozen_lake import generate_random_map

import jaxhom
from bench.road_graph import road_graph
from bench.settings import Setting
from jaxhom import MDP, Demonstrations, Plan
from jaxhom.interop import from_gymnasium
from jaxhom.models.mdp import absorbing_states

_FROZEN = 0.85  # of the cells of a lake
_TRACKS = pathlib.Path(__file__).resolve().parent / "tracks"


@dataclasses.dataclass(frozen=True, eq=False)
class Domain:
    """What the draws of a setting share.

    Attributes:
      mdp: the model with its K features. bare: the same without features, whose shape does not change with K, so that
        what needs no features is compiled once per domain.
      coordinates: [S, 2].
      weights: [K], true reward weights; None where each draw has its own.
      true_features: [S, A, K'] that the reward is made of where they are not the learner's; None where they are.
      labels: [S, A, L], what else is known of states and actions; None for nothing.
      terminal: bool [S], and off_road: [S, A]; None on grids.
    """

    mdp: MDP
    bare: MDP
    coordinates: jax.Array
    weights: jax.Array | None = None
    true_features: jax.Array | None = None
    labels: np.ndarray | None = None
    terminal: jax.Array | None = None
    off_road: jax.Array | None = None


@dataclasses.dataclass(frozen=True, eq=False)
class Problem:
    """B draws of a setting.

    Attributes:
      seed: that the draws come from.
      weights: [B, K'], of the true reward. reward: [B, S, A]. expert: plans with a leading axis [B].
      demonstrations: B of them; see `_shown`.
      models: what the learner of each draw knows of the model; the true one unless the setting says otherwise.
      trial_keys: [B], for sampled trials.
      found: results that several methods build on.
    """

    setting: Setting
    domain: Domain
    draws: tuple[int, ...]
    seed: int
    weights: jax.Array
    reward: jax.Array
    expert: Plan
    demonstrations: list[Demonstrations]
    models: list[MDP]
    trial_keys: jax.Array
    found: dict = dataclasses.field(default_factory=dict)

    def once(self, function):
        """`function(problem)`, computed the first time that it is asked for."""
        if function not in self.found:
            self.found[function] = function(self)
        return self.found[function]


def draw_problem(setting: Setting, draws: tuple[int, ...], seed: int) -> Problem:
    """The given draws of a setting."""
    domain = build_domain(setting.domain, setting.regions)
    key = jax.random.fold_in(jax.random.key(seed), zlib.crc32(setting.source.encode()))
    keys = jax.vmap(lambda draw: jax.random.split(jax.random.fold_in(key, draw), 4))(jnp.array(draws))
    weight_keys, sample_keys, trial_keys, model_keys = keys.T
    weights, reward = _rewards(domain, weight_keys)
    expert = _plans(domain, reward)
    samples = _sample(sample_keys, domain.bare, expert.policy, setting.pool, setting.length)
    return Problem(
        setting=setting,
        domain=domain,
        draws=tuple(draws),
        seed=seed,
        weights=weights,
        reward=reward,
        expert=expert,
        demonstrations=_shown(setting, domain, samples),
        models=[_known_model(setting, domain, key) for key in model_keys],
        trial_keys=trial_keys,
    )


@functools.lru_cache(maxsize=2)
def build_domain(name: str, regions: int) -> Domain:
    """A domain by the names of `settings`."""
    if name.startswith("grid"):
        world = jaxhom.gridworld(int(name[4:]), num_regions=regions)
        return Domain(world.mdp, _without_features(world.mdp), world.coordinates)
    if name.startswith("wrong"):
        return _misled_grid(int(name.removeprefix("wrong")), regions)
    if name.startswith("lake"):
        return _lake(int(name[4:]))
    if name.startswith("tiles"):
        return _tiled_lake(int(name.removeprefix("tiles")))
    if name == "road":
        return _road()
    letter = name.removeprefix("track_")
    shipped = _TRACKS / f"{letter}.track"
    track = jaxhom.racetrack(shipped if shipped.exists() else letter)
    parts = {"weights": track.weights, "terminal": track.terminal, "off_road": track.off_road}
    return Domain(track.mdp, _without_features(track.mdp), track.coordinates, **parts)


def _lake(size: int) -> Domain:
    """A slippery lake by Gymnasium's generator of maps; reward is time in the goal, which absorbs as the holes do."""
    board = generate_random_map(size=size, p=_FROZEN, seed=size)
    environment = gymnasium.make("FrozenLake-v1", desc=board)
    found = from_gymnasium(environment, discount=0.99)
    goal = np.array([cell == "G" for row in board for cell in row], float)
    mdp = found.mdp.replace(features=goal[:, None])
    coordinates = np.stack(np.divmod(np.arange(size**2), size), axis=1)
    return Domain(mdp, _without_features(mdp), jnp.asarray(coordinates), weights=jnp.ones(1))


def _tiled_lake(size: int) -> Domain:
    """The lake with features of its goal, of its holes, and of the ice in each tile of 2 x 2 cells."""
    lake = _lake(size)
    row, column = np.asarray(lake.coordinates).T
    goal = np.asarray(lake.mdp.features)[:, 0, 0] > 0
    hole = np.asarray(absorbing_states(lake.mdp)) & ~goal
    tile = (row // 2) * -(-size // 2) + column // 2
    ice = (tile[:, None] == np.arange(tile.max() + 1)) & ~(goal | hole)[:, None]
    features = np.column_stack([goal, hole, ice[:, ice.any(axis=0)]]).astype(float)
    weights = jnp.asarray(np.arange(features.shape[1]) == 0, lake.mdp.dtype)
    return dataclasses.replace(lake, mdp=lake.mdp.replace(features=features), weights=weights)


def _misled_grid(size: int, regions: int) -> Domain:
    """A gridworld whose learner sees regions of four times the side, shifted by a cell, of which it rewards nothing."""
    world = jaxhom.gridworld(size, num_regions=regions)
    side = 4 * (size // math.isqrt(regions))
    row, column = (np.asarray(world.coordinates).astype(int).T + 1) // side
    region = row * (column.max() + 1) + column
    features = (region[:, None] == np.arange(region.max() + 1)).astype(float)
    mdp = world.mdp.replace(features=features)
    return Domain(mdp, _without_features(mdp), world.coordinates, true_features=world.mdp.features)


def _road(destination: int = 0) -> Domain:
    """A road network with a destination that absorbs, in which time is rewarded: few links are better than short ones.

    The label of an exit is by how much the way to the destination is longer after it than before, in widths of a block
    and at most 1: what a map knows.
    """
    road = road_graph(18)
    mdp, end, length = road.mdp, int(road.destinations[destination]), np.asarray(road.mdp.features)[:, 0, 0]
    leads_to, allowed = np.asarray(mdp.next_state)[..., 0], np.asarray(mdp.allowed)
    steps = scipy.sparse.coo_array((length[leads_to][allowed], (np.nonzero(allowed)[0], leads_to[allowed])))
    way = scipy.sparse.csgraph.dijkstra(steps.tocsr().T, indices=end)  # from the end of each link
    detour = np.where(allowed, np.minimum(length[leads_to] + way[leads_to] - way[:, None], 1.0), 0.0)
    leads_to, allowed = leads_to.copy(), allowed.copy()
    leads_to[end], allowed[end], detour[end] = end, True, 0.0
    goal = (np.arange(len(leads_to)) == end).astype(float)
    chance = allowed[..., None].astype(float)
    mdp = MDP.from_successors(leads_to[..., None], chance, discount=0.99, allowed=allowed, features=goal[:, None])
    parts = {"weights": jnp.ones(1), "labels": detour[..., None]}
    return Domain(mdp, _without_features(mdp), jnp.asarray(road.coordinates), **parts)


def _without_features(mdp: MDP) -> MDP:
    return mdp.replace(features=mdp.features[..., :0])


def _rewards(domain: Domain, keys) -> tuple[jax.Array, jax.Array]:
    """True weights [B, K'] and rewards [B, S, A]."""
    if domain.weights is not None:
        shared = domain.weights, domain.mdp.features @ domain.weights
        return tuple(jnp.broadcast_to(one, (len(keys), *one.shape)) for one in shared)
    features = domain.mdp.features if domain.true_features is None else domain.true_features
    weights = jax.vmap(lambda key: jaxhom.sample_weights(key, features.shape[-1]))(keys).astype(domain.mdp.dtype)
    return weights, jnp.einsum("sak,bk->bsa", features, weights)


def _plans(domain: Domain, reward: jax.Array) -> Plan:
    """The expert's plans; one for all draws where they share the reward."""
    if domain.weights is None:
        return jaxhom.optimal_policy(domain.bare, reward)
    plan = jaxhom.optimal_policy(domain.bare, reward[0])
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (len(reward), *leaf.shape)), plan)


@functools.partial(jax.jit, static_argnums=(3, 4))
def _sample(keys, mdp, policies, num_trajectories, length) -> Demonstrations:
    """Trajectories [B, M, H], one key and policy per lane."""
    sample = jax.vmap(jaxhom.sample_demonstrations, in_axes=(0, None, 0, None, None))
    return sample(keys, mdp, policies, num_trajectories, length)


def _shown(setting: Setting, domain: Domain, samples: Demonstrations) -> list[Demonstrations]:
    """The trajectories that the learner of each draw sees, all of one shape.

    On tracks without the steps from the finish line, which put the car back: the action there is no decision of the
    expert's.
    """
    seen = jax.tree.map(lambda leaf: leaf[:, : setting.demonstrations], samples)
    if domain.terminal is not None:
        seen = seen.replace(mask=seen.mask & ~domain.terminal[seen.states])
    return [jax.tree.map(operator.itemgetter(lane), seen) for lane in range(len(seen.mask))]


def _known_model(setting: Setting, domain: Domain, key) -> MDP:
    """The true model, or frequencies of `samples` transitions per state and action."""
    bare = domain.bare
    if not setting.samples:
        return bare
    probability = np.asarray(bare.probability, float)
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    estimated = rng.multinomial(setting.samples, probability / probability.sum(-1, keepdims=True)) / setting.samples
    return MDP.from_successors(bare.next_state, estimated, discount=float(bare.discount), initial=bare.initial)
