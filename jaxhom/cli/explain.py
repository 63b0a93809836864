"""`python -m jaxhom explain`: where a state's policy comes from."""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

from jaxhom.cli.methods import GENERALIZATIONS, add_method_options, check_method, generalize
from jaxhom.cli.options import MODEL_HELP, add_command, add_demonstration_options, add_model_options
from jaxhom.cli.sources import Problem, load_problem, load_trajectories
from jaxhom.cli.statuses import remarks, warn
from jaxhom.generalization.result import Generalization

_EXAMPLES = """\
examples:
  python -m jaxhom explain 4,1 --env FrozenLake-v1 map_name=8x8 --demonstrations lake/demonstrations.npz
  python -m jaxhom explain 3,5 7,3,0,1 --mdp a --expert 2

A state is a number; on maps also row,column, and on racetracks row,column,down,right with the car's speed. Model,
demonstrations and method are those that were learned from: nothing is stored of how a policy came about.

"""


def add_parser(commands: Any) -> None:
    """Adds the command."""
    summary = "say where the policy of a state comes from: who voted, through which map, with what error"
    parser = add_command(commands, "explain", run, summary=summary, epilog=_EXAMPLES + MODEL_HELP)
    parser.add_argument("states", nargs="+", metavar="STATE", help="as described below")
    add_model_options(parser)
    add_demonstration_options(parser)
    add_method_options(parser, GENERALIZATIONS)


def run(options: argparse.Namespace) -> None:
    """Reads, generalizes and prints.

    Raises:
      ValueError: on wrong input.
    """
    problem = load_problem(options)
    check_method(problem, options)
    states = [problem.state_of(text) for text in options.states]
    demonstrations, _ = load_trajectories(problem, options)
    asked = np.isin(np.arange(problem.mdp.num_states), states)
    general, _ = generalize(problem, demonstrations, options, asked)
    print("\n\n".join(_explanation(problem, general, state) for state in states))
    # What stayed undecided of a state is in its explanation.
    sampled = remarks("optimal policy", problem.plan) if options.expert else []
    warn(sampled + remarks("generalization", general))


def _explanation(problem: Problem, general: Generalization, state: int) -> str:
    if problem.terminal is not None and problem.terminal[state]:
        return f"State {state}: episodes end here, and no action matters."
    return str(general.explain(state))
