"""`python -m cadalign`: the command line, also without the command on the path."""

import sys

from cadalign.cli import main

if __name__ == "__main__":  # child processes import this module without running it
    sys.exit(main())
