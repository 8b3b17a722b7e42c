"""`python -m cadalign`: the command line, where the command itself is not on the path."""

import sys

from cadalign.cli import main

if __name__ == "__main__":  # also loaded, without running it, by processes that this one starts
    sys.exit(main())
