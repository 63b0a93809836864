"""`python -m jaxhom ask`: learn, ask the expert about the states that matter most, and learn again.

Each round learns from the demonstrations and all answers so far, writes what it learned, and says in a line how far it
has come. Answers are kept as they are given: an interruption loses none, and the next run goes on from them.
"""

from __future__ import annotations

import argparse
import os
from typing import Any

import numpy as np

from jaxhom.cli import pictures
from jaxhom.cli.answers import Answers
from jaxhom.cli.methods import GENERALIZATIONS, add_method_options, check_method, generalize
from jaxhom.cli.options import (
    MODEL_HELP,
    add_command,
    add_demonstration_options,
    add_model_options,
    add_result_options,
    positive,
)
from jaxhom.cli.questions import questions
from jaxhom.cli.report import Report
from jaxhom.cli.results import Results
from jaxhom.cli.sources import Problem, load_problem, load_trajectories
from jaxhom.cli.statuses import remarks, warn
from jaxhom.generalization.choice import choose_generalization
from jaxhom.generalization.result import Generalization
from jaxhom.guarantees.loss_bound import loss_bound
from jaxhom.guarantees.queries import CRITERIA, query_states
from jaxhom.models.demonstrations import Demonstrations, empirical_policy
from jaxhom.models.mdp import absorbing_states
from jaxhom.planning.occupancy import policy_value

_EXAMPLES = """\
examples:
  python -m jaxhom ask --env CliffWalking-v1 --expert 1 --answers expert --rounds 5 --output cliff
  python -m jaxhom ask --mdp my.track --demonstrations drives.csv --output track
  python -m jaxhom ask --mdp model.npz --demonstrations demos.npz --answers said.csv --until-loss 0.01 --output p.npz

Questions come in rounds. Each is answered with the number or the name of an action; an empty line skips the state, q
stops. Answers are kept in a file with the columns state, action, a line each, OUTPUT/answers.csv if no other is named.
Those that it holds already count from the start. With `--answers expert` they are in OUTPUT/demonstrations.npz alone.

"""
_ANSWERS, _EXPERT = "answers.csv", "expert"


def add_parser(commands: Any) -> None:
    """Adds the command."""
    summary = "learn, ask the expert about the states that matter most, and learn again"
    parser = add_command(commands, "ask", run, summary=summary, epilog=_EXAMPLES + MODEL_HELP)
    add_model_options(parser)
    add_demonstration_options(parser)
    add_method_options(parser, GENERALIZATIONS)
    group = parser.add_argument_group("questions")
    group.add_argument("--count", type=positive, default=5, metavar="N", help="of a round (default 5)")
    group.add_argument(
        "--criterion",
        choices=CRITERIA,
        default=CRITERIA[0],
        help=f"what ranks states (default {CRITERIA[0]}); bound needs features",
    )
    group.add_argument(
        "--answers",
        metavar="FILE.csv",
        help=f"where they are kept; {_EXPERT}: the optimal policy answers, for a trial",
    )
    group.add_argument("--rounds", type=positive, metavar="N", help="at most (default: as long as somebody answers)")
    group.add_argument(
        "--until-loss", type=float, metavar="X", help="stop when the bound on what is lost per step is at most X"
    )
    group.add_argument(
        "--until-likelihood",
        type=float,
        metavar="X",
        help="stop when the mean log-likelihood of a step that was left out is at least X",
    )
    add_result_options(parser)


def run(options: argparse.Namespace) -> None:
    """Reads, and goes round by round.

    Raises:
      ValueError: on wrong input.
      KeyboardInterrupt: with the files that were written as its message.
    """
    problem = load_problem(options)
    check_method(problem, options)
    demonstrations, origin = load_trajectories(problem, options)
    _check(problem, demonstrations, options)
    output = Results(options.output)
    path = options.answers or os.path.join(options.output, _ANSWERS)
    if not options.answers and not output.is_folder:
        raise ValueError("--answers FILE.csv is needed where --output is the policy's file alone")
    answers = Answers(problem, None if path == _EXPERT else path, output)
    with output.kept():
        visited, _ = empirical_policy(problem.mdp, demonstrations)
        report = Report(problem, demonstrations, origin, visited, options, output)
        _learn_and_ask(problem, demonstrations, answers, options, output, report)


def _check(problem: Problem, demonstrations: Demonstrations, options) -> None:
    """Raises `ValueError` on what cannot be computed of this problem."""
    for name in ("until_loss", "until_likelihood"):
        if np.isnan(getattr(options, name) or 0.0):
            raise ValueError(f"--{name.replace('_', '-')} must be a number")
    if not problem.mdp.num_features and (options.until_loss is not None or options.criterion == "bound"):
        what = "--until-loss" if options.until_loss is not None else "--criterion bound"
        raise ValueError(f"{what} needs features, and {problem.name} has none")
    if options.until_likelihood is not None and not _can_leave_one_out(problem, demonstrations):
        raise ValueError("--until-likelihood needs two trajectories at least, one of which can be left out")


