"""What `learn` tells: tables as soon as their numbers are there, and the same in report.json."""

from __future__ import annotations

import argparse
import contextlib
import time
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxhom.apprenticeship.lpal import LPALSolution
from jaxhom.cli.measures import measure, measures_table
from jaxhom.cli.methods import settings_of
from jaxhom.cli.results import Results
from jaxhom.cli.sources import Problem
from jaxhom.cli.statuses import in_words, remarks, undecided, warn, worst_status
from jaxhom.cli.tables import format_facts
from jaxhom.generalization.result import Generalization
from jaxhom.models.demonstrations import Demonstrations
from jaxhom.status import Status, bracket

if TYPE_CHECKING:
    from jaxtyping import Array, Bool

_MAX_RADII = 8  # that have a row each


class Report:
    """Prints and writes what is known so far; see the module.

    Args:
      problem: the model and what is known of it.
      demonstrations: what is learned from.
      origin: where they come from, in words.
      visited: bool [S], the states in them.
      options: of the command line.
      results: where report.json goes.
    """

    def __init__(
        self,
        problem: Problem,
        demonstrations: Demonstrations,
        origin: str,
        visited: Bool[Array, " S"],
        options: argparse.Namespace,
        results: Results,
    ):
        self._problem, self._results = problem, results
        mdp, terminal = problem.mdp, problem.terminal
        # Where an episode has ended no action matters, and such states are no part of the counts.
        self._matters = np.ones(mdp.num_states, bool) if terminal is None else ~terminal
        sizes = {"states": mdp.num_states, "actions": mdp.num_actions, "features": mdp.num_features}
        answers = int(np.asarray(demonstrations.is_answer).sum())
        steps = int(np.asarray(demonstrations.mask).sum()) - answers
        count, num_visited = demonstrations.num_trajectories - answers, int(np.asarray(visited).sum())
        self.content: dict[str, Any] = {
            "finished": False,
            "options": {name: value for name, value in vars(options).items() if name not in ("run", "command")},
            "model": {"name": problem.name, **sizes, "discount": float(mdp.discount)},
            "demonstrations": {"origin": origin, "trajectories": count, "steps": steps, "states": num_visited},
            "method": {"name": options.method, **settings_of(options)},
        }
        rows = [("model", problem.name)]
        rows.append(("states, actions, features", ", ".join(map(str, sizes.values()))))
        rows.append(("discount", f"{float(mdp.discount):g}"))
        if terminal is not None:
            self.content["model"]["terminal_states"] = int(terminal.sum())
            rows.append(("states in which episodes end", _share(terminal)))
        rows += [("demonstrations", origin), ("trajectories, steps", f"{count}, {steps}")]
        if answers:
            self.content["demonstrations"]["answers"] = answers
            rows.append(("answers about single states", str(answers)))
        self._tell("problem", [*rows, ("states demonstrated", _share(visited))])

    def generalization(self, general: Generalization, numbers: Mapping[str, Any]) -> None:
        """Where advice was found.

        Args:
          general: the generalization.
          numbers: what else is known of its making.
        """
        radius = np.asarray(general.radius)
        levels, counts = np.unique(radius[self._matters & (radius > 0)], return_counts=True)
        nothing = self._matters & (radius < 0)
        by_radius = dict(zip(map(str, levels.tolist()), counts.tolist(), strict=True))
        self.content["generalization"] = {"states_by_radius": by_radius, "nothing_found": int(nothing.sum()), **numbers}
        rows = [("states generalized to", _share(self._matters & (radius > 0)))]
        shown = len(levels) if len(levels) <= _MAX_RADII else _MAX_RADII - 1
        rows += [(f"  advice from radius {level}", str(count)) for level, count in by_radius.items()][:shown]
        if shown < len(levels):
            rows.append((f"  advice from radius {levels[shown]} to {levels[-1]}", str(counts[shown:].sum())))
        rows.append(("states without a vote (uniform policy)", _share(nothing)))
        rows += self._how_it_ended(general)
        if "chosen" in numbers:
            rows.append(("chosen", str(numbers["chosen"])))
            scores = zip(numbers["candidates"], numbers["scores"], strict=True)
            rows += [(f"  log-likelihood of a step left out, {name}", f"{score:.4f}") for name, score in scores]
        if "error_lower" in numbers:
            rows.append(("error of the map", bracket(numbers["error_lower"], numbers["error_upper"])))
        if "pairs_of_classes_solved" in numbers:
            solved = f"{numbers['classes_of_local_models']}, {numbers['pairs_of_classes_solved']}"
            rows.append(("classes of local models, pairs that took a solver", solved))
        self._tell("\ngeneralization", rows)

    def _how_it_ended(self, general: Generalization) -> list[tuple[str, str]]:
        """What is said of a generalization that did not end as asked for."""
        status, (pairs, states) = worst_status(general), undecided(general)
        if status is not None:
            counts = {"undecided_pairs": pairs, "undecided_states": states}
            self.content["generalization"] |= {"status": status.name, **counts}
        rows = [("pairs left undecided", in_words(pairs, states))] if pairs else []
        return rows + ([("status", status.message)] if status else [])  # SOLVED is 0

    def lpal(self, solution: LPALSolution) -> None:
        """LPAL's certificate."""
        margin, bound, status = float(solution.margin), float(solution.margin_bound), Status(int(solution.status))
        self.content["lpal"] = {
            "margin": margin,
            "margin_bound": bound,
            "status": status.name,
            "iterations": int(solution.iterations),
        }
        facts = [("margin", f"{margin:.6g}"), ("no policy's margin exceeds", f"{bound:.6g}")]
        self._tell("\nLPAL", [*facts, ("status", status.message)])

    def values(self, policies: Mapping[str, Any]) -> None:
        """What named policies achieve, where a reward is known."""
        rows = measure(self._problem, policies, self._problem.trial)
        self.content["values"] = [row.as_json() for row in rows]
        self.content["steps_of_a_trial"] = self._problem.trial
        self.content["status_of_the_optimal_policy"] = Status(int(self._problem.plan.status)).name
        self._results.report(self.content)
        print(f"\n{measures_table(rows)}")
        print(
            f"value: discounted, over all time; the rest: of trials of at most {self._problem.trial} steps", flush=True
        )
        warn(remarks("optimal policy", self._problem.plan))

    @contextlib.contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Notes the seconds that a stage takes."""
        start = time.perf_counter()
        yield
        self.content[name] = round(time.perf_counter() - start, 3)

    def finish(self) -> None:
        """All stages are done."""
        self.content["finished"] = True
        self._results.report(self.content)

    def _tell(self, title: str, facts: list[tuple[str, str]]) -> None:
        print(format_facts(title, facts), flush=True)
        self._results.report(self.content)


def _share(mask) -> str:
    mask = np.asarray(mask)
    return f"{int(mask.sum())} ({100 * float(mask.mean()):.1f}%)"
