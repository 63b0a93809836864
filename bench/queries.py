"""Methods that ask the expert for its action in single states, round by round, and learn by Algorithm 1 in between.

A round is a number of questions (`settings.QUESTIONS_PER_ROUND`), or, for comparison, one more demonstration, which has
as many steps on racetrack (a).
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

import jax
import numpy as np

import jaxhom
from bench.methods import Learned, Method, expert, soft
from bench.problems import Problem, draw_problem
from bench.settings import QUESTIONS_PER_ROUND
from jaxhom import MDP, Demonstrations
from jaxhom.models.mdp import absorbing_states

ROUNDS = 4
CRITERIA = ("visits_entropy", "visits", "bound")


@dataclasses.dataclass(frozen=True)
class _Asked:
    """Where a round ended: what has been demonstrated and answered, and what was learned from it."""

    demonstrations: list[Demonstrations]
    learned: Learned


def after(problem: Problem, *, choose: Callable | None, rounds: int) -> Learned:
    """What is learned after some rounds of questions in the states that `choose` proposes; demonstrations if None."""
    return _asked(problem, choose, rounds).learned


def _asked(problem: Problem, choose: Callable | None, rounds: int) -> _Asked:
    step = (choose if rounds else None, rounds)  # rounds build on each other: methods share them
    if step not in problem.found:
        problem.found[step] = _ask(problem, choose, rounds)
    return problem.found[step]


def _ask(problem: Problem, choose: Callable | None, rounds: int) -> _Asked:
    if rounds == 0:
        shown = problem.demonstrations
    elif choose is None:
        more = dataclasses.replace(problem.setting, demonstrations=problem.setting.demonstrations + rounds)
        shown = draw_problem(more, problem.draws, problem.seed).demonstrations
    else:
        before = _asked(problem, choose, rounds - 1)
        shown = [
            _with_answers(problem, lane, rounds, choose, *pair)
            for lane, pair in enumerate(zip(before.demonstrations, before.learned.policy, strict=True))
        ]
    learned = soft(dataclasses.replace(problem, demonstrations=shown, found={}))
    return _Asked(shown, learned)


def _with_answers(problem: Problem, lane: int, rounds: int, choose: Callable, shown, policy) -> Demonstrations:
    """The demonstrations of a draw with the expert's answers in the states that are chosen."""
    count = QUESTIONS_PER_ROUND.get(problem.setting.domain, 20)
    states = choose(problem, lane, rounds, shown, policy, count)
    actions = np.asarray(problem.expert.policy[lane]).argmax(axis=1)[states]
    return shown.with_answers(states, actions) if len(states) else shown


def proposed(problem: Problem, lane: int, rounds: int, shown, policy, count: int, *, criterion: str) -> np.ndarray:
    """By `query_states`."""
    del lane, rounds
    mdp = problem.domain.mdp if criterion == "bound" else problem.domain.bare
    found = jaxhom.query_states(mdp, shown, policy, count, criterion=criterion, terminal=problem.domain.terminal)
    return np.asarray(found.states)


def at_random(problem: Problem, lane: int, rounds: int, shown, policy, count: int) -> np.ndarray:
    """Undemonstrated states in which there is something to decide, drawn without looking."""
    del policy
    mdp: MDP = problem.domain.bare
    visited = np.asarray(jaxhom.empirical_policy(mdp, shown)[0])
    may = ~visited & ~np.asarray(absorbing_states(mdp))
    if problem.domain.terminal is not None:
        may &= ~np.asarray(problem.domain.terminal)
    key = jax.random.fold_in(problem.trial_keys[lane], rounds)
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    states = np.flatnonzero(may)
    return rng.choice(states, min(count, len(states)), replace=False)


_CHOICES: dict[str, Callable | None] = {
    "demonstrations": None,
    "random states": at_random,
    **{name: functools.partial(proposed, criterion=name) for name in CRITERIA},
}
QUERIES: dict[str, Method] = {
    "expert": expert,
    "no questions": functools.partial(after, choose=None, rounds=0),
    **{
        f"{name}, round {rounds}": functools.partial(after, choose=choose, rounds=rounds)
        for name, choose in _CHOICES.items()
        for rounds in range(1, ROUNDS + 1)
    },
}
"""Per way of choosing, after each round."""
