"""`python -m jaxhom evaluate`: what saved policies achieve, exactly and in sampled trials."""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

from jaxhom.cli.measures import agreements, agreements_table, measure, measure_by_sampling, measures_table
from jaxhom.cli.options import MODEL_HELP, add_command, add_model_options, count, positive
from jaxhom.cli.results import write_json
from jaxhom.cli.sources import load_policy_of, load_problem
from jaxhom.cli.statuses import remarks, warn
from jaxhom.cli.tables import format_table
from jaxhom.planning.occupancy import feature_expectations

_EXAMPLES = """\
examples:
  python -m jaxhom evaluate lake/policy.npz --env FrozenLake-v1 map_name=8x8
  python -m jaxhom evaluate track/generalization.npz track/policy.npz --mdp a --trials 1000 --against expert.npz

The optimal policy is shown beside them where a reward is known: that of an environment or a racetrack, or the array
`reward` of a model's file.

"""
_MAX_FEATURES = 12  # that are printed


def add_parser(commands: Any) -> None:
    """Adds the command."""
    summary = "evaluate saved policies on a model, exactly and by sampling"
    parser = add_command(commands, "evaluate", run, summary=summary, epilog=_EXAMPLES + MODEL_HELP)
    parser.add_argument("policies", nargs="+", metavar="POLICY.npz", help="written by `learn`, or an array `policy`")
    add_model_options(parser)
    group = parser.add_argument_group("evaluation")
    group.add_argument("--against", metavar="POLICY.npz", help="a policy to agree with")
    group.add_argument(
        "--steps",
        type=positive,
        metavar="H",
        help="of a trial (default: the environment's limit, 30 on racetracks, 100 else)",
    )
    group.add_argument(
        "--trials", type=count, default=1000, metavar="N", help="sampled ones (default 1000; 0 for none, or from 2)"
    )
    group.add_argument("--seed", type=count, default=0, metavar="N", help="of the sampling (default 0)")
    group.add_argument("--output", metavar="FILE.json", help="also write the numbers there")


def run(options: argparse.Namespace) -> None:
    """Reads, evaluates and prints.

    Raises:
      ValueError: on wrong input.
    """
    if options.trials == 1:
        raise ValueError("--trials must be 0 or at least 2: one trial has no standard error")
    if options.output and not options.output.lower().endswith(".json"):
        raise ValueError(f"--output {options.output}: the numbers are written to a .json file")
    problem = load_problem(options)
    saved = {path: load_policy_of(problem, path) for path in options.policies}
    others = {options.against: load_policy_of(problem, options.against)} if options.against else {}
    optimal = {} if problem.reward is None else {"optimal": problem.plan.policy}
    trial = options.steps or problem.trial
    policies: dict[str, Any] = {**optimal, **others, **saved}
    report: dict[str, Any] = {"model": problem.name, "discount": float(problem.mdp.discount), "steps_of_a_trial": trial}
    exact = measure(problem, policies, trial)
    report["exact"] = [row.as_json() for row in exact]
    _print(f"exact, trials of at most {trial} steps", exact)
    if optimal:
        warn(remarks("optimal policy", problem.plan))
    if options.trials:
        sampled = measure_by_sampling(problem, policies, trial, options.trials, options.seed)
        report["sampled"] = [row.as_json() for row in sampled]
        _print(f"sampled, {options.trials} trials (seed {options.seed}), with standard errors", sampled)
    if others or optimal:
        report["agreement"] = agreements(problem, saved, {**optimal, **others})
        print(f"probability of the same action\n{agreements_table(report['agreement'])}\n", flush=True)
    expectations = {name: np.asarray(feature_expectations(problem.mdp, policy)) for name, policy in policies.items()}
    report["feature_expectations"] = {name: values.tolist() for name, values in expectations.items()}
    if 0 < problem.mdp.num_features <= _MAX_FEATURES:
        _print_expectations(expectations)
    if options.output:
        write_json(options.output, report)
        print(f"\nWritten: {options.output}")


def _print(title: str, rows) -> None:
    if rows[0].numbers:
        print(f"{title}\n{measures_table(rows)}\n", flush=True)


def _print_expectations(expectations: dict) -> None:
    header = ("policy", *(f"feature {i}" for i in range(len(next(iter(expectations.values()))))))
    rows = [(name, *(f"{value:.5g}" for value in values)) for name, values in expectations.items()]
    print(f"discounted feature expectations\n{format_table(header, rows)}", flush=True)
