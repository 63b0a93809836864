"""The main job: the paper's two domains, from a few demonstrations to certified policies, in one table.

For each domain and number of demonstrations, several independent sets of demonstrations are drawn (with a reward of
their own on the gridworld) and every method's policy is evaluated exactly under the true reward, in trials of the
demonstrations' length (Boularias and Chaib-draa 2010, section VI). What is certified beside the numbers:

* `loss <=`: an upper bound, per step, on how much discounted value the policy loses against any other under the
  true reward: the planner's upper bound on the optimal value minus the policy's own, from a linear solve.
* `LPAL gap`: margin_bound - margin of the LPAL solution, per step: no policy has a margin larger by more.
"""

import dataclasses
from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from jaxhom.cli.tables import format_table
from jaxhom.demonstrations import Demonstrations, sample_demonstrations
from jaxhom.domains import Gridworld, Racetrack, gridworld, racetrack, sample_weights
from jaxhom.evaluation import evaluate_exactly
from jaxhom.generalization import maximum_entropy, nearest_neighbors, soft_local_homomorphism
from jaxhom.lpal import lpal
from jaxhom.mdp import MDP
from jaxhom.occupancy import feature_expectations, policy_value
from jaxhom.planning import Plan, optimal_policy

GENERALIZATIONS: dict[str, Callable] = {
    "soft local homomorphism": soft_local_homomorphism,
    "k-NN (hops)": nearest_neighbors,
    "maximum entropy": maximum_entropy,
}
_GRID_TRIAL = 50
_TRACK_DEMONSTRATION = 20
_TRACK_TRIAL = 30


@dataclasses.dataclass(frozen=True)
class Row:
    """Means over the sets of one method's figures on one domain; `nan` where a figure does not apply."""

    method: str
    reward_per_step: float
    relative: float
    steps: float
    off_roads: float
    loss_bound: float
    lpal_gap: float

    def cells(self) -> tuple[str, ...]:
        """The row of the printed table."""

        def show(value, pattern):
            return "" if np.isnan(value) else format(value, pattern)

        return (
            self.method,
            show(self.reward_per_step, ".4g"),
            show(100 * self.relative, ".1f"),
            show(self.steps, ".1f"),
            show(self.off_roads, ".3f"),
            show(self.loss_bound, ".1e"),
            show(self.lpal_gap, ".1e"),
        )


HEADER = ("method", "reward/step", "% of expert", "steps", "off-roads/step", "loss <=", "LPAL gap")


@dataclasses.dataclass(frozen=True)
class _Setting:
    """One block of the table: a model, the true rewards [B, S, A] and the expert's plans of its B sets."""

    title: str
    mdp: MDP
    reward: jax.Array
    expert: Plan
    demonstrations: list[Demonstrations]
    trial: int
    terminal: jax.Array | None
    off_road: jax.Array | None


def run(*, size: int, regions: int, demonstrations: list[int], sets: int, seed: int, picture: str | None) -> None:
    """Runs the job and prints its table; saves a picture where matplotlib is installed.

    Args:
      size: rows of the gridworld; 0 leaves the gridworld out.
      regions: its number of regions.
      demonstrations: how many demonstrations on racetrack (a), one block of the table each.
      sets: independent sets of demonstrations over which figures are averaged.
      seed: of the random key.
      picture: path of the picture; None for no picture.
    """
    key = jax.random.key(seed)
    grid_key, track_key, picture_key = jax.random.split(key, 3)
    rows, policies = [], {}
    total = sets * (len(GENERALIZATIONS) + 1) * (len(demonstrations) + 1)
    with tqdm(total=total, desc="main job", unit="policy", leave=False) as bar:
        for setting, domain in _settings(grid_key, track_key, size, regions, demonstrations, sets):
            bar.set_description(setting.title)
            rows.append((setting.title,) + ("",) * (len(HEADER) - 1))
            found = _learn(setting, bar.update)
            rows += [row.cells() for row in _evaluate(setting, found)] + [()]
            first = {name: policy[0] for name, (policy, _) in found.items()}
            policies.setdefault(type(domain), (domain, setting, first))
    print(format_table(HEADER, rows[:-1]))
    print(f"\nMeans over {sets} sets of demonstrations; exact evaluation in trials of the demonstrations' length")
    print(f"(gridworld {_GRID_TRIAL}) or {_TRACK_TRIAL} steps (racetrack). `loss <=` and `LPAL gap` are per step.")
    if picture and len(policies) == 2:
        _draw(picture_key, picture, policies)


