"""The sections of `bench.py`, by topic."""

import sys
from pathlib import Path

# What drives the annotator's page is the tests' support.
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests"))
