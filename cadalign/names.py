"""Public names: imported when they are first asked for (PEP 562), and earlier ones that go on."""

from __future__ import annotations

import functools
import re
import sys
import warnings
from collections.abc import Callable, Mapping
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar

from cadalign.errors import InputError

# An import in the block `if TYPE_CHECKING:` at the top of a package, as the formatter writes it.
_IMPORT = re.compile(r"^    from (cadalign[\w.]*) import (?:\(([^)]*)\)|(.*))", re.M)
_NAME = re.compile(r"(\w+)(?: as (\w+))?")

Renamed = TypeVar("Renamed", bound=Callable[..., Any])


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


def renamed(**earlier: str) -> Callable[[Renamed], Renamed]:
    """Accept earlier names of a function's keywords, or of a class's keywords and attributes.

    Each use of one raises a `DeprecationWarning` that names the present one.

    Parameters
    ----------
    **earlier : str
        The present name of each earlier one.

    Raises
    ------
    InputError
        By a call that gives both.

    Examples
    --------
    >>> @renamed(confidences="scores")
    ... def best(*, scores: list[float]) -> float:
    ...     return max(scores)
    >>> best(scores=[0.2, 0.9])
    0.9
    """

    def accepting(target: Renamed) -> Renamed:
        if not isinstance(target, type):
            return _accepting(target, target.__name__, earlier)
        target.__init__ = _accepting(target.__init__, target.__name__, earlier)  # type: ignore[misc]
        for name, present in earlier.items():
            setattr(target, name, _earlier_attribute(name, present))
        return target

    return accepting


def _accepting(function: Renamed, caller: str, earlier: Mapping[str, str]) -> Renamed:
    @functools.wraps(function)
    def accepting(*args: Any, **given: Any) -> Any:
        for name in earlier.keys() & given.keys():
            present = earlier[name]
            if present in given:
                raise InputError(f"given beside {present}, its present name", where=name)
            _note(f"{caller}({name}=)", f"{present}=")
            given[present] = given.pop(name)
        return function(*args, **given)

    return accepting  # type: ignore[return-value]


def _earlier_attribute(name: str, present: str) -> property:
    def attribute(owner: object) -> Any:
        _note(f"{type(owner).__name__}.{name}", present)
        return getattr(owner, present)

    return property(attribute, doc=f"The earlier name of ``{present}``.")


def _note(name: str, present: str) -> None:
    what = f"{name} is now called {present}; the earlier name goes with the next version"
    warnings.warn(what, DeprecationWarning, stacklevel=3)