def _learn_and_ask(problem: Problem, demonstrations, answers: Answers, options, output: Results, report) -> None:
    rounds: list[dict[str, Any]] = []
    draws = problem.domain is not None and pictures.are_wanted(output, options)
    shown = answers.added_to(demonstrations)
    while True:
        general, numbers = generalize(problem, shown, options)
        output.demonstrations(shown)
        output.policy(
            general.policy,
            is_final=True,
            **{"visited": general.visited, "radius": general.radius, "support": general.support, **numbers},
        )
        rounds.append(_standing(problem, shown, general, numbers, options, len(answers)))
        report.content["rounds"] = rounds
        output.report(report.content)
        print(f"\nround {len(rounds) - 1}: {_in_words(rounds[-1])}", flush=True)
        is_last = options.rounds is not None and len(rounds) > options.rounds
        if is_last or _is_enough(rounds[-1], options):
            break
        if not _ask(problem, shown, general, answers, options, output if draws else None):
            break
        shown = answers.added_to(demonstrations)
    report.generalization(general, numbers)
    report.finish()


def _ask(problem: Problem, shown, general, answers: Answers, options, output: Results | None) -> bool:
    """A round of questions; whether there is an answer."""
    while not answers.is_over:
        left_out = answers.skipped if problem.terminal is None else answers.skipped | problem.terminal
        queries = query_states(
            problem.mdp, shown, general, options.count, criterion=options.criterion, terminal=left_out
        )
        warn(remarks("loss bound", queries))
        if not queries.states.size:
            print("nothing is left to ask", flush=True)
            return False
        print(f"{questions(problem, shown, queries)}\n", flush=True)
        if output is not None:
            output.picture("questions", pictures.draw_questions(problem, shown, np.asarray(queries.states)))
        if answers.ask(np.asarray(queries.states)):
            return True
    return False


def _standing(
    problem: Problem, shown: Demonstrations, general: Generalization, numbers: dict, options, num_answers: int
) -> dict[str, Any]:
    """What is known of a policy, by name; left out what cannot be known of this problem."""
    mdp = problem.mdp
    standing: dict[str, Any] = {"states": int(np.asarray(general.visited).sum()), "answers": num_answers}
    if "scores" in numbers:
        standing["likelihood"] = numbers["scores"][numbers["candidates"].index(numbers["chosen"])]
    elif _can_leave_one_out(problem, shown):
        standing["likelihood"] = _likelihood(problem, shown, general, options)
    if mdp.num_features:
        loss = loss_bound(mdp, shown, general.policy)
        warn(remarks("loss bound", loss))
        standing["loss_per_step"] = float(loss.bound) * (1.0 - float(mdp.discount))
    if problem.reward is not None:
        for name, values in (
            ("value", policy_value(mdp, general.policy, problem.reward)),
            ("optimal_value", problem.plan.value),
        ):
            standing[name] = float(np.asarray(values) @ np.asarray(mdp.initial))
    return standing


def _likelihood(problem: Problem, shown: Demonstrations, general: Generalization, options) -> float:
    """The method's score, by leaving out one trajectory after the other."""

    def learned(_, some: Demonstrations) -> Generalization:
        return general if len(some) == len(shown) else generalize(problem, some, options)[0]

    matters = None if problem.terminal is None else ~problem.terminal
    choice = choose_generalization(problem.mdp, shown, {options.method: learned}, states=matters)
    return choice.scores[options.method]


def _can_leave_one_out(problem: Problem, shown: Demonstrations) -> bool:
    """Whether two trajectories have steps in which there was something to decide."""
    decides = ~np.asarray(absorbing_states(problem.mdp))
    if problem.terminal is not None:
        decides &= ~problem.terminal
    counts = np.asarray(shown.mask) & decides[np.asarray(shown.states)]
    return int((counts.any(axis=1) & ~np.asarray(shown.is_answer)).sum()) >= 2


def _is_enough(standing: dict[str, Any], options) -> bool:
    loss, likelihood = options.until_loss, options.until_likelihood
    return (loss is not None and standing["loss_per_step"] <= loss) or (
        likelihood is not None and standing["likelihood"] >= likelihood
    )


def _in_words(standing: dict[str, Any]) -> str:
    words = {
        "states": "{states} states known, {answers} answers",
        "likelihood": "log-likelihood of a step left out {likelihood:.4f}",
        "loss_per_step": "loss per step <= {loss_per_step:.4g}",
        "value": "value {value:.5g}, optimal {optimal_value:.5g}",
    }
    return "; ".join(text.format(**standing) for name, text in words.items() if name in standing)
