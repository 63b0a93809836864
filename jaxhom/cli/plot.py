"""`python -m jaxhom plot`: pictures of saved policies and demonstrations."""

from __future__ import annotations

import argparse
import types
from typing import Any

from jaxhom import checks
from jaxhom.cli import pictures
from jaxhom.cli.options import MODEL_HELP, Parser, add_command, add_model_options
from jaxhom.cli.results import save_figure
from jaxhom.cli.sources import Problem, load_demonstrations_of, load_policy_of, load_problem
from jaxhom.domains.racetrack import Racetrack
from jaxhom.interop.archives import FileError
from jaxhom.interop.files import load_arrays

_EXAMPLES = """\
examples:
  python -m jaxhom plot policy lake/policy.npz --env FrozenLake-v1 map_name=8x8 --output policy.png
  python -m jaxhom plot generalization track/policy.npz --mdp a --speed 0 1 --output radius.svg
  python -m jaxhom plot trajectories drives.csv --mdp my.track --output drives.pdf

  policy           arrows on a map, or an image of its probabilities
  occupancy        how often the policy visits each cell or state
  generalization   how far advice came from and how many states voted; of files written by `learn`
  trajectories     of demonstrations, .npz or .csv

"""


def add_parser(commands: Any) -> None:
    """Adds the command."""
    summary = "draw a saved policy, its occupancy, how it was generalized, or trajectories"
    parser: Parser = add_command(commands, "plot", run, summary=summary, epilog=_EXAMPLES + MODEL_HELP)
    parser.add_argument("kind", choices=pictures.KINDS, help="what to draw")
    parser.add_argument("file", metavar="FILE", help="a policy's .npz file, or demonstrations")
    add_model_options(parser)
    group = parser.add_argument_group("picture")
    group.add_argument("--output", required=True, metavar="FILE.png", help="the name's ending says the format")
    group.add_argument(
        "--speed",
        nargs=2,
        type=int,
        metavar=("DOWN", "RIGHT"),
        help="racetracks: of the cars that are shown (default: standing ones for a policy, all for a generalization)",
    )


def run(options: argparse.Namespace) -> None:
    """Reads, draws and writes.

    Raises:
      ValueError: on wrong input.
      ImportError: without matplotlib.
    """
    pictures.load_plotting()
    problem = load_problem(options)
    if options.speed and not (isinstance(problem.domain, Racetrack) and options.kind in ("policy", "generalization")):
        raise ValueError("--speed belongs to policies and generalizations on racetracks")
    save_figure(options.output, _figure(problem, options))
    print(f"Written: {options.output}")


def _figure(problem: Problem, options):
    path = options.file
    if options.kind == "trajectories":
        return pictures.draw_trajectories(problem, load_demonstrations_of(problem, path, "warn")[0])
    policy = load_policy_of(problem, path)
    if options.kind == "occupancy":
        return pictures.draw_occupancy(problem, policy)
    known = load_arrays(path, "visited", "radius", "support")
    speed = tuple(options.speed) if options.speed else None
    try:
        for name, array in known.items():
            checks.require_shape(name, array, f"({len(policy)},)", array.shape == (len(policy),))
        if options.kind == "policy":
            return pictures.draw_policy(problem, policy, known.get("visited"), speed or (0, 0))
        for name in ("visited", "radius", "support"):
            if name not in known:
                raise ValueError(f"array {name!r} is missing: it is no generalization written by `learn`")
        return pictures.draw_generalization(problem, types.SimpleNamespace(policy=policy, **known), speed)
    except ValueError as error:
        raise FileError(f"{path}: {error}") from None
