"""The main job: the paper's two domains, from a few demonstrations to certified policies, in one table.

For each domain and number of demonstrations, several independent sets of demonstrations are drawn (with a reward of
their own on the gridworld) and every method's policy is evaluated exactly under the true reward, in trials of the
demonstrations' length (Boularias and Chaib-draa 2010, section VI). What is certified beside the numbers:

* `loss <=`: an upper bound, per step, on how much discounted value the policy loses against any other under the
  true reward: the planner's upper bound on the optimal value minus the policy's own, from a linear solve.
* `LPAL gap`: margin_bound - margin of the LPAL solution, per step: no policy has a margin larger by more.
"""

import dataclasses
import sys
from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from jaxhom.apprenticeship.lpal import lpal
from jaxhom.cli.methods import wants_progress
from jaxhom.cli.options import Parser, count, positive
from jaxhom.cli.pictures import load_plotting
from jaxhom.cli.results import save_figure
from jaxhom.cli.tables import GrowingTable
from jaxhom.domains.gridworld import Gridworld, gridworld, sample_weights
from jaxhom.domains.racetrack import Racetrack, racetrack
from jaxhom.generalization.algorithm1 import soft_local_homomorphism
from jaxhom.generalization.neighbors import nearest_neighbors
from jaxhom.generalization.uniform import uniform_elsewhere
from jaxhom.models.demonstrations import Demonstrations, sample_demonstrations
from jaxhom.models.mdp import MDP
from jaxhom.planning.occupancy import feature_expectations, policy_value
from jaxhom.planning.optimal import Plan, optimal_policy
from jaxhom.planning.trials import evaluate_exactly
from jaxhom.status import at_most

GENERALIZATIONS: dict[str, Callable] = {
    "soft local homomorphism": soft_local_homomorphism,
    "k-NN (hops)": nearest_neighbors,
    "maximum entropy": uniform_elsewhere,
}
EXPERT = "expert"
METHODS = (EXPERT, *GENERALIZATIONS, "soft local homomorphism + LPAL")
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

        def show(value, pattern=None):
            return "" if np.isnan(value) else format(value, pattern) if pattern else at_most(value)

        return (
            self.method,
            show(self.reward_per_step, ".4g"),
            show(100 * self.relative, ".1f"),
            show(self.steps, ".1f"),
            show(self.off_roads, ".3f"),
            show(self.loss_bound),
            show(self.lpal_gap),
        )


HEADER = ("method", "reward/step", "% of expert", "steps", "off-roads/step", "loss <=", "LPAL gap")


@dataclasses.dataclass(frozen=True)
class _Setting:
    """One block of the table: a model, the true rewards [B, S, A] and the expert's plans of its B sets."""

    mdp: MDP
    reward: jax.Array
    expert: Plan
    demonstrations: list[Demonstrations]
    trial: int
    terminal: jax.Array | None
    off_road: jax.Array | None


def add_options(parser: Parser) -> None:
    """The options without a command."""
    parser.set_defaults(run=run)
    parser.add_argument("--grid", type=count, default=16, help="rows of the gridworld; 0 for none (default 16)")
    parser.add_argument("--regions", type=count, default=64, help="regions of the gridworld (default 64)")
    parser.add_argument("--track", default="a", help="racetrack: a, b or the file of a map (default a)")
    parser.add_argument(
        "--demonstrations", type=positive, nargs="+", default=[2, 5, 10], help="on the racetrack (default 2 5 10)"
    )
    parser.add_argument("--sets", type=positive, default=20, help="sets of demonstrations (default 20)")
    parser.add_argument("--seed", type=count, default=0, help="of the random key (default 0)")
    parser.add_argument(
        "--picture", default="jaxhom_policies.png", help="file of the picture; '' for none (default %(default)s)"
    )
    parser.add_argument("--progress", action="store_true", help="show progress also where stderr is no terminal")


def run(options) -> None:
    """Runs the job and prints its table, a row as soon as it is known; saves a picture where matplotlib is installed.

    Args:
      options: of the command line. `grid` 0 leaves the gridworld out, `sets` is the number of independent sets of
        demonstrations over which figures are averaged, and an empty `picture` asks for none.

    Raises:
      ValueError: if there is no such gridworld or racetrack.
    """
    grid_key, track_key, picture_key = jax.random.split(jax.random.key(options.seed), 3)
    settings = _settings(grid_key, track_key, options)
    titles = _titles(options)
    table = GrowingTable(HEADER, max(map(len, [*titles, *(f"  {name}" for name in METHODS)])))
    drawn: dict[type, tuple] = {}
    total = len(titles) * options.sets * (len(GENERALIZATIONS) + 1)
    with tqdm(total=total, unit="policy", leave=False, disable=not wants_progress(options)) as bar:
        for title, (setting, domain) in zip(titles, settings, strict=True):
            bar.set_description(title)
            _say(table.rule() if drawn else table.header())
            _say(table.line((title,) + ("",) * (len(HEADER) - 1)))
            measure = _measurer(setting)
            policies = {}
            for name, policy, gap in _learn(setting, bar.update):
                _say(table.line(measure(name, policy, gap).cells()))
                policies[name] = policy[0]
            drawn.setdefault(type(domain), (domain, setting, policies))
    print(
        f"\nMeans over {options.sets} sets of demonstrations; exact evaluation in trials of the demonstrations' length"
    )
    print(f"(gridworld {_GRID_TRIAL}) or {_TRACK_TRIAL} steps (racetrack). `loss <=` and `LPAL gap` are per step.")
    if options.picture and len(drawn) == 2:
        _draw(picture_key, options.picture, drawn)


