"""Runs settings x methods x draws by `jaxhom.sweeps`, which appends rows and goes on where it was stopped.

The draws of a setting go through the solvers in batches of one size, so that few shapes are compiled. A batch that
fails is tried draw by draw; a draw that fails is a row with its error, and the sweep goes on.
"""

import contextlib
import dataclasses
import threading
import weakref
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxhom
from bench.methods import Method
from bench.problems import Problem, draw_problem
from bench.rows import KEY, RowFile
from bench.settings import Setting
from jaxhom import Status
from jaxhom.sweeps import runs
from jaxhom.sweeps.cases import checked_jobs

BATCH = 50  # draws: all of a point of Figure 1, and half of a row of Table I
_NUM_TRIALS = 1000  # as many as the paper's
_SMALL = 64  # states
_OF_SETTING = KEY[: KEY.index("method")]


@dataclasses.dataclass(frozen=True)
class Sweep:
    """What is to be computed.

    Attributes:
      settings, methods: every method on every setting.
      draws: number of draws of each.
      sampled: also run 1000 trials of each policy.
      seed: of all random numbers.
    """

    settings: Sequence[Setting]
    methods: Mapping[str, Method]
    draws: int = 20
    sampled: bool = False
    seed: int = 0


def run(sweep: Sweep, file: RowFile, *, retry: bool = False, executor: Any = None, workers: int = 2) -> None:
    """Computes the rows that `file` does not hold yet.

    Args:
      sweep: what to compute.
      file: where rows are read from and appended to.
      retry: compute rows that failed once more.
      executor: who computes, as `jaxhom.sweeps` takes it; threads if None: the solvers on the host use one core each.
      workers: how many that are.

    Raises:
      KeyboardInterrupt: if the user stops it, once the methods in progress are done and their rows written.
      RuntimeError: if the executor gave up.
    """
    work = Work(sweep)
    with ThreadPoolExecutor(workers) if executor is None else contextlib.nullcontext(executor) as crew:
        options = {"executor": crew, "retry": retry, "group": _group, "in_flight": workers}
        runs.run_jobs(work, checked_jobs(work.batches()), file, **options)


def _group(case: dict) -> tuple:
    """What goes one after another: the methods of a batch of draws, which share problems; and all small models.

    Those are solved by LAPACK inside XLA, and two such programs at a time in one process can hang.
    """
    size = case["domain"].lstrip("abcdefghijklmnopqrstuvwxyz_")
    if size and int(size) ** 2 <= _SMALL:
        return ("small",)
    return (*(case[name] for name in _OF_SETTING), case["draw"] // BATCH)


class Work:
    """A method on a batch of draws, for `jaxhom.sweeps`. A case is the key of a row."""

    def __init__(self, sweep: Sweep):
        self.sweep = sweep
        self._settings = {_of_setting(dataclasses.asdict(setting)): setting for setting in sweep.settings}

    def batches(self) -> list[list[dict]]:
        """All cases. First batches come before second ones, which find everything compiled."""
        sweep = self.sweep
        firsts = range(0, sweep.draws, BATCH)
        return [
            [{**shared, "method": method, "draw": draw, "seed": sweep.seed} for draw in draws]
            for draws in (range(first, min(first + BATCH, sweep.draws)) for first in firsts)
            for shared in (dict(zip(_OF_SETTING, of_setting, strict=True)) for of_setting in self._settings)
            for method in sweep.methods
        ]

    def __call__(self, cases: list[dict]) -> list[dict]:
        """The numbers of a row for each case of a batch."""
        draws = tuple(case["draw"] for case in cases)
        problem = _problem(self._settings[_of_setting(cases[0])], draws, self.sweep.seed)
        return _results(problem, self.sweep.methods[cases[0]["method"]], self.sweep.sampled)


def _of_setting(columns: dict) -> tuple:
    return tuple(columns[name] for name in _OF_SETTING)


_alive: weakref.WeakValueDictionary[tuple, Problem] = weakref.WeakValueDictionary()
_mine = threading.local()


def _problem(setting: Setting, draws: tuple[int, ...], seed: int) -> Problem:
    """That of the method before, mostly: problems live as long as they are the last one of a thread."""
    key = (setting, draws, seed)
    _mine.problem = problem = _alive.get(key) or draw_problem(*key)
    _alive[key] = problem
    return problem


def _results(problem: Problem, method: Method, sampled: bool) -> list[dict]:
    """Per draw, the numbers of a row."""
    learned = problem.once(method)
    # A policy that is not finite is refused by whatever evaluates it: another stands in, so that its batch goes on.
    is_good = np.isfinite(learned.policy).all(axis=(1, 2))
    policy = jnp.where(is_good[:, None, None], learned.policy, 1.0 / learned.policy.shape[-1])
    columns = _evaluated(problem, policy, sampled)
    columns["certificate"] = columns["loss_bound"] if learned.certificate is None else learned.certificate
    results = []
    for lane, good in enumerate(is_good):
        status = "none" if learned.status is None else Status(int(learned.status[lane])).name
        numbers = {name: float(column[lane]) for name, column in columns.items()}
        numbers |= {"status": status, "dtype": str(learned.policy.dtype), "batch": len(problem.draws)}
        results.append(numbers if good else {"error": "the policy is not finite"})
    return results


def _evaluated(problem: Problem, policy: jax.Array, sampled: bool) -> dict[str, np.ndarray]:
    """The numeric columns of a row, [B] each: exact, in trials of the setting's length, and sampled."""
    domain = problem.domain

    def run_trials(key, policy, reward):
        options = {"num_trials": _NUM_TRIALS, "terminal": domain.terminal}
        return jaxhom.evaluate_by_sampling(key, domain.bare, policy, reward, problem.setting.trial, **options)

    exact = _evaluate(problem, policy)
    value = jaxhom.policy_value(domain.bare, policy, problem.reward)
    loss = (problem.expert.upper_bound(domain.bare) - value) @ domain.bare.initial * (1.0 - domain.bare.discount)
    columns = {"reward_per_step": exact.reward_per_step, "loss_bound": loss}
    columns["expert_reward"] = problem.once(_expert_reward)
    if domain.terminal is not None:
        columns |= {"steps": exact.steps, "off_roads": exact.events["off_road"], "finished": exact.finished}
    if sampled:
        trials = jax.vmap(run_trials)(problem.trial_keys, policy, problem.reward)
        columns |= {"sampled_reward": trials.reward_per_step, "sampled_error": trials.standard_error.reward_per_step}
    return {name: np.asarray(column) for name, column in columns.items()}


def _evaluate(problem: Problem, policy: jax.Array) -> jaxhom.Evaluation:
    """Exact evaluation in trials of the setting's length."""
    domain = problem.domain
    options = {"horizon": problem.setting.trial, "terminal": domain.terminal}
    events = None if domain.off_road is None else {"off_road": domain.off_road}
    return jaxhom.evaluate_exactly(domain.bare, policy, problem.reward, events=events, **options)


def _expert_reward(problem: Problem) -> jax.Array:
    return _evaluate(problem, problem.expert.policy).reward_per_step
