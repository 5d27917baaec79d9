"""Fit scans: `python -m fitting SCAN... [--control MESH] -o OUT`; without arguments, an example."""

import sys

from .command.main import main

if __name__ == "__main__":
    sys.exit(main())
