"""The main job: the paper's two domains, from a few demonstrations to certified policies, in one table.

For each domain and number of demonstrations, several independent sets of demonstrations are drawn (with a reward of
their own on the gridworld) and every method's policy is evaluated exactly under the true reward, in trials of the
demonstrations' length (Boularias and Chaib-draa 2010, section VI). What is certified beside the numbers:

* `loss <=`: an upper bound, per step, on how much discounted value the policy loses against any other under the
  true reward: the planner's upper bound on the optimal value minus the policy's own, from a linear solve.
* `LPAL gap`: margin_bound - margin of the LPAL solution, per step: no policy has a margin larger by more.

Whatever LPAL reaches is to be held against what it reaches when it is fed with zeros: on the racetrack nearly all.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from jaxhom.apprenticeship.lpal import lpal
from jaxhom.cli.methods import METHODS, run_method, wants_progress
from jaxhom.cli.options import Parser, count, positive
from jaxhom.cli.pictures import load_plotting
from jaxhom.cli.results import save_figure
from jaxhom.cli.sources import Problem, racetrack_problem
from jaxhom.cli.statuses import remarks, warn
from jaxhom.cli.tables import GrowingTable
from jaxhom.domains.gridworld import Gridworld, gridworld, sample_weights
from jaxhom.domains.racetrack import Racetrack
from jaxhom.models.demonstrations import Demonstrations, sample_demonstrations
from jaxhom.planning.occupancy import feature_expectations, policy_value
from jaxhom.planning.optimal import Plan, optimal_policy
from jaxhom.planning.trials import evaluate_exactly
from jaxhom.status import at_most

EXPERT = "expert"
APPRENTICE = "soft-local-homomorphism"  # whose policies LPAL starts from
GENERALIZATIONS: dict[str, dict[str, Any]] = {
    APPRENTICE: {},
    "nearest-neighbors": {"metric": "hops"},
    "maximum-entropy": {},
}
"""Which methods the table compares, with which options."""
CONTROL = "LPAL, fed with zeros"  # what features say without any demonstration
_GRID_TRIAL = 50  # steps, as in the paper


@dataclasses.dataclass(frozen=True)
class Row:
    """One method's figures on one domain: means over the sets, of gaps the largest; `nan` where one does not apply."""

    method: str
    reward_per_step: float
    relative: float
    steps: float
    off_roads: float
    loss_bound: float
    lpal_gap: float

    def cells(self) -> tuple[str, ...]:
        """The row of the printed table."""

        def show(value: float, pattern: str | None = None) -> str:
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
    """One block of the table: a problem, and of its B sets the true rewards [B, S, A] and the expert's plans."""

    problem: Problem
    domain: Any
    reward: jax.Array
    expert: Plan
    demonstrations: list[Demonstrations]


class _Policies(NamedTuple):
    """One method's policies [B, S, A], LPAL's certified gaps [B] (NaN elsewhere), and what they were read from."""

    name: str
    policy: jax.Array
    gap: jax.Array
    answers: list[Any]


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


def run(options: argparse.Namespace) -> None:
    """Runs the job and prints its table, a row as soon as it is known; saves a picture where matplotlib is installed.

    Args:
      options: of the command line. `grid` 0 leaves the gridworld out, `sets` is the number of independent sets of
        demonstrations over which figures are averaged, and an empty `picture` asks for none.

    Raises:
      ValueError: if there is no such gridworld or racetrack.
    """
    grid_key, track_key, picture_key = jax.random.split(jax.random.key(options.seed), 3)
    titles = _titles(options)
    drawn: dict[type, tuple[_Setting, dict[str, jax.Array]]] = {}
    told: list[str] = []
    table = GrowingTable(HEADER, max(map(len, [*titles, *(f"  {name}" for name in _names())])))
    total = len(titles) * options.sets * (len(GENERALIZATIONS) + 1)
    with tqdm(total=total, unit="policy", leave=False, disable=not wants_progress(options)) as bar:
        for title, setting in zip(titles, _settings(grid_key, track_key, options), strict=True):
            bar.set_description(title)
            _say(table.rule() if drawn else table.header())
            _say(table.line((title,) + ("",) * (len(HEADER) - 1)))
            measure = _measurer(setting)
            policies = {}
            for found in _learn(setting, bar.update):
                _say(table.line(measure(found).cells()))
                policies[found.name] = found.policy[0]
                told += remarks(f"{title}, {found.name}", *found.answers)
            drawn.setdefault(type(setting.domain), (setting, policies))
    track_trial = drawn[Racetrack][0].problem.trial
    print(
        f"\nMeans over {options.sets} sets of demonstrations; exact evaluation in trials of the demonstrations' "
        "length\n"
        f"(gridworld {_GRID_TRIAL}) or {track_trial} steps (racetrack). `loss <=` and `LPAL gap`, the largest, are per "
        "step."
    )
    warn(told)
    if options.picture and len(drawn) == 2:
        _draw(picture_key, options.picture, drawn[Gridworld], drawn[Racetrack])


def _say(line: str) -> None:
    """Prints a line above the progress bar, at once even into a pipe."""
    tqdm.write(line, file=sys.stdout)
    sys.stdout.flush()


def _titles(options: argparse.Namespace) -> list[str]:
    """Of the blocks, in the order of `_settings`."""
    grid = [f"gridworld {options.grid}x{options.grid}, {options.regions} regions, 10 demonstrations"]
    track = [f"racetrack ({options.track}), {number} demonstrations" for number in options.demonstrations]
    return grid * bool(options.grid) + track


def _names() -> list[str]:
    """Of the rows of a block."""
    return [EXPERT, *map(_name, GENERALIZATIONS), f"{_name(APPRENTICE)} + LPAL", CONTROL]


