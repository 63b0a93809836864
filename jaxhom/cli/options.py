"""Options that several commands share, and the kinds of values that they take."""

from __future__ import annotations

import argparse
import ast
import json
from collections.abc import Callable
from typing import Any, NoReturn

MODEL_HELP = """\
models:
  --env ID [NAME=VALUE ...]   a Gymnasium environment with a transition table, and options of its constructor: true,
                              false, numbers, texts, lists; needs pip install '.[interop]'
  --mdp a, --mdp b            the racetracks that come with the library
  --mdp MAP.track             a racetrack, one letter per cell: X, #, o or @ wall, space, . or P road, S start, F or G
                              finish
  --mdp MODEL.npz             arrays of your own; see `python -m jaxhom learn --help` for their names
  --mdp MODEL.POMDP, .MDP     Cassandra's format, as if the state were seen
  --mdp MODEL.tra             PRISM's explicit files of that name, .sta, .lab, .srew and .trew among them
  --mdp MODEL.csv, .tsv       columns state, action, next_state, probability, reward
  --mdp MAP.map, .gw          a grid map of the moving-AI benchmarks; a gridworld
  --mdp ROADS.graphml, .edgelist, .edges   a network: links are states, exits actions
  Texts may be compressed (.gz). What was ignored or mended in a file is told on stderr.
"""


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, like all others of the command line."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"jaxhom: error: {' '.join(message.split())} (see {self.prog} --help)\n")


def add_command(
    commands: Any, name: str, run: Callable[[argparse.Namespace], None], *, summary: str, epilog: str
) -> Parser:
    """A subcommand, whose epilog keeps its line breaks."""
    parser = commands.add_parser(
        name,
        help=summary,
        description=summary[0].upper() + summary[1:] + ".",
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)
    add_cache_option(parser)
    return parser


def add_cache_option(parser: Parser) -> None:
    """Before a command or after it."""
    parser.add_argument(
        "--no-cache",
        action="store_true",
        default=argparse.SUPPRESS,
        help="neither read nor keep compiled programs (JAXHOM_CACHE=off does the same; a folder there moves them)",
    )


def add_model_options(parser: Parser) -> None:
    """Where the model comes from."""
    group = parser.add_argument_group("model (see below)")
    source = group.add_mutually_exclusive_group(required=True)
    source.add_argument("--env", nargs="+", metavar=("ID", "NAME=VALUE"), help="a Gymnasium environment")
    source.add_argument("--mdp", metavar="FILE", help="a model's file, a racetrack's map, or a, b")
    group.add_argument(
        "--discount",
        type=float,
        metavar="G",
        help="where the source has none (default 0.99 for those that cannot have one); for .POMDP files in any case",
    )
    group.add_argument(
        "--end-state",
        action="store_true",
        help="environments: episodes end in one further state, rather than in absorbing ones",
    )


def add_demonstration_options(parser: Parser) -> None:
    """Where the trajectories come from."""
    group = parser.add_argument_group("demonstrations")
    source = group.add_mutually_exclusive_group(required=True)
    source.add_argument("--demonstrations", metavar="PATH", help="the expert's trajectories: .npz, .csv and more")
    source.add_argument(
        "--expert", type=positive, metavar="N", help="sample N from the optimal policy, if the model has a reward"
    )
    group.add_argument(
        "--steps",
        type=positive,
        metavar="H",
        help="length of sampled ones; shorter where the episode ends (default: an environment's limit, 20 on "
        "racetracks, 100 elsewhere)",
    )
    group.add_argument("--seed", type=count, default=0, metavar="N", help="of the sampling (default 0)")
    group.add_argument(
        "--impossible",
        choices=("refuse", "warn", "ignore"),
        default="warn",
        help="what to do about demonstrated steps that the model gives probability 0 (default warn)",
    )
    group.add_argument(
        "--ambiguous",
        choices=("hide", "likeliest", "refuse"),
        default="hide",
        help="trajectories without actions: what to do about steps that several actions could have been (default hide)",
    )


def add_result_options(parser: Parser) -> None:
    """Where results go."""
    group = parser.add_argument_group("results")
    group.add_argument("--output", required=True, metavar="PATH", help="folder (see `learn`), or policy .npz")
    group.add_argument("--no-pictures", action="store_true", help="write none")


def positive(text: str) -> int:
    """A whole number from 1 on."""
    number = count(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1, got {text}")
    return number


def count(text: str) -> int:
    """A whole number from 0 on."""
    try:
        number = int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be a whole number, got {text!r}") from None
    if number < 0:
        raise argparse.ArgumentTypeError(f"must not be negative, got {text}")
    if number >= 2**63:
        raise argparse.ArgumentTypeError(f"must be below 2^63, got {text}")
    return number


_WORDS = {"true": True, "yes": True, "on": True, "false": False, "no": False, "off": False, "none": None, "null": None}


def environment_options(words: list[str]) -> dict[str, Any]:
    """`["is_slippery=false", "map_name=8x8"]` -> {"is_slippery": False, "map_name": "8x8"}.

    Raises:
      ValueError: if a word is no NAME=VALUE, a name comes twice, or a value begins like a list and is none.
    """
    options: dict[str, Any] = {}
    for word in words:
        name, equals, text = word.partition("=")
        if not equals or not name.isidentifier():
            raise ValueError(f"--env: expected NAME=VALUE after the id, got {word!r}")
        if name in options:
            raise ValueError(f"--env: {name} is given twice")
        options[name] = _option_value(name, text.strip())
    return options


def _option_value(name: str, text: str):
    """A truth value (true, yes, on, false, no, off in any case), JSON, a Python literal such as a tuple, or text."""
    word = text.lower()
    if word in _WORDS:
        return _WORDS[word]
    for read in (json.loads, ast.literal_eval):
        try:
            return read(text)
        except (ValueError, SyntaxError):
            continue
    if text.startswith(("[", "(", "{", '"', "'")):
        example = """'desc=["SF", "FG"]'"""
        raise ValueError(f"--env: {name} is neither JSON nor a Python value, got {text}; a list of texts is {example}")
    return text
