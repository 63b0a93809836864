"""Entry point of `python -m jaxhom`."""

import sys

from jaxhom.cli import main

if __name__ == "__main__":
    sys.exit(main())
