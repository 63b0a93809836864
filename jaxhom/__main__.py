"""Entry point of `python -m jaxhom`."""

import sys

from jaxhom import interrupts


def _run() -> int:
    try:
        from jaxhom.cli import main

        interrupts.watch()
        return main()
    except KeyboardInterrupt:  # as late as in `main`'s own last lines
        return interrupts.INTERRUPTED


if __name__ == "__main__":
    sys.stdout.reconfigure(errors="backslashreplace")  # a name that the terminal cannot show is no reason to stop
    sys.stdout = interrupts.UntilClosed(sys.stdout)
    interrupts.leave(_run())
