"""Runs settings x methods x draws, appends rows, and goes on where it was stopped.

The draws of a setting go through the solvers in batches of one size, so that few shapes are compiled. A batch that
fails is tried draw by draw; a draw that fails is a row with its error, and the sweep goes on.
"""

import contextlib
import dataclasses
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

import jaxhom
from bench.methods import Method
from bench.problems import Problem, draw_problem
from bench.provenance import provenance
from bench.rows import KEY, Row, RowFile
from bench.settings import Setting
from jaxhom import Status

BATCH = 50  # draws: all of a point of Figure 1, and half of a row of Table I
_NUM_TRIALS = 1000  # as many as the paper's
_BY_LAPACK = threading.Lock()  # small models are solved by LAPACK inside XLA: two such programs at a time can hang
_SMALL = 64  # states
_BAR = "{desc}{percentage:3.0f}%|{bar}| {elapsed}, {remaining} left"


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


@dataclasses.dataclass(frozen=True)
class _Task:
    """A batch of draws of one setting, and per method the rows (without numbers) that are missing."""

    setting: Setting
    draws: tuple[int, ...]
    missing: dict[str, list[Row]]

    @property
    def work(self) -> int:
        """A rough measure of a method's cost: states times missing draws, the compiler's share included."""
        return (self.num_states + 500) * len(self.draws)

    @property
    def num_states(self) -> int:
        """About: of grids and lakes their size says it."""
        size = self.setting.domain.lstrip("abcdefghijklmnopqrstuvwxyz_")
        return int(size) ** 2 if size else 5000


def run(sweep: Sweep, file: RowFile, *, retry: bool = False, workers: int = 2) -> None:
    """Computes the rows that `file` does not hold yet.

    Args:
      sweep: what to compute.
      file: where rows are read from and appended to.
      retry: compute rows that failed once more.
      workers: batches worked on at a time, by threads: the solvers on the host use one core each.

    Raises:
      KeyboardInterrupt: if the user stops it, once the methods in progress are done and their rows written.
    """
    tasks = _tasks(sweep, done={row.key for row in file.read() if not (retry and row.error)})
    is_stopped, lock = threading.Event(), threading.Lock()

    def work(task: _Task) -> None:
        for rows in _compute(sweep, task):
            with lock:
                file.append(rows)
                bar.set_description(task.setting.name, refresh=False)
                bar.update(task.work)
            if is_stopped.is_set():
                return

    total = sum(task.work * len(task.missing) for task in tasks)
    with (
        tqdm(total=total, bar_format=_BAR, mininterval=1.0, smoothing=0.05) as bar,
        ThreadPoolExecutor(workers) as pool,
    ):
        futures = [pool.submit(work, task) for task in tasks]
        try:
            for future in as_completed(futures):
                future.result()
        except BaseException:
            is_stopped.set()
            pool.shutdown(wait=False, cancel_futures=True)
            bar.write("stopping as soon as the methods in progress are done", file=sys.stderr)
            raise


def _tasks(sweep: Sweep, done: set) -> list[_Task]:
    """What is missing. All first batches come before the second ones, which find everything compiled."""
    tasks = []
    for first in range(0, sweep.draws, BATCH):
        draws = tuple(range(first, min(first + BATCH, sweep.draws)))
        for setting in sweep.settings:
            shared = {name: getattr(setting, name) for name in KEY if hasattr(setting, name)} | {"seed": sweep.seed}
            blanks = {name: [Row(**shared, method=name, draw=draw) for draw in draws] for name in sweep.methods}
            missing = {name: [row for row in rows if row.key not in done] for name, rows in blanks.items()}
            tasks.append(_Task(setting, draws, {name: rows for name, rows in missing.items() if rows}))
    return [task for task in tasks if task.missing]


def _compute(sweep: Sweep, task: _Task) -> Iterator[list[Row]]:
    """The missing rows of a task, method by method. A batch is computed whole: its shapes are compiled already."""
    problems: dict[tuple[int, ...], Problem] = {}

    def results(method: Method, draws: tuple[int, ...]) -> list[dict]:
        """Per draw, the numbers of a row or its error; if the batch fails, draw by draw."""
        try:
            if draws not in problems:
                problems[draws] = draw_problem(task.setting, draws, sweep.seed)
            return _results(problems[draws], method, sweep.sampled)
        except Exception as error:  # of whichever draw: it alone is to have no numbers
            if len(draws) == 1:
                return [{"error": f"{type(error).__name__}: {error}"[:300], "batch": 1}]
            return [result for draw in draws for result in results(method, (draw,))]

    for name, blanks in task.missing.items():
        with _BY_LAPACK if task.num_states <= _SMALL else contextlib.nullcontext():
            start = time.perf_counter()
            found = dict(zip(task.draws, results(sweep.methods[name], task.draws), strict=True))
        shared = {"seconds": (time.perf_counter() - start) / len(task.draws)}
        shared |= provenance("jax", "jaxlib", "numpy", "scipy")
        yield [dataclasses.replace(blank, **found[blank.draw], **shared) for blank in blanks]


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
