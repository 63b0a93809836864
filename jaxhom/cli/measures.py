"""What policies achieve on a problem, in tables and as numbers.

    value       discounted, from the initial distribution, by a linear solve
    loss <=     an upper bound on what the policy loses against any other, in the same units: the planner's upper
                bound on the optimal value minus the policy's own
    reward      undiscounted, of a trial of at most so many steps that ends in a terminal state
    steps       of a trial
    finished    share of trials that are in a terminal state within these steps
    off-roads   per step, on racetracks

`value`, `loss <=` and `reward` need a reward.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxhom.cli.sources import Problem
from jaxhom.cli.tables import format_table
from jaxhom.planning.occupancy import occupancy, policy_value
from jaxhom.planning.trials import Evaluation, agreement, evaluate_by_sampling, evaluate_exactly
from jaxhom.status import at_most

_FORMATS = {
    "value": "{:.5g}".format,
    "loss <=": at_most,
    "reward": "{:.5g}".format,
    "steps": "{:.1f}".format,
}
_SHARE = "{:.3f}".format
_SHARES = ("all states", "where that goes")


@dataclasses.dataclass(frozen=True)
class Measures:
    """One policy's numbers by name, exact or sampled, and standard errors of those that have one."""

    policy: str
    numbers: dict[str, float]
    errors: dict[str, float] = dataclasses.field(default_factory=dict)

    def cells(self, columns: Sequence[str]) -> list[str]:
        """A row of a table."""
        return [self.policy, *(self._cell(name) for name in columns)]

    def _cell(self, name: str) -> str:
        if name not in self.numbers:
            return ""
        text = _FORMATS.get(name, _SHARE)(self.numbers[name])
        return f"{text} ±{self.errors[name]:.1g}" if name in self.errors else text

    def as_json(self) -> dict[str, Any]:
        """The numbers by name."""
        return {"policy": self.policy, **self.numbers, **{f"{k} standard error": v for k, v in self.errors.items()}}


def measure(problem: Problem, policies: Mapping[str, Any], trial: int) -> list[Measures]:
    """Exact measures of named policies [S, A]."""
    result = evaluate_exactly(problem.mdp, *_stacked(problem, policies), trial, **_endings(problem))
    numbers = _numbers(problem, result)
    if problem.reward is not None:
        mdp = problem.mdp
        value = policy_value(mdp, *_stacked(problem, policies)) @ mdp.initial
        loss = problem.plan.upper_bound(mdp) @ mdp.initial - value
        numbers = {"value": value, "loss <=": loss, **numbers}
    return [Measures(name, _at(numbers, i)) for i, name in enumerate(policies)]


def measure_by_sampling(
    problem: Problem, policies: Mapping[str, Any], trial: int, num_trials: int, seed: int
) -> list[Measures]:
    """The measures of trials, from samples with their standard errors."""
    key = jax.random.key(seed)
    arrays = _stacked(problem, policies)
    result = evaluate_by_sampling(key, problem.mdp, *arrays, trial, num_trials=num_trials, **_endings(problem))
    errors = {} if result.standard_error is None else _numbers(problem, result.standard_error)
    numbers = _numbers(problem, result)
    return [Measures(name, _at(numbers, i), _at(errors, i)) for i, name in enumerate(policies)]


def agreements(problem: Problem, policies: Mapping[str, Any], references: Mapping[str, Any]) -> list[dict[str, Any]]:
    """How often policies take the action of references: over all states that matter, and over those they meet."""
    matters: Any = np.ones(problem.mdp.num_states) if problem.terminal is None else 1.0 - problem.terminal
    rows = []
    for name, policy in policies.items():
        for other, reference in references.items():
            met: Any = np.asarray(occupancy(problem.mdp, reference).sum(axis=-1)) * matters
            everywhere, there = (float(agreement(problem.mdp, policy, reference, w)) for w in (matters, met))
            rows.append({"policy": name, "reference": other, "all states": everywhere, "where that goes": there})
    return rows


def agreements_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """All of them below each other."""
    cells = [[row["policy"], row["reference"], *(f"{row[name]:.3f}" for name in _SHARES)] for row in rows]
    return format_table(("policy", "as", *_SHARES), cells)


def measures_table(rows: Sequence[Measures]) -> str:
    """All of them below each other."""
    columns = list(dict.fromkeys(name for row in rows for name in row.numbers))
    return format_table(("policy", *columns), [row.cells(columns) for row in rows])


def _stacked(problem: Problem, policies: Mapping[str, Any]) -> tuple[jax.Array, jax.Array]:
    """Policies [B, S, A] and the reward, zero where it is not known."""
    shape = (problem.mdp.num_states, problem.mdp.num_actions)
    reward = jnp.zeros(shape, problem.mdp.dtype) if problem.reward is None else problem.reward
    return jnp.stack([jnp.asarray(policy, problem.mdp.dtype) for policy in policies.values()]), reward


def _endings(problem: Problem) -> dict:
    return {"terminal": problem.terminal, "events": problem.events}


def _numbers(problem: Problem, result: Evaluation) -> dict:
    """Those of an evaluation that mean something for the problem."""
    numbers = {} if problem.reward is None else {"reward": result.total_reward}
    if problem.terminal is not None:
        numbers |= {"steps": result.steps, "finished": result.finished}
    if problem.off_road is not None:
        numbers["off-roads/step"] = result.events["off_road"]
    return numbers


def _at(numbers: Mapping[str, Any], i: int) -> dict[str, float]:
    return {name: float(array[i]) for name, array in numbers.items()}
