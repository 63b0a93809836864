"""The map of least error from all states of a model to those of a target: `global_lp` solved, on the host or traced."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from jaxhom import checks, programs
from jaxhom.generalization.global_lp import GlobalHomomorphismProblem, HostProblem
from jaxhom.solvers import pdhg
from jaxhom.solvers.lane_queue import is_settled
from jaxhom.status import Status

# Of a thousand iterations in NumPy, per number of y [S, A, E]: 16 x 16 cells with 24 demonstrated states take 1.2 s.
# With 2e5 numbers an iteration takes three times as long as the program's.
_SECONDS = 2e-5
_ITERATIONS_PER_REPORT = 320  # a program cannot be interrupted


class Effort(NamedTuple):
    """The gap between the bounds to settle for, the most iterations, and whether to show a progress bar."""

    tolerance: float
    max_iterations: int
    progress: bool


class GlobalMap(NamedTuple):
    """A map [S, E], bounds on the optimal error, and a `Status`."""

    mapping: np.ndarray | jax.Array
    lower: jax.Array
    upper: jax.Array
    status: int | jax.Array


def require_effort(tolerance, max_iterations, progress) -> Effort:
    """The options as a user gives them, or `ValueError`."""
    checks.refuse_traced(tolerance=tolerance, max_iterations=max_iterations)
    tolerance = checks.require_number("tolerance", tolerance)
    checks.require_positive("tolerance", tolerance)
    return Effort(tolerance, checks.require_count("max_iterations", max_iterations), progress)


def map_on_host(problem: HostProblem, effort: Effort) -> GlobalMap:
    """The map, with a look at the clock and the keyboard every few hundred iterations."""
    state = _solve_with_progress(problem, effort)
    lower, upper = state.lower[0], state.upper[0]
    is_met = is_settled(float(lower), float(upper), effort.tolerance)
    status = Status.SOLVED if is_met else Status.ITERATION_LIMIT
    return GlobalMap(np.asarray(state.best_primal[..., 0]), lower, upper, status)


def map_in_program(problem: GlobalHomomorphismProblem, effort: Effort, rounding: float = 0.0) -> GlobalMap:
    """The map, with columns of zeros for padding; without an iteration, and bounds, where all is padding.

    Args:
      problem: the problem, traced.
      effort: how much of it.
      rounding: by how much the target's transitions are off, and so, at most, the optimal error.
    """
    is_any = problem.exists.any()
    limit = jnp.where(is_any, effort.max_iterations, 0)
    gap = max(effort.tolerance - 4.0 * rounding, 0.0)
    state = pdhg.solve(problem, pdhg.init(problem), tolerance=gap, max_iterations=limit)
    lower = jnp.where(is_any, jnp.maximum(state.lower[0] - rounding, 0.0), jnp.inf)
    upper = jnp.where(is_any, state.upper[0] + rounding, jnp.inf)
    is_met = is_settled(lower, upper, effort.tolerance) | ~is_any
    mapping = jnp.where(problem.exists, state.best_primal[..., 0], 0.0)
    return GlobalMap(mapping, lower, upper, jnp.where(is_met, Status.SOLVED, Status.ITERATION_LIMIT))


def _solve_with_progress(problem: HostProblem, effort: Effort) -> pdhg.PDHGState:
    """Runs the engine a few hundred iterations at a time, so that the host can report and be interrupted."""
    run, state, most = _solve_some, pdhg.init(problem), effort.max_iterations
    if programs.pays(_SECONDS * state.dual.size):
        run, problem, state = _run_engine, *jax.tree.map(checks.to_device, (problem.on_device(), state))
    with tqdm(total=most, desc="homomorphism", unit="iteration", disable=not effort.progress) as bar:
        while int(state.steps[0]) < most and float(state.upper[0] - state.lower[0]) > effort.tolerance:
            limit = min(int(state.steps[0]) + _ITERATIONS_PER_REPORT, most)
            state = run(problem, state, effort.tolerance, limit)
            bar.update(int(state.steps[0]) - bar.n)
            bar.set_postfix(lower=f"{float(state.lower[0]):.4f}", upper=f"{float(state.upper[0]):.4f}")
    return state


def _solve_some(problem, state, tolerance, max_iterations) -> pdhg.PDHGState:
    return pdhg.solve(problem, state, tolerance=tolerance, max_iterations=max_iterations)


_run_engine = programs.host_jit(_solve_some)
