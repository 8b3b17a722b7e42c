"""Options from files and commands: lists become tuples, the rest stays."""

from __future__ import annotations

from pathlib import Path

from cadalign.evaluation.options import tuples


def test_lists_become_tuples() -> None:
    given = {"a": [1, 2], "b": range(2), "c": "ab", "d": Path("x"), "e": None, "f": 1.5, "g": len}
    kept = {name: given[name] for name in "cdefg"}
    assert tuples(given) == {"a": (1, 2), "b": (0, 1), **kept}
