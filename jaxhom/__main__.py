"""Entry point of `python -m jaxhom`."""

import sys


def _run() -> int:
    try:
        from jaxhom.cli import main

        return main()
    except KeyboardInterrupt:  # while the libraries are loading
        return 130


if __name__ == "__main__":
    sys.exit(_run())
