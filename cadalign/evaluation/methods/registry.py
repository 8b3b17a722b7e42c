"""Registry of methods: built-in ones, and functions that users register.

A function of ``(points_3d, points_2d, camera)`` or of ``(model, views)`` that returns an alignment
or a result is a method once it is registered::

    from cadalign.evaluation import register_method

    register_method("mine", my_function)
    cadalign.evaluate("keypointnet", methods=["mine", "optimal"])

On the command line, ``--plugin my_module:my_function`` does the same. An installed package offers
its functions by entry points of the group ``cadalign.methods``.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

from cadalign.errors import InputError, quote, unknown
from cadalign.evaluation.methods.method import (
    POINTS,
    VIEWS,
    Method,
    Portable,
    RegisteredFunction,
    code_hash,
    fit_methods,
    module_of,
)

ENTRY_POINTS = "cadalign.methods"
"""Group of entry points whose functions are methods by the entry points' names."""
_EXAMPLES = "cadalign.evaluation.methods.pnp"
_REGISTERED: dict[str, Method] = {}


def register_method(
    name: str, function: Callable[..., Any], *, takes: Literal["points", "views"] | None = None
) -> Method:
    """Register a function as a method of evaluations.

    Parameters
    ----------
    name : str
        Its name among ``methods``, in tables and on pages. A function that was registered by this
        name before is replaced.
    function : callable
        Of ``(points_3d, points_2d, camera)``, (n, 3) float [model units], (n, 2) float [px] and
        `cadalign.Camera`; or of ``(model, views)``, as `cadalign.align` takes them. It returns a
        `cadalign.Alignment` or the result of `cadalign.fit` or `cadalign.align`, and raises where
        it finds none. A parameter ``sigma`` gets the standard deviation of the keypoints [px].
    takes : {"points", "views"}, optional
        The arguments, where the number of required ones, 3 or 2, does not determine them.

    Returns
    -------
    Method

    Raises
    ------
    InputError
        If the name is that of a built-in method, or there is no function.

    Examples
    --------
    >>> import cadalign
    >>> def without_noise_model(points_3d, points_2d, camera):
    ...     return cadalign.fit(points_3d, points_2d, camera, method="aepnp").alignment
    >>> register_method("linear", without_noise_model).name
    'linear'
    >>> table = cadalign.simulate("points", values=[8], runs=2, methods=["linear"], workers=0)
    >>> table.status.tolist()
    ['ok', 'ok']
    """
    if not isinstance(name, str) or not name.strip() or not name.isprintable():
        raise InputError(f"{quote(name)} is not a name", where="name")
    if name in fit_methods():
        fix = "choose another name"
        raise InputError(f"{quote(name)} is a built-in method", where="name", fix=fix)
    if not callable(function):
        raise InputError(f"{quote(function)} is not a function", where="function")
    if takes not in (None, POINTS, VIEWS):
        raise InputError(f"{quote(takes)} is neither points nor views", where="takes")
    required, takes_sigma = _parameters(function)
    kind = takes or (VIEWS if required == 2 else POINTS)
    solve = RegisteredFunction(Portable(function), kind, takes_sigma)
    method = Method(name, solve, is_general=True)
    _REGISTERED[name] = method
    return method


def _parameters(function: Callable[..., Any]) -> tuple[int, bool]:
    """Number of required arguments besides ``sigma``, and whether there is such a parameter."""
    try:
        parameters = inspect.signature(function).parameters
    except (TypeError, ValueError):  # of some functions that are not written in Python
        return 3, False
    positional = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    required = [
        name
        for name, each in parameters.items()
        if each.kind in positional and each.default is each.empty and name != "sigma"
    ]
    takes_sigma = "sigma" in parameters and parameters["sigma"].kind is not positional[0]
    return len(required), takes_sigma


def choose_methods(
    names: Iterable[str], own: Mapping[str, Method] | None = None
) -> tuple[Method, ...]:
    """The methods of these names, each once.

    ``own`` are a benchmark's own methods by name, by default those of `cadalign.fit`. Raises
    InputError if a method is unknown, or none is given.
    """
    table = fit_methods() if own is None else own
    checked = checked_names(names, table)
    return tuple(table[name] if name in table else registered_method(name) for name in checked)