def _say(line: str) -> None:
    """Prints a line above the progress bar, at once even into a pipe."""
    tqdm.write(line, file=sys.stdout)
    sys.stdout.flush()


def _titles(options) -> list[str]:
    """Of the blocks, in the order of `_settings`."""
    grid = [f"gridworld {options.grid}x{options.grid}, {options.regions} regions, 10 demonstrations"]
    track = [f"racetrack ({options.track}), {number} demonstrations" for number in options.demonstrations]
    return grid * bool(options.grid) + track


def _settings(grid_key, track_key, options) -> Iterator[tuple[_Setting, Gridworld | Racetrack]]:
    """The blocks of the table, one by one."""
    size, regions, sets = options.grid, options.regions, options.sets
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
        yield _Setting(world.mdp, reward, expert, samples, _GRID_TRIAL, None, None), world
    track = racetrack(options.track)
    plan = optimal_policy(track.mdp, track.mdp.features @ track.weights)
    reward = jnp.broadcast_to(track.mdp.features @ track.weights, (sets, *plan.policy.shape))
    expert = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (sets, *leaf.shape)), plan)
    for number in options.demonstrations:
        keys = jax.random.split(jax.random.fold_in(track_key, number), sets)
        samples = [sample_demonstrations(k, track.mdp, plan.policy, number, _TRACK_DEMONSTRATION) for k in keys]
        yield _Setting(track.mdp, reward, expert, samples, _TRACK_TRIAL, track.terminal, track.off_road), track


def _learn(setting: _Setting, progress: Callable[[int], object]) -> Iterator[tuple[str, jax.Array, jax.Array]]:
    """Each method's name, its policies [B, S, A] and, for LPAL, the certified gaps [B] (NaN elsewhere)."""
    mdp, samples = setting.mdp, setting.demonstrations
    no_gap = jnp.full(len(samples), jnp.nan)
    yield EXPERT, setting.expert.policy, no_gap
    for name, generalize in GENERALIZATIONS.items():
        policies = []
        for demonstrations in samples:
            policies.append(generalize(mdp, demonstrations).policy)
            progress(1)
        policies = jnp.stack(policies)
        yield name, policies, no_gap
        if generalize is soft_local_homomorphism:
            yield f"{name} + LPAL", *_apprentice(mdp, feature_expectations(mdp, policies), policies)
            progress(len(samples))


def _apprentice(mdp: MDP, expectations, initial_policy) -> tuple[jax.Array, jax.Array]:
    """LPAL's policies and its certified gaps per step."""
    solution = lpal(mdp, expectations, initial_policy=initial_policy)
    gap = jnp.maximum(solution.margin_bound - solution.margin, 0.0)
    return solution.policy, gap * (1.0 - mdp.discount)


def _measurer(setting: _Setting) -> Callable[[str, jax.Array, jax.Array], Row]:
    """What makes the rows of a block: means over the sets of a method's policies and gaps."""
    mdp = setting.mdp
    best = setting.expert.upper_bound(mdp) @ mdp.initial
    events = {} if setting.off_road is None else {"off_road": setting.off_road}

    def evaluate(policy):
        return evaluate_exactly(mdp, policy, setting.reward, setting.trial, terminal=setting.terminal, events=events)

    expert_reward = evaluate(setting.expert.policy).reward_per_step

    def measure(name: str, policy: jax.Array, gap: jax.Array) -> Row:
        result = evaluate(policy)
        loss = best - policy_value(mdp, policy, setting.reward) @ mdp.initial
        return Row(
            method=f"  {name}",
            reward_per_step=float(result.reward_per_step.mean()),
            relative=float((result.reward_per_step / expert_reward).mean()),
            steps=float(result.steps.mean()) if setting.terminal is not None else np.nan,
            off_roads=float(result.events["off_road"].mean()) if events else np.nan,
            loss_bound=float((loss * (1.0 - mdp.discount)).mean()),
            lpal_gap=float(gap.max()),
        )

    return measure


def _draw(key, path: str, policies: dict) -> None:
    """Saves the picture of the first block of each domain."""
    try:
        plotting = load_plotting()
    except ImportError as error:
        print(f"No picture: {error}")
        return
    world, grid_setting, grid_policies = policies[Gridworld]
    track, track_setting, track_policies = policies[Racetrack]
    shown = ("expert", "k-NN (hops)", "soft local homomorphism")
    figure = plotting.learned_policy_figure(
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
    save_figure(path, figure)
    print(f"Picture of the learned policies: {path}")
