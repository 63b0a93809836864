"""Who answers the questions of `ask`, and where answers are kept: in a file, a line each as soon as it is given.

Whoever sits at the terminal answers, or whatever writes to standard input; or the optimal policy, for trying it out.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable

import numpy as np

from jaxhom.cli.questions import action_names, mark, name_of
from jaxhom.cli.results import Results
from jaxhom.cli.sources import Problem
from jaxhom.interop.csv_answers import answers_from_csv, append_answer
from jaxhom.models.demonstrations import Demonstrations

_STOP = "q"


class Answers:
    """All answers so far, those of earlier runs included.

    Args:
      problem: the model and what is known of it.
      path: the file; it is made at the first answer if it is missing. None if the optimal policy answers.
      output: is told of the file.

    Attributes:
      skipped: bool [S], states about which nothing is to be said.
      is_over: nobody answers any more.

    Raises:
      FileError: naming the file's line and column if it holds no answers.
      FileNotFoundError: if its folder is missing.
      ValueError: if the model has no optimal policy to answer.
    """

    def __init__(self, problem: Problem, path: str | None, output: Results):
        self._problem, self._path, self._output = problem, path, output
        self._names = action_names(problem)
        self._by_text = {name.lower(): number for number, name in reversed([*enumerate(self._names)])}
        self._expert = np.argmax(problem.plan.policy, axis=1) if path is None else None
        self._states: list[int] = []
        self._actions: list[int] = []
        self.skipped = np.zeros(problem.mdp.num_states, bool)
        self.is_over = False
        if path is not None and not os.path.isdir(os.path.dirname(path) or "."):
            raise FileNotFoundError(2, "no such folder", os.path.dirname(path))  # before somebody answers
        if path is not None and os.path.exists(path) and os.path.getsize(path):
            states, actions = answers_from_csv(path, mdp=problem.mdp)
            self._states, self._actions = states.tolist(), actions.tolist()

    def __len__(self) -> int:
        return len(self._states)

    def added_to(self, demonstrations: Demonstrations) -> Demonstrations:
        """The demonstrations with all answers."""
        return demonstrations.with_answers(np.array(self._states, int), np.array(self._actions, int))

    def ask(self, states: Iterable[int]) -> bool:
        """Asks about states one after the other, until nobody answers any more; whether there was an answer."""
        before = len(self)
        for number, state in enumerate(states):
            action = self._asked(f"{mark(number)}  state {name_of(self._problem, state)}", int(state))
            if self.is_over:
                break
            if action is None:
                self.skipped[state] = True
            else:
                self._keep(int(state), action)
        return len(self) > before

    def _keep(self, state: int, action: int) -> None:
        if self._path is not None:
            append_answer(self._path, state, action, mdp=self._problem.mdp)
            self._output.note(self._path)
        self._states.append(state)
        self._actions.append(action)

    def _asked(self, question: str, state: int) -> int | None:
        """The action for one state; None if there is no answer."""
        if self._expert is not None:
            action = int(self._expert[state])
            print(f"{question}: {self._choice(action)}", flush=True)
            return action
        allowed = np.flatnonzero(np.asarray(self._problem.mdp.allowed)[state]).tolist()
        while True:
            print(f"{question}, one of {', '.join(map(self._choice, allowed))}: ", end="", flush=True)
            line = sys.stdin.readline() if sys.stdin else ""  # which a closed one is not
            text = line.strip().lower()
            if not _is_terminal():
                print(text, flush=True)  # which a terminal has shown already
            if not line or text == _STOP:
                self.is_over = True
            if not text or self.is_over:
                return None
            number = self._by_text.get(text, _number(text))
            if number in allowed:
                return number
            complaint = f"state {state}: {text!r} is no action that is allowed there"
            if not _is_terminal():
                raise ValueError(complaint)
            print(complaint)

    def _choice(self, action: int) -> str:
        name = self._names[action]
        return name if name == str(action) else f"{action} {name}"


def _is_terminal() -> bool:
    return bool(sys.stdin) and sys.stdin.isatty()


def _number(text: str) -> int:
    return int(text) if text.isascii() and text.isdigit() and len(text) < 16 else -1
