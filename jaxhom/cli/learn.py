"""`python -m jaxhom learn`: a policy for every state of a model, from demonstrations.

Stages follow each other, and each writes what it found before the next begins: demonstrations, the generalized
policy, LPAL's, pictures. An interruption loses the stage that is under way and nothing else.
"""

from __future__ import annotations

import argparse
import dataclasses
from typing import Any

import jax.numpy as jnp

from jaxhom.apprenticeship.lpal import FORMER_METHODS, lpal
from jaxhom.apprenticeship.lpal import METHODS as LPAL_METHODS
from jaxhom.cli import pictures, results
from jaxhom.cli.methods import METHODS, add_method_options, check_method, generalize, wants_progress
from jaxhom.cli.options import (
    MODEL_HELP,
    add_command,
    add_demonstration_options,
    add_model_options,
    add_result_options,
)
from jaxhom.cli.report import Report
from jaxhom.cli.results import Results
from jaxhom.cli.sources import Problem, load_problem, load_trajectories
from jaxhom.interop import files
from jaxhom.models.demonstrations import empirical_policy, monte_carlo_feature_expectations
from jaxhom.planning.occupancy import feature_expectations

_EXAMPLES = """\
examples:
  python -m jaxhom learn --env FrozenLake-v1 map_name=8x8 --expert 2 --output lake
  python -m jaxhom learn --mdp a --expert 2 --lpal --output track
  python -m jaxhom learn --mdp my.track --demonstrations drives.csv --output track
  python -m jaxhom learn --mdp model.npz --demonstrations demos.npz --output policy.npz

"""
_OUTPUT = """\
--output is a folder, or the name of an .npz file for the policy alone:
{}

demonstrations in .csv files: one step a line, the first line names the columns episode, state, action

.npz files are NumPy archives (numpy.savez) of plain arrays:

{}"""
_LPAL_METHODS = tuple(LPAL_METHODS)


def add_parser(commands: Any) -> None:
    """Adds the command."""
    formats = str(files.__doc__).partition("\n\n")[2].partition("\n\nAnything")[0]
    layout = str(results.__doc__).partition("\n\n")[2].rstrip()
    epilog = _EXAMPLES + MODEL_HELP + "\n" + _OUTPUT.format(layout, formats)
    summary = "learn a policy for every state of a model from demonstrations"
    parser = add_command(commands, "learn", run, summary=summary, epilog=epilog)
    add_model_options(parser)
    add_demonstration_options(parser)
    add_method_options(parser)
    group = parser.add_argument_group("apprenticeship learning")
    group.add_argument(
        "--lpal",
        nargs="?",
        const=_LPAL_METHODS[0],
        choices=(*_LPAL_METHODS, *FORMER_METHODS),
        metavar="SOLVER",
        help="feed the policy's feature expectations to LPAL; solved by columns, interior_point, pdhg, or by the "
        "quicker of the first two: auto (default)",
    )
    group.add_argument(
        "--lpal-tolerance", type=float, metavar="T", help="largest certified gap of the margin to settle for"
    )
    group.add_argument(
        "--features", choices=("states",), help="for models without features: an indicator of every state"
    )
    add_result_options(parser)


def run(options: argparse.Namespace) -> None:
    """Reads, learns, prints and writes.

    Raises:
      ValueError: on wrong input, before anything is computed.
      KeyboardInterrupt: with the files that were written as its message.
    """
    problem = _with_features(load_problem(options), options)
    check_method(problem, options)
    demonstrations, origin = load_trajectories(problem, options)
    output = Results(options.output)
    with output.kept():
        _learn(problem, demonstrations, origin, options, output)


def _learn(problem: Problem, demonstrations, origin: str, options, output: Results) -> None:
    output.demonstrations(demonstrations)
    visited, _ = empirical_policy(problem.mdp, demonstrations)
    report = Report(problem, demonstrations, origin, visited, options, output)
    title, general, policy = METHODS[options.method].title, None, None
    known: dict[str, Any] = {"visited": visited}
    policies: dict[str, Any] = {}
    if METHODS[options.method].function:
        with report.timed("seconds_generalizing"):
            general, numbers = generalize(problem, demonstrations, options)
        policy = policies[title] = general.policy
        known |= {"radius": general.radius, "support": general.support, **numbers}
        output.policy(policy, is_final=not _wants_lpal(options), **known)
        report.generalization(general, numbers)
    if _wants_lpal(options):
        with report.timed("seconds_lpal"):
            solution = _apprentice(problem, demonstrations, policy, options)
        policy = policies[f"{title} + LPAL"] = solution.policy
        known |= {"margin": solution.margin, "margin_bound": solution.margin_bound}
        output.policy(policy, is_final=True, **known)
        report.lpal(solution)
    if problem.reward is not None:
        report.values({"optimal": problem.plan.policy, **policies})
    if pictures.are_wanted(output, options):
        _draw(problem, demonstrations, general, policy, visited, output)
    report.finish()


def _wants_lpal(options) -> bool:
    return options.lpal is not None or METHODS[options.method].function is None


def _with_features(problem: Problem, options) -> Problem:
    """The problem, with features if LPAL needs some and `--features` asks for them; checks LPAL's options."""
    if not _wants_lpal(options):
        for name in ("lpal_tolerance", "features"):
            if getattr(options, name) is not None:
                raise ValueError(f"--{name.replace('_', '-')} belongs to --lpal and to --method monte-carlo")
        return problem
    if options.lpal_tolerance is not None and not options.lpal_tolerance > 0.0:
        raise ValueError(f"--lpal-tolerance must be positive, got {options.lpal_tolerance}")
    mdp = problem.mdp
    if not options.features:
        if not mdp.num_features:
            raise ValueError(f"{problem.name}: LPAL needs features, and the model has none; try --features states")
        return problem
    if mdp.num_features:
        raise ValueError(f"--features: {problem.name} has features of its own")
    eye = jnp.eye(mdp.num_states, dtype=mdp.dtype)
    features = jnp.broadcast_to(eye[:, None], (mdp.num_states, mdp.num_actions, mdp.num_states))
    return dataclasses.replace(problem, mdp=mdp.replace(features=features))


def _apprentice(problem: Problem, demonstrations, policy, options):
    """LPAL's solution, for the expectations of the generalized policy or those of the demonstrations alone."""
    if policy is None:
        expectations = monte_carlo_feature_expectations(problem.mdp, demonstrations)
    else:
        expectations = feature_expectations(problem.mdp, policy)
    return lpal(
        problem.mdp,
        expectations,
        initial_policy=policy,
        tolerance=options.lpal_tolerance,
        method=options.lpal or _LPAL_METHODS[0],
        progress=wants_progress(options),
    )


def _draw(problem: Problem, demonstrations, general, policy, visited, output: Results) -> None:
    output.picture("trajectories", pictures.draw_trajectories(problem, demonstrations))
    if general is not None:
        output.picture("generalization", pictures.draw_generalization(problem, general))
    output.picture("policy", pictures.draw_policy(problem, policy, visited))
    output.picture("occupancy", pictures.draw_occupancy(problem, policy))
