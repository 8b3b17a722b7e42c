"""Drawing parts of a frame side by side."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

_MAX_THREADS = 8

_Part = TypeVar("_Part")


def in_threads(draw: Callable[[_Part], None], parts: Sequence[_Part]) -> None:
    """Draw parts of a frame side by side; embree and NumPy let go of the interpreter lock."""
    if len(parts) == 1:
        draw(parts[0])
        return
    with ThreadPoolExecutor(min(os.cpu_count() or 1, _MAX_THREADS)) as pool:
        # Asking for the results raises what a part has raised.
        list(pool.map(draw, parts))
