"""The command line as a whole, and its exit codes: 0 done, 2 wrong input (one line says what), 130 interrupted."""

import argparse
import sys
import warnings
from collections.abc import Sequence

import jax

from jaxhom import checks, interrupts, programs
from jaxhom.cli import ask, evaluate, explain, learn, main_job, plot
from jaxhom.cli.options import Parser, add_cache_option

_DESCRIPTION = """\
Apprenticeship learning from a few demonstrations via soft local homomorphisms.

Without a command: learns policies on the paper's gridworld and racetrack (a), prints one table of values and
certificates, and saves a picture of the policies (with matplotlib installed).
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line and returns its exit code."""
    options = make_parser().parse_args(arguments)
    jax.config.update("jax_enable_x64", True)
    if not getattr(options, "no_cache", False):
        programs.keep_programs()
    try:
        with warnings.catch_warnings():  # what a command decides about warnings ends with it
            options.run(options)
    except (Exception, KeyboardInterrupt) as error:
        if interrupts.is_interruption(error):
            return interrupts.say(*error.args * isinstance(error, KeyboardInterrupt))
        if not isinstance(error, OSError | ValueError | ImportError):
            raise
        message = _of_file(error) if isinstance(error, OSError) else checks.first_line(error)
        print(f"jaxhom: error: {message}", file=sys.stderr)
        return 2
    return 0


def make_parser() -> Parser:
    """The parser of all commands; what it returns has a function `run` that takes it."""
    parser = Parser(
        prog="python -m jaxhom", description=_DESCRIPTION, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    main_job.add_options(parser)
    add_cache_option(parser)
    commands = parser.add_subparsers(dest="command", title="commands", metavar="{learn,ask,evaluate,explain,plot}")
    for command in (learn, ask, evaluate, explain, plot):
        command.add_parser(commands)
    return parser


def _of_file(error: OSError) -> str:
    """`name: what happened`, without the number."""
    if error.filename is None or error.strerror is None:
        return checks.first_line(error)
    return f"{error.filename or repr(error.filename)}: {error.strerror}"
