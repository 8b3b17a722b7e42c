"""Public names: imported when they are first asked for (PEP 562)."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

# An import in the block `if TYPE_CHECKING:` at the top of a package, as the formatter writes it.
_IMPORT = re.compile(r"^    from (cadalign[\w.]*) import (?:\(([^)]*)\)|(.*))", re.M)
_NAME = re.compile(r"(\w+)(?: as (\w+))?")


def lazy_names(package: str) -> Callable[[str], Any]:
    """The ``__getattr__`` of a package: imports what its block ``if TYPE_CHECKING`` imports.

    The package's ``dir`` lists its ``__all__``.

    That block is the only list: type checkers and editors read it as it stands. A name is imported
    when it is first asked for, and so are the package's modules, so that a program does not wait
    for what it does not use.

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