def _name(method: str) -> str:
    """A method as it is called in the table: with its options."""
    options = ", ".join(GENERALIZATIONS[method].values())
    return METHODS[method].title + (f" ({options})" if options else "")


def _settings(grid_key: jax.Array, track_key: jax.Array, options: argparse.Namespace) -> Iterator[_Setting]:
    """The blocks of the table, one by one."""
    if options.grid:
        yield _gridworld_setting(grid_key, options.grid, options.regions, options.sets)
    problem = racetrack_problem(options.track)
    plan = problem.plan
    reward = jnp.broadcast_to(jnp.asarray(problem.reward), (options.sets, *plan.policy.shape))
    expert = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (options.sets, *leaf.shape)), plan)
    for number in options.demonstrations:
        keys = jax.random.split(jax.random.fold_in(track_key, number), options.sets)
        samples = [sample_demonstrations(k, problem.mdp, plan.policy, number, problem.demonstration) for k in keys]
        yield _Setting(problem, problem.domain, reward, expert, samples)


def _gridworld_setting(key: jax.Array, size: int, regions: int, sets: int) -> _Setting:
    """The gridworld, with a reward of its own for every set."""
    world = gridworld(size, num_regions=regions)
    draw_key, sample_key = jax.random.split(key)
    weights = jnp.stack([sample_weights(k, regions) for k in jax.random.split(draw_key, sets)])
    reward = jnp.einsum("sak,bk->bsa", world.mdp.features, weights.astype(world.mdp.dtype))
    expert = optimal_policy(world.mdp, reward)
    keys = jax.random.split(sample_key, sets)
    samples = [
        sample_demonstrations(k, world.mdp, policy, 10, _GRID_TRIAL)
        for k, policy in zip(keys, expert.policy, strict=True)
    ]
    return _Setting(Problem("gridworld", world.mdp, trial=_GRID_TRIAL), world, reward, expert, samples)


def _learn(setting: _Setting, progress: Callable[[int], object]) -> Iterator[_Policies]:
    """What each method makes of the demonstrations."""
    problem, samples = setting.problem, setting.demonstrations
    no_gap = jnp.full(len(samples), jnp.nan)
    yield _Policies(EXPERT, setting.expert.policy, no_gap, [setting.expert])
    for method, options in GENERALIZATIONS.items():
        found = []
        for demonstrations in samples:
            found.append(run_method(method, problem, demonstrations, **options)[0])
            progress(1)
        policies = jnp.stack([general.policy for general in found])
        yield _Policies(_name(method), policies, no_gap, found)
        if method == APPRENTICE:
            yield _apprentices(setting, _name(method), policies)
            progress(len(samples))
    yield _fed_with_zeros(setting)


def _apprentices(setting: _Setting, name: str, policies: jax.Array) -> _Policies:
    """LPAL's policies, started from given ones."""
    mdp = setting.problem.mdp
    solution = lpal(mdp, feature_expectations(mdp, policies), initial_policy=policies)
    gap = jnp.maximum(solution.margin_bound - solution.margin, 0.0)
    return _Policies(f"{name} + LPAL", solution.policy, gap * (1.0 - mdp.discount), [solution])


def _fed_with_zeros(setting: _Setting) -> _Policies:
    """The control of LPAL: no demonstration, and so one policy for all sets."""
    mdp, sets = setting.problem.mdp, len(setting.demonstrations)
    solution = lpal(mdp, jnp.zeros((1, mdp.num_features)))
    gap = jnp.maximum(solution.margin_bound - solution.margin, 0.0) * (1.0 - mdp.discount)
    policy = jnp.broadcast_to(solution.policy, (sets, *solution.policy.shape[1:]))
    return _Policies(CONTROL, policy, jnp.broadcast_to(gap, sets), [solution])


def _measurer(setting: _Setting) -> Callable[[_Policies], Row]:
    """What makes the rows of a block: means over the sets of what a method's policies reach, and its largest gap."""
    problem, mdp = setting.problem, setting.problem.mdp
    best = setting.expert.upper_bound(mdp) @ mdp.initial
    endings = {"terminal": problem.terminal, "events": problem.events}

    def evaluate(policy):
        return evaluate_exactly(mdp, policy, setting.reward, problem.trial, **endings)

    expert_reward = evaluate(setting.expert.policy).reward_per_step

    def measure(found: _Policies) -> Row:
        result = evaluate(found.policy)
        loss = best - policy_value(mdp, found.policy, setting.reward) @ mdp.initial
        return Row(
            method=f"  {found.name}",
            reward_per_step=float(result.reward_per_step.mean()),
            relative=float((result.reward_per_step / expert_reward).mean()),
            steps=float(result.steps.mean()) if problem.terminal is not None else np.nan,
            off_roads=float(result.events["off_road"].mean()) if problem.events else np.nan,
            loss_bound=float((loss * (1.0 - mdp.discount)).mean()),
            lpal_gap=float(found.gap.max()),
        )

    return measure


def _draw(key: jax.Array, path: str, grid: tuple[_Setting, dict], track: tuple[_Setting, dict]) -> None:
    """Saves the picture of the first block of each domain."""
    try:
        plotting = load_plotting()
    except ImportError as error:
        print(f"No picture: {error}")
        return
    (world, world_policies), (road, road_policies) = grid, track
    shown = (EXPERT, _name("nearest-neighbors"), _name(APPRENTICE))
    figure = plotting.learned_policy_figure(
        world.domain,
        world.reward[0],
        world.demonstrations[0],
        world_policies[_name(APPRENTICE)],
        road.domain,
        road.demonstrations[0],
        {name: road_policies[name] for name in shown},
        key=key,
        horizon=road.problem.trial,
    )
    save_figure(path, figure)
    print(f"Picture of the learned policies: {path}")