def _settings(
    grid_key, track_key, size: int, regions: int, counts: list[int], sets: int
) -> Iterator[tuple[_Setting, Gridworld | Racetrack]]:
    """The blocks of the table, one by one."""
    if size:
        world = gridworld(size, num_regions=regions)
        draw_key, sample_key = jax.random.split(grid_key)
        weights = jax.vmap(lambda k: sample_weights(k, regions))(jax.random.split(draw_key, sets))
        reward = jnp.einsum("sak,bk->bsa", world.mdp.features, weights.astype(world.mdp.dtype))
        expert = optimal_policy(world.mdp, reward)
        keys = jax.random.split(sample_key, sets)
        samples = [
            sample_demonstrations(k, world.mdp, policy, 10, _GRID_TRIAL)
            for k, policy in zip(keys, expert.policy, strict=True)
        ]
        title = f"gridworld {size}x{size}, {regions} regions, 10 demonstrations"
        yield _Setting(title, world.mdp, reward, expert, samples, _GRID_TRIAL, None, None), world
    track = racetrack("a")
    plan = optimal_policy(track.mdp, track.mdp.features @ track.weights)
    reward = jnp.broadcast_to(track.mdp.features @ track.weights, (sets, *plan.policy.shape))
    expert = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (sets, *leaf.shape)), plan)
    for count in counts:
        keys = jax.random.split(jax.random.fold_in(track_key, count), sets)
        samples = [sample_demonstrations(k, track.mdp, plan.policy, count, _TRACK_DEMONSTRATION) for k in keys]
        title = f"racetrack (a), {count} demonstrations"
        yield (
            _Setting(title, track.mdp, reward, expert, samples, _TRACK_TRIAL, track.terminal, track.off_road),
            track,
        )


def _learn(setting: _Setting, progress: Callable[[int], object]) -> dict[str, tuple[jax.Array, jax.Array]]:
    """Each method's policies [B, S, A] and, for LPAL, the certified gaps [B] (NaN elsewhere)."""
    mdp, samples = setting.mdp, setting.demonstrations
    no_gap = jnp.full(len(samples), jnp.nan)
    found = {"expert": (setting.expert.policy, no_gap)}
    for name, generalize in GENERALIZATIONS.items():
        policies = []
        for demonstrations in samples:
            policies.append(generalize(mdp, demonstrations).policy)
            progress(1)
        found[name] = (jnp.stack(policies), no_gap)
        if generalize is soft_local_homomorphism:
            found[f"{name} + LPAL"] = _apprentice(mdp, *_expectations_of(mdp, found[name][0]))
            progress(len(samples))
    return found


def _expectations_of(mdp: MDP, policies: jax.Array) -> tuple[jax.Array, jax.Array]:
    return feature_expectations(mdp, policies), policies


def _apprentice(mdp: MDP, expectations, initial_policy) -> tuple[jax.Array, jax.Array]:
    """LPAL's policies and its certified gaps per step."""
    solution = lpal(mdp, expectations, initial_policy=initial_policy)
    gap = jnp.maximum(solution.margin_bound - solution.margin, 0.0)
    return solution.policy, gap * (1.0 - mdp.discount)


def _evaluate(setting: _Setting, found: dict[str, tuple[jax.Array, jax.Array]]) -> list[Row]:
    """Means over the sets."""
    mdp = setting.mdp
    best = setting.expert.upper_bound(mdp) @ mdp.initial
    events = {} if setting.off_road is None else {"off_road": setting.off_road}
    rows = []
    expert_reward = None
    for name, (policy, gap) in found.items():
        result = evaluate_exactly(mdp, policy, setting.reward, setting.trial, terminal=setting.terminal, events=events)
        loss = best - policy_value(mdp, policy, setting.reward) @ mdp.initial
        if expert_reward is None:
            expert_reward = result.reward_per_step
        rows.append(
            Row(
                method=f"  {name}",
                reward_per_step=float(result.reward_per_step.mean()),
                relative=float((result.reward_per_step / expert_reward).mean()),
                steps=float(result.steps.mean()) if setting.terminal is not None else np.nan,
                off_roads=float(result.events["off_road"].mean()) if events else np.nan,
                loss_bound=float((loss * (1.0 - mdp.discount)).mean()),
                lpal_gap=float(gap.max()),
            )
        )
    return rows


def _draw(key, path: str, policies: dict) -> None:
    """Saves the picture of the first block of each domain."""
    try:
        from jaxhom.plotting import learned_policy_figure
    except ImportError:
        print("No picture: matplotlib is not installed (pip install 'jaxhom[plot]').")
        return
    world, grid_setting, grid_policies = policies[Gridworld]
    track, track_setting, track_policies = policies[Racetrack]
    shown = ("expert", "k-NN (hops)", "soft local homomorphism")
    figure = learned_policy_figure(
        world,
        grid_setting.reward[0],
        grid_setting.demonstrations[0],
        grid_policies["soft local homomorphism"],
        track,
        track_setting.demonstrations[0],
        {name: track_policies[name] for name in shown},
        key=key,
        horizon=_TRACK_TRIAL,
    )
    figure.savefig(path, dpi=120)
    print(f"Picture of the learned policies: {path}")
