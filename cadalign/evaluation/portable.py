"""Functions that travel to worker processes and clusters, wherever they were written."""

from __future__ import annotations

import inspect
import pickle
import sysconfig
from collections.abc import Callable
from functools import lru_cache, partial
from pathlib import Path
from types import ModuleType
from typing import Any

from cadalign.errors import InputError, quote
from cadalign.evaluation.runs.work import fingerprint


class Portable:
    """A function that is pickled by its code, unless it is of an installed package.

    Workers need not be able to import the script, notebook or test that it was written in. They
    unpickle it at its first call, so that what is missing there is an error of that call.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function: Callable[..., Any] | None = function
        self._pickled: bytes | None = None

    def __call__(self, *args: Any, **options: Any) -> Any:
        """Call the function."""
        return self.function(*args, **options)

    @property
    def function(self) -> Callable[..., Any]:
        """The function itself."""
        if self._function is None:
            assert self._pickled is not None
            self._function = _unpickled(self._pickled)
        return self._function

    def __getstate__(self) -> bytes:
        if self._pickled is None:
            self._pickled = _pickled(self.function)
        return self._pickled

    def __setstate__(self, state: bytes) -> None:
        self._function, self._pickled = None, state


# One object for all chunks of a process: what the function keeps at hand is not made anew.
@lru_cache(maxsize=64)
def _unpickled(pickled: bytes) -> Callable[..., Any]:
    function: Callable[..., Any] = pickle.loads(pickled)
    return function


def _pickled(function: Callable[..., Any]) -> bytes:
    import cloudpickle

    module = module_of(function)
    by_value = module is not None and not is_installed(module)
    try:
        if by_value:
            cloudpickle.register_pickle_by_value(module)
        try:
            return bytes(cloudpickle.dumps(function))
        finally:
            if by_value:
                cloudpickle.unregister_pickle_by_value(module)
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"[:200]
        raise InputError(
            f"{quote(name_of(function))} cannot be sent to worker processes ({reason})",
            fix="let the function make what it needs, or do without processes (workers=0)",
        ) from None


def module_of(function: Callable[..., Any]) -> ModuleType | None:
    """The module that a function was written in, if it is known."""
    return inspect.getmodule(_innermost(function))


def is_installed(module: ModuleType) -> bool:
    """True for modules of this package, of installed ones, and of Python itself."""
    if module.__name__.partition(".")[0] == __name__.partition(".")[0]:
        return True
    file = getattr(module, "__file__", None)
    if file is None:
        return module.__name__ != "__main__"
    places = (sysconfig.get_path(name) for name in ("stdlib", "purelib", "platlib"))
    return any(Path(file).is_relative_to(place) for place in places)


def name_of(function: Callable[..., Any]) -> str:
    """The name of a function, that of its class for a callable object."""
    function = _innermost(function)
    return str(getattr(function, "__name__", type(function).__name__))


def _innermost(function: Any) -> Any:
    """The function itself of one whose arguments are bound by functools.partial."""
    while isinstance(function, partial):
        function = function.func
    return function


def names_of(values: Any, register: Callable[[str, Any], object], *, where: str) -> tuple[str, ...]:
    """Names of methods or metrics, of which functions are registered by their own names.

    Raises InputError if a function has no name of its own, or two have the same.
    """
    names: list[str] = []
    functions: dict[str, Any] = {}
    for each in [values] if isinstance(values, str) or callable(values) else values:
        if not callable(each):
            names.append(each)
            continue
        name = name_of(each)
        what = f"{quote(name)} is the name of more than one function"
        if not name.isidentifier():
            what = f"a function that is called {name} has no name for tables"
        if not name.isidentifier() or functions.get(name, each) is not each:
            fix = "register it by a name, and give that"
            raise InputError(what, where=where, fix=fix)
        functions[name] = each
        register(name, each)
        names.append(name)
    return tuple(names)


def code_hash(function: Callable[..., Any]) -> str:
    """Hash of the code of the module that a function is of.

    In notebooks and scripts, in which other things change, it is that of the function alone.
    """
    module = module_of(function)
    is_script = module is None or module.__name__ == "__main__"
    code: Any = _innermost(function) if is_script else module
    try:
        text = inspect.getsource(code)
    except (OSError, TypeError):
        text = repr(getattr(getattr(function, "__code__", None), "co_code", name_of(function)))
    return fingerprint(text)
