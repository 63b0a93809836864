"""Runs settings x methods x draws, appends rows, and goes on where it was stopped.

The draws of a setting go through the solvers in batches of one size, so that few shapes are compiled. A batch that
fails is tried draw by draw; a draw that fails is a row with its error, and the sweep goes on.
"""

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
from bench.methods import Learned, Method
from bench.problems import Problem, draw_problem
from bench.rows import Row, RowFile, provenance
from bench.settings import Setting
from jaxhom import Status

BATCH = 50
_NUM_TRIALS = 1000
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
    draws: int
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
        domain = self.setting.domain
        num_states = int(domain[4:]) ** 2 if domain.startswith("grid") else 5000
        return (num_states + 500) * len(self.draws)


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
            blanks = {name: [_blank(setting, name, draw, sweep.seed) for draw in draws] for name in sweep.methods}
            missing = {name: [row for row in rows if row.key not in done] for name, rows in blanks.items()}
            tasks.append(_Task(setting, draws, {name: rows for name, rows in missing.items() if rows}))
    return [task for task in tasks if task.missing]


def _blank(setting: Setting, method: str, draw: int, seed: int) -> Row:
    """The key of a row, without numbers."""
    fields = {field.name for field in dataclasses.fields(Row)}
    shared = {name: value for name, value in dataclasses.asdict(setting).items() if name in fields}
    return Row(**shared, method=method, draw=draw, seed=seed)


def _compute(sweep: Sweep, task: _Task) -> Iterator[list[Row]]:
    """The missing rows of a task, method by method. A batch is computed whole: its shapes are compiled already."""
    problem = None
    for name, blanks in task.missing.items():
        start = time.perf_counter()
        try:
            problem = problem or draw_problem(task.setting, task.draws, sweep.seed)
            results = _results(problem, sweep.methods[name], sweep.sampled)
        except Exception:  # of whichever draw: it alone is to have no numbers
            results = _results_one_by_one(sweep, task, name)
        shared = {"seconds": (time.perf_counter() - start) / len(task.draws), **provenance()}
        found = dict(zip(task.draws, results, strict=True))
        yield [dataclasses.replace(blank, **found[blank.draw], **shared) for blank in blanks]


def _results_one_by_one(sweep: Sweep, task: _Task, method: str) -> list[dict]:
    """Per draw, the numbers of a row or its error."""
    results = []
    for draw in task.draws:
        try:
            problem = draw_problem(task.setting, (draw,), sweep.seed)
            results += _results(problem, sweep.methods[method], sweep.sampled)
        except Exception as error:
            results.append({"error": f"{type(error).__name__}: {error}"[:300], "batch": 1})
    return results


def _results(problem: Problem, method: Method, sampled: bool) -> list[dict]:
    """Per draw, the numbers of a row."""
    learned = method(problem)
    # A policy that is not finite is refused by whatever evaluates it: another stands in, so that its batch goes on.
    is_good = np.isfinite(learned.policy).all(axis=(1, 2))
    policy = jnp.where(is_good[:, None, None], learned.policy, 1.0 / learned.policy.shape[-1])
    columns = _evaluated(problem, dataclasses.replace(learned, policy=policy), sampled)
    lanes = range(len(learned.policy))
    results = [{name: float(column[lane]) for name, column in columns.items()} for lane in lanes]
    for lane, result in enumerate(results):
        status = "none" if learned.status is None else Status(int(learned.status[lane])).name
        result |= {"status": status, "dtype": str(learned.policy.dtype), "batch": len(problem.draws)}
    return [r if good else {"error": "the policy is not finite"} for r, good in zip(results, is_good, strict=True)]


def _evaluated(problem: Problem, learned: Learned, sampled: bool) -> dict[str, np.ndarray]:
    """The numeric columns of a row, [B] each."""
    domain, policy = problem.domain, learned.policy
    exact = _evaluate(problem, policy)
    expert = problem.once("expert_reward", lambda: _evaluate(problem, problem.expert.policy).reward_per_step)
    value = jaxhom.policy_value(domain.bare, policy, problem.reward)
    loss = (problem.expert.upper_bound(domain.bare) - value) @ domain.bare.initial * (1.0 - domain.bare.discount)
    columns = {"reward_per_step": exact.reward_per_step, "expert_reward": expert, "loss_bound": loss}
    columns["certificate"] = loss if learned.certificate is None else learned.certificate
    if domain.terminal is not None:
        columns |= {"steps": exact.steps, "off_roads": exact.events["off_road"], "finished": exact.finished}
    if sampled:
        trials = _run_trials(problem, policy)
        columns |= {"sampled_reward": trials.reward_per_step, "sampled_error": trials.standard_error.reward_per_step}
    return {name: np.asarray(column) for name, column in columns.items()}


def _evaluate(problem: Problem, policy: jax.Array):
    """Exact evaluation in trials of the setting's length."""
    domain = problem.domain
    events = None if domain.off_road is None else {"off_road": domain.off_road}
    options = {"terminal": domain.terminal, "events": events}
    return jaxhom.evaluate_exactly(domain.bare, policy, problem.reward, horizon=problem.setting.trial, **options)


def _run_trials(problem: Problem, policy: jax.Array):
    """1000 sampled trials per draw, each draw with random numbers of its own."""
    domain = problem.domain

    def run(key, policy, reward):
        options = {"num_trials": _NUM_TRIALS, "terminal": domain.terminal}
        return jaxhom.evaluate_by_sampling(key, domain.bare, policy, reward, problem.setting.trial, **options)

    return jax.vmap(run)(problem.trial_keys, policy, problem.reward)
