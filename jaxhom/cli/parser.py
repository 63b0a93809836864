"""Options of the command line, and its exit codes: 0 done, 2 wrong input (one line says what), 130 interrupted."""

import argparse
import sys
from collections.abc import Sequence

import jax

from jaxhom.cli import learn, main_job
from jaxhom.interop import files

_DESCRIPTION = """\
Apprenticeship learning from a few demonstrations via soft local homomorphisms.

Without a command: learns policies on the paper's gridworld and racetrack (a), prints one table of values and
certificates, and saves a picture of the policies (with matplotlib installed).
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line and returns its exit code."""
    options = _parser().parse_args(arguments)
    jax.config.update("jax_enable_x64", True)
    try:
        if options.command == "learn":
            learn.run(options)
        else:
            main_job.run(
                size=options.grid,
                regions=options.regions,
                demonstrations=options.demonstrations,
                sets=options.sets,
                seed=options.seed,
                picture=options.picture or None,
            )
    except (ValueError, OSError) as error:
        print(f"jaxhom: error: {str(error).splitlines()[0]}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("jaxhom: interrupted", file=sys.stderr)
        return 130
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m jaxhom", description=_DESCRIPTION, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--grid", type=_count, default=16, help="rows of the gridworld; 0 for none (default 16)")
    parser.add_argument("--regions", type=_count, default=64, help="regions of the gridworld (default 64)")
    parser.add_argument(
        "--demonstrations", type=_positive, nargs="+", default=[2, 5, 10], help="on the racetrack (default 2 5 10)"
    )
    parser.add_argument("--sets", type=_positive, default=20, help="sets of demonstrations (default 20)")
    parser.add_argument("--seed", type=_count, default=0, help="of the random key (default 0)")
    parser.add_argument(
        "--picture", default="jaxhom_policies.png", help="file of the picture; '' for none (default %(default)s)"
    )
    _add_learn(parser.add_subparsers(dest="command", title="commands", metavar="{learn}"))
    return parser


def _add_learn(commands) -> None:
    formats = files.__doc__.partition("\n\n")[2]
    parser = commands.add_parser(
        "learn",
        help="learn a policy from a model and demonstrations of your own",
        description="Learns a policy for every state of a model from demonstrations.",
        epilog=f"files:\n  NumPy .npz archives (numpy.savez) of plain arrays\n\n{formats}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--mdp", required=True, metavar="MODEL.npz", help="the model")
    parser.add_argument("--demonstrations", required=True, metavar="DEMOS.npz", help="the expert's trajectories")
    parser.add_argument("--output", required=True, metavar="POLICY.npz", help="where to write the policy")
    parser.add_argument("--method", choices=learn.METHODS, default=learn.METHODS[0], help="default: %(default)s")
    parser.add_argument("--lpal", action="store_true", help="feed the policy's feature expectations to LPAL")
    parser.add_argument("--distance", type=_positive, default=1, help="radius d of the local models (default 1)")
    parser.add_argument("--threshold", type=float, default=0.0, help="largest error epsilon (default 0)")
    parser.add_argument("--printed", action="store_true", help="the relation as printed, without the anchor")
    parser.add_argument("--mutual", action="store_true", help="require similarity in both directions")


def _count(text: str) -> int:
    number = int(text)
    if number < 0:
        raise argparse.ArgumentTypeError(f"must not be negative, got {text}")
    return number


def _positive(text: str) -> int:
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1, got {text}")
    return number
