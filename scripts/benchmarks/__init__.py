"""The sections of `bench.py`, by topic."""
