"""What the commands work on: a model with what is known of it, trajectories and policies, from wherever they come.

Whatever is wrong with a source is one `ValueError` that names it (and line, column, array or row), before anything
is computed.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import os
import sys
import warnings
from collections.abc import Hashable
from typing import Any

import jax
import numpy as np

from jaxhom import checks
from jaxhom.cli.options import environment_options
from jaxhom.cli.table_files import open_table
from jaxhom.domains.racetrack import Racetrack, racetrack
from jaxhom.domains.tile_map import TileMap
from jaxhom.domains.track_maps import SHIPPED
from jaxhom.interop.archives import FileError
from jaxhom.interop.environment_makers import make_environment
from jaxhom.interop.environment_maps import tile_map
from jaxhom.interop.environment_tables import require_steps_of_table
from jaxhom.interop.environments import from_gymnasium
from jaxhom.interop.files import load_policy
from jaxhom.interop.model_files import DISCOUNT, read_model
from jaxhom.interop.trajectory_sources import demonstrations_from
from jaxhom.models.demonstrations import Demonstrations, sample_demonstrations
from jaxhom.models.impossible_steps import ImpossibleStepsWarning
from jaxhom.models.inputs import check_policy
from jaxhom.models.mdp import MDP, absorbing_states
from jaxhom.models.names import look_up
from jaxhom.planning.optimal import Plan, optimal_policy
from jaxhom.similarity.table import SimilarityTable

_TRACK_STEPS = 20  # of a demonstration on a racetrack, and of a trial below, as in the paper
_TRACK_TRIAL = 30
_STEPS = 100  # of either, where the source has no limit


@dataclasses.dataclass(frozen=True, eq=False)
class Problem:
    """A model and what else its source knows.

    Attributes:
      name: the source, for messages and tables.
      mdp: the model.
      trial: steps of a trial, unless told otherwise.
      demonstration: steps of a sampled demonstration, unless told otherwise.
      reward: [S, A], or None where it is not known.
      terminal: bool [S], states in which an episode ends; None if there are none.
      off_road: [S, A], on racetracks: the probability of leaving the road.
      coordinates: [S, D], or None.
      domain: what pictures are drawn on; None for models without a map.
    """

    name: str
    mdp: MDP
    trial: int = _STEPS
    demonstration: int = _STEPS
    reward: jax.Array | None = None
    terminal: np.ndarray | None = None
    off_road: jax.Array | None = None
    coordinates: np.ndarray | None = None
    domain: Racetrack | TileMap | None = None

    @functools.cached_property
    def plan(self) -> Plan:
        """An optimal policy.

        Raises:
          ValueError: if no reward is known.
        """
        if self.reward is None:
            raise ValueError(f"{self.name} has no reward (array 'reward')")
        return optimal_policy(self.mdp, self.reward)

    def similarity(
        self, distance: int = 1, *, anchored: bool = True, file: str | None = None, **compared: Any
    ) -> SimilarityTable:
        """The table of the model's local models, one for all sets of demonstrations: no pair is solved again.

        What else is `compared`, labels and the relation, is the same in all calls; and so is the `file` that has it.
        """
        key = distance, anchored
        if key not in self._tables:
            self._tables[key] = open_table(file, self.mdp, distance=distance, anchored=anchored, **compared)
        return self._tables[key]

    @functools.cached_property
    def _tables(self) -> dict[tuple[int, bool], SimilarityTable]:
        return {}

    def labels(self, source: str) -> np.ndarray:
        """The labels that a user means: the model's `features` or `reward`, or a file.

        Raises:
          ValueError: if the model has none of these; naming the file if it cannot be read.
        """
        if source == "features":
            if not self.mdp.num_features:
                raise ValueError(f"--labels features: {self.name} has none")
            return np.asarray(self.mdp.features)
        if source == "reward":
            if self.reward is None:
                raise ValueError(f"--labels reward: {self.name} has none (array 'reward')")
            return np.asarray(self.reward)
        try:
            array = np.load(source, allow_pickle=False)
        except OSError as error:
            raise FileError(f"--labels {source}: not features or reward, and no .npy file: {error.strerror}") from None
        except (ValueError, EOFError):
            raise FileError(f"--labels {source}: not features or reward, and no .npy file of numbers") from None
        if not isinstance(array, np.ndarray):
            raise FileError(f"--labels {source}: must be an .npy file of a single array")
        return array

    @property
    def events(self) -> dict[str, Any]:
        return {} if self.off_road is None else {"off_road": self.off_road}

    def state_of(self, text: str) -> int:
        """The state that a user means: `12`, on maps `row,column`, on racetracks `row,column,down,right` with a speed.

        Of models whose states have names it is a name, tuples without parentheses, or else a number.

        Raises:
          ValueError: if there is no such state.
        """
        if self.mdp.state_names is not None:
            by_text: dict[Hashable, int] = {
                plain_text(name): number for number, name in enumerate(self.mdp.state_names)
            }
            if text in by_text or not text.isdigit():
                return look_up("state", by_text, text)
        try:
            numbers = [int(part) for part in text.split(",")]
        except ValueError:
            raise ValueError(f"state {text!r} must be a number, or numbers with commas between them") from None
        if len(numbers) == 1:
            if not 0 <= numbers[0] < self.mdp.num_states:
                raise ValueError(f"state {text} must lie in [0, {self.mdp.num_states})")
            return numbers[0]
        if isinstance(self.domain, Racetrack) and len(numbers) == 4:
            return self.domain.state_of(numbers[:2], numbers[2:])
        if self.domain is not None and len(numbers) == 2:
            return self.domain.state_of(numbers)
        raise ValueError(f"state {text!r}: {self.name} numbers its states from 0 to {self.mdp.num_states - 1}")


def plain_text(name: Hashable) -> str:
    """A name as people type it: tuples without parentheses and blanks."""
    return ",".join(map(str, name)) if isinstance(name, tuple) else str(name)


def load_problem(options: argparse.Namespace) -> Problem:
    """The model of `--env` or `--mdp`.

    Raises:
      ValueError: naming the source and what is wrong with it.
      ImportError: if an optional library is missing.
    """
    if options.discount is not None and not 0.0 < options.discount < 1.0:
        raise ValueError(f"--discount must lie strictly between 0 and 1, got {options.discount}")
    if options.env:
        return _environment(options)
    if options.end_state:
        raise ValueError("--end-state belongs to --env")
    path = options.mdp
    if path not in SHIPPED and not os.path.exists(path):
        raise FileError(f"{path}: no such file")
    if path in SHIPPED or path.lower().endswith((".track", ".txt")):
        return racetrack_problem(path, options.discount)
    return _file(path, options.discount)


def _environment(options: argparse.Namespace) -> Problem:
    name, *words = options.env
    arguments = environment_options(words)
    env = make_environment(name, **arguments)
    try:
        discount = DISCOUNT if options.discount is None else options.discount
        model = from_gymnasium(env, discount=discount, end_state=options.end_state)
        require_steps_of_table(env)
        domain, limit = tile_map(env, model.mdp), (env.spec and env.spec.max_episode_steps) or _STEPS
    except ValueError as error:
        raise ValueError(f"{name}: {str(error).replace('end_state=True', '--end-state')}") from None
    finally:
        env.close()
    return Problem(
        name=name + "".join(f" {word}" for word in words),
        mdp=model.mdp,
        trial=limit,
        demonstration=limit,
        reward=model.reward,
        terminal=np.asarray(model.terminal) if model.terminal.any() else None,
        coordinates=None if domain is None else domain.coordinates,
        domain=domain,
    )


def racetrack_problem(path: str, discount: float | None = None) -> Problem:
    """A racetrack: one that comes with the library, or the file of a map; 0.99 if no discount is given.

    Raises:
      FileError: naming the file and what is wrong with its map.
      OSError: if there is no such file.
    """
    try:
        track = racetrack(path, discount=DISCOUNT if discount is None else discount)
    except ValueError as error:
        raise FileError(f"{path}: {error}") from None
    return Problem(
        name=f"racetrack {path}",
        mdp=track.mdp,
        trial=_TRACK_TRIAL,
        demonstration=_TRACK_STEPS,
        reward=track.mdp.features @ track.weights,
        terminal=np.asarray(track.terminal),
        off_road=track.off_road,
        coordinates=np.asarray(track.coordinates),
        domain=track,
    )


def _file(path: str, discount: float | None) -> Problem:
    model = read_model(path, discount=discount)
    for remark in model.remarks:
        print(f"jaxhom: {path}: {remark}", file=sys.stderr)
    return Problem(
        name=path,
        mdp=model.mdp,
        reward=model.reward,
        terminal=model.terminal,
        coordinates=model.coordinates,
        domain=model.domain,
    )


def load_trajectories(problem: Problem, options: argparse.Namespace) -> tuple[Demonstrations, str]:
    """The demonstrations of `--demonstrations` or `--expert`, and where they come from, in words.

    Raises:
      ValueError: naming the file, and line and column or the array's entry; or if no expert is known.
    """
    if options.expert:
        return _sample(problem, options), f"sampled from the optimal policy (seed {options.seed})"
    if options.steps is not None:
        raise ValueError("--steps belongs to --expert")
    return load_demonstrations_of(problem, options.demonstrations, options.impossible, options.ambiguous)


def load_demonstrations_of(
    problem: Problem, path: str, impossible: str = "refuse", ambiguous: str = "hide"
) -> tuple[Demonstrations, str]:
    """Trajectories in the problem's model, from whatever `demonstrations_from` reads, and what was read, in words.

    Steps of probability 0 are refused, told on stderr ("warn") or let pass ("ignore"). What happens to steps that
    several actions could have been, in a file of states alone, `demonstrations_from_states` says.

    Raises:
      FileError: naming the file, and line and column or the array's entry.
      ImportError: if an optional library is missing.
    """
    demonstrations, report = demonstrations_from(path, mdp=problem.mdp, ambiguous=ambiguous)
    origin = "; ".join([path, *str(report).splitlines()])
    try:
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always", ImpossibleStepsWarning)
            demonstrations.validate(problem.mdp, impossible)
    except ValueError as error:
        raise FileError(f"{path}: {error}") from None
    for warning in told:
        print(f"jaxhom: warning: {path}: {warning.message}", file=sys.stderr)
    warnings.simplefilter("ignore", ImpossibleStepsWarning)  # it has been decided once
    return demonstrations, origin


def _sample(problem: Problem, options) -> Demonstrations:
    """Trajectories of the optimal policy, each up to the end of its episode."""
    if problem.reward is None:
        raise ValueError(f"--expert needs a reward, and {problem.name} has none (array 'reward'): use --demonstrations")
    steps = options.steps or problem.demonstration
    key = jax.random.key(options.seed)
    samples = sample_demonstrations(key, problem.mdp, problem.plan.policy, options.expert, steps)
    if problem.terminal is None:
        return samples
    if np.asarray(absorbing_states(problem.mdp))[problem.terminal].all():
        ends = checks.to_device(problem.terminal)
        return sample_demonstrations(key, problem.mdp, problem.plan.policy, options.expert, steps, terminal=ends)
    ended = np.cumsum(problem.terminal[np.asarray(samples.states)], axis=1) > 0
    lengths = (~ended).sum(axis=1)  # at least 1: no episode starts in a terminal state
    rows = zip(np.asarray(samples.states), np.asarray(samples.actions), lengths, strict=True)
    return Demonstrations.from_trajectories([(states[:n], actions[:n]) for states, actions, n in rows])


def load_policy_of(problem: Problem, path: str) -> np.ndarray:
    """A policy [S, A] of the problem's model.

    Raises:
      FileError: naming the file, if it holds no policy or that of another model.
    """
    policy = load_policy(path)
    shape = (problem.mdp.num_states, problem.mdp.num_actions)
    if policy.shape != shape:
        raise FileError(f"{path}: its policy is {policy.shape}, but {problem.name} has {shape} states and actions")
    try:
        return np.asarray(check_policy(problem.mdp, policy, batch=False))
    except ValueError as error:
        raise FileError(f"{path}: {error}") from None
