"""Entry point of `python -m jaxhom`."""

import io
import sys

from jaxhom import interrupts


def _run() -> int:
    try:
        from jaxhom.cli.parser import main

        interrupts.watch()
        return main()
    except KeyboardInterrupt:  # while options are read, or as late as in the last lines of `main`
        return interrupts.say()


if __name__ == "__main__":
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # a name that the terminal cannot show is no reason to stop
    sys.stdout, sys.stderr = map(interrupts.UntilClosed, (sys.stdout, sys.stderr))
    interrupts.leave(_run())
