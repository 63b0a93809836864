"""Runs settings x methods x draws, appends rows, and goes on where it was stopped.

The draws of a setting go through the solvers in batches of one size, so that few shapes are compiled. What fails is a
row with its error, for all draws of the batch, and the sweep goes on.
"""

import dataclasses
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

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


def run(sweep: Sweep, file: RowFile, *, retry: bool = False, workers: int = 2) -> None:
    """Computes the rows that `file` does not hold yet.

    Args:
      sweep: what to compute.
      file: where rows are read from and appended to.
      retry: compute rows that failed once more.
      workers: batches worked on at a time, by threads: the solvers on the host use one core each.
    """
    done = {row.key for row in file.read() if not (retry and row.error)}
    batches = [
        (setting, tuple(range(first, min(first + BATCH, sweep.draws))))
        for setting in sweep.settings
        for first in range(0, sweep.draws, BATCH)
    ]
    total = sum(_work(setting) * len(draws) for setting, draws in batches) * len(sweep.methods)
    is_stopped, lock = threading.Event(), threading.Lock()

    def work(setting: Setting, draws: tuple[int, ...]) -> None:
        for rows in _run_batch(sweep, setting, draws, done):
            with lock:
                file.append(rows)
                bar.set_description(setting.name)
                bar.update(_work(setting) * len(draws))
            if is_stopped.is_set():
                return

    bar_format = "{desc}: {percentage:3.0f}%|{bar}| {elapsed} < {remaining}"
    with tqdm(total=total, bar_format=bar_format) as bar, ThreadPoolExecutor(workers) as pool:
        futures = [pool.submit(work, *batch) for batch in batches]
        try:
            for future in futures:
                future.result()
        except BaseException:
            is_stopped.set()
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _run_batch(sweep: Sweep, setting: Setting, draws, done: set) -> Iterator[list[Row]]:
    """The rows of one batch, method by method, without those in `done`."""
    problem = None
    for name, method in sweep.methods.items():
        blanks = [_blank(setting, name, draw, sweep.seed) for draw in draws]
        missing = [blank.key not in done for blank in blanks]
        rows = []
        if any(missing):
            start = time.perf_counter()
            try:
                problem = problem or draw_problem(setting, draws, sweep.seed)
                results = _results(problem, method(problem), sweep.sampled)
            except Exception as error:  # a failed cell is a row
                results = [{"error": f"{type(error).__name__}: {error}"[:300]}] * len(draws)
            shared = {"seconds": (time.perf_counter() - start) / len(draws), "batch": len(draws), **provenance()}
            pairs = zip(blanks, results, strict=True)
            rows = [dataclasses.replace(blank, **result, **shared) for blank, result in pairs]
        yield [row for row, wanted in zip(rows, missing, strict=False) if wanted]


def _blank(setting: Setting, method: str, draw: int, seed: int) -> Row:
    """The key of a row, without numbers."""
    fields = {field.name for field in dataclasses.fields(Row)}
    shared = {name: value for name, value in dataclasses.asdict(setting).items() if name in fields}
    return Row(**shared, method=method, draw=draw, seed=seed)


def _results(problem: Problem, learned: Learned, sampled: bool) -> list[dict]:
    """Per draw, the numbers of a row."""
    domain, policy = problem.domain, learned.policy
    exact = _evaluate(problem, policy)
    expert = problem.once("expert_reward", lambda: _evaluate(problem, problem.expert.policy).reward_per_step)
    value = jaxhom.policy_value(domain.bare, policy, problem.reward)
    loss = (problem.expert.upper_bound(domain.bare) - value) @ domain.bare.initial * (1.0 - domain.bare.discount)
    columns = {"reward_per_step": exact.reward_per_step, "expert_reward": expert, "loss_bound": loss}
    if domain.terminal is not None:
        columns |= {"steps": exact.steps, "off_roads": exact.events["off_road"], "finished": exact.finished}
    if sampled:
        trials = _run_trials(problem, policy)
        columns |= {"sampled_reward": trials.reward_per_step, "sampled_error": trials.standard_error.reward_per_step}
    if learned.certificate is not None:
        columns["certificate"] = learned.certificate
    results = [{name: float(column[lane]) for name, column in columns.items()} for lane in range(len(policy))]
    if not all(np.isfinite(result["reward_per_step"]) for result in results):
        raise FloatingPointError("a policy's reward per step is not finite")
    status = [""] * len(policy) if learned.status is None else [Status(int(code)).name for code in learned.status]
    return [
        {**result, "status": name, "dtype": str(domain.mdp.dtype)} for result, name in zip(results, status, strict=True)
    ]


def _evaluate(problem: Problem, policy: jax.Array):
    """Exact evaluation in trials of the setting's length."""
    domain = problem.domain
    events = None if domain.off_road is None else {"off_road": domain.off_road}
    options = {"terminal": domain.terminal, "events": events}
    return jaxhom.evaluate_exactly(domain.bare, policy, problem.reward, problem.setting.trial, **options)


def _run_trials(problem: Problem, policy: jax.Array):
    """1000 sampled trials per draw, each draw with random numbers of its own."""
    domain, horizon = problem.domain, problem.setting.trial
    terminal = jnp.zeros(domain.bare.num_states, bool) if domain.terminal is None else domain.terminal
    return _sampled(problem.trial_keys, domain.bare, policy, problem.reward, terminal, horizon)


def _sampled(keys, mdp, policy, reward, terminal, horizon):
    def one(key, policy, reward):
        return jaxhom.evaluate_by_sampling(key, mdp, policy, reward, horizon, num_trials=_NUM_TRIALS, terminal=terminal)

    return jax.vmap(one)(keys, policy, reward)


def _work(setting: Setting) -> int:
    """A rough measure of a draw's cost: the number of states."""
    if setting.domain.startswith("grid"):
        return int(setting.domain[4:]) ** 2
    return 5000