def checked_names(names: Iterable[str], own: Collection[str] | None = None) -> tuple[str, ...]:
    """The names of methods, each once, if all are known; see `choose_methods`."""
    table = fit_methods() if own is None else own
    chosen = tuple(dict.fromkeys(names))
    for name in chosen:
        if name in table:
            if name in _REGISTERED:
                fix = "register the function by another name"
                what = f"{quote(name)} is a method of the experiment"
                raise InputError(what, where="methods", fix=fix)
        elif not is_registered(name):
            raise _unknown(name, known_names(table))
    if not chosen:
        fix = f"known are {', '.join(known_names(table))}"
        raise InputError("none is given", where="methods", fix=fix)
    return chosen


def known_names(own: Iterable[str]) -> list[str]:
    """Names of some methods, and of registered ones."""
    import_module(_EXAMPLES)
    return list(dict.fromkeys([*own, *_REGISTERED, *_entry_points()]))


def _unknown(name: object, known: Sequence[str]) -> InputError:
    if callable(name):
        fix = "give it a name by cadalign.evaluation.register_method, and that name"
        return InputError("a function is no name of a method", where="methods", fix=fix)
    return unknown("method", name, known, where="methods")


def is_registered(name: str) -> bool:
    """True for the name of a registered function, or of an entry point."""
    if name not in _REGISTERED:
        import_module(_EXAMPLES)
    return name in _REGISTERED or name in _entry_points()


def registered_method(name: str) -> Method:
    """The method that was registered by a name; one of an entry point is loaded.

    Raises InputError if there is none, or its package cannot be imported.
    """
    if not is_registered(name):
        raise _unknown(name, known_names(()))
    if name not in _REGISTERED:
        try:
            function = _entry_points()[name].load()
        except Exception as error:
            what = f"the entry point {quote(name)} cannot be loaded ({_said(error)})"
            raise InputError(what, where="methods", fix="reinstall its package") from None
        register_method(name, function)
    return _REGISTERED[name]


def _entry_points() -> dict[str, EntryPoint]:
    return {each.name: each for each in entry_points(group=ENTRY_POINTS)}


def load_plugin(text: str) -> str | None:
    """Import a module and register a function of it; returns the name, None for a module alone.

    ``text`` is ``module:function``, ``name=module:function``, or ``module``, which registers
    methods when it is imported. The module may be a file, ``path/to/module.py``; the working
    directory is searched first. Raises InputError if it cannot be imported, or has no such
    function.
    """
    alias, _, place = text.rpartition("=")
    module_name, _, name = place.rpartition(":") if ":" in place else (place, "", "")
    module = _imported(module_name)
    if not name:
        return None
    function: Any = module
    for part in name.split("."):
        function = getattr(function, part, None)
    if not callable(function):
        what = f"the module {quote(module_name)} has no function {quote(name)}"
        raise InputError(what, where="plugin", fix="give module:function")
    try:
        return register_method(alias or name.split(".")[-1], function).name
    except InputError as error:
        fix = "name it otherwise: name=module:function"
        raise InputError(error.what, where="plugin", fix=fix) from None


def _imported(name: str) -> ModuleType:
    try:
        if not name.endswith(".py"):
            if "" not in sys.path and str(Path.cwd()) not in sys.path:
                sys.path.insert(0, str(Path.cwd()))
            return import_module(name)
        # Not by its own name: a file may be called as a module that is there already.
        spec = spec_from_file_location(f"cadalign_plugin_{Path(name).stem}", name)
        assert spec is not None
        assert spec.loader is not None
        module = module_from_spec(spec)
        sys.modules[spec.name] = module
        spec.loader.exec_module(module)
    except Exception as error:
        what = f"{quote(name)} cannot be imported ({_said(error)})"
        raise InputError(what, where="plugin", fix="give module:function") from None
    return module


def _said(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"[:200]


def fingerprints(methods: Iterable[Method]) -> dict[str, Any]:
    """Hashes of the code of users' functions, for a run's configuration; empty without any.

    A run must not go on with other functions; see `code_hash`.
    """
    found = {}
    for method in methods:
        if not isinstance(method.solve, RegisteredFunction):
            continue
        function = method.solve.function.function
        module = module_of(function)
        if module is None or module.__name__ != _EXAMPLES:
            found[method.name] = code_hash(function)
    return {"functions": found} if found else {}
