"""Lazy import of public names (PEP 562)."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

# An import in a package's block `if TYPE_CHECKING:`, in the formatter's style.
_IMPORT = re.compile(r"^    from (cadalign[\w.]*) import (?:\(([^)]*)\)|(.*))", re.M)
_NAME = re.compile(r"(\w+)(?: as (\w+))?")


def lazy_names(package: str) -> Callable[[str], Any]:
    """Make the ``__getattr__`` of a package, which imports names and modules on first access.

    The names are those imported in the package's block ``if TYPE_CHECKING``, which type checkers
    and editors read, too. The package's ``dir`` lists its ``__all__``.

    Parameters
    ----------
    package : str
        The package's ``__name__``.
    """
    module = sys.modules[package]
    text = Path(str(module.__file__)).read_text(encoding="utf-8")
    origins = {
        alias or name: (origin, name)
        for origin, many, one in _IMPORT.findall(text)
        for name, alias in _NAME.findall(many or one)
    }

    module.__dict__["__dir__"] = lambda: sorted(module.__all__)

    def load(name: str) -> Any:
        origin, original = origins.get(name, (package, name))
        if origin != package:
            value = getattr(import_module(origin), original)
        elif not name.startswith("_") and find_spec(f"{package}.{name}"):
            value = import_module(f"{package}.{name}")
        else:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        setattr(module, name, value)
        return value

    return load
