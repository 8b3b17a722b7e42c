"""Methods, what they are given and may answer, those of `cadalign.fit`, and how users' travel.

A function of a user is sent to worker processes and clusters wherever it was written.
"""

from __future__ import annotations

import inspect
import pickle
import sysconfig
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial
from itertools import groupby
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.errors import CadalignError, InputError, quote
from cadalign.estimation.options import METHODS, RansacOptions
from cadalign.evaluation.runs.work import fingerprint
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera

if TYPE_CHECKING:
    from cadalign.estimation.model import Model
    from cadalign.estimation.result import Result
    from cadalign.estimation.view import View
    from cadalign.shapes.model import ShapeModel


LIMIT = "limit"
"""The pseudo-method of the Cramer-Rao bound; see `cadalign.evaluation.metrics.cramer_rao`."""
SHAPE = "shape"
"""The alignment of a category's learned shape, in runs that have one."""
POINTS, VIEWS = "points", "views"
"""Arguments of a registered function: arrays and a camera, or a model and its views."""


@dataclass(frozen=True, eq=False)
class MethodInput:
    """An instance as general methods are given it."""

    points_3d: FloatArray  # (n, 3), keypoints on the model [model units]
    points_2d: FloatArray  # (n, 2), their observations [px]
    camera: Camera
    sigma: float  # standard deviation of the observations that methods are given [px]
    bounds: FloatArray | None = None  # (2, 3), least and greatest coordinates of the model
    ransac: RansacOptions | None = None  # options of searches for inliers
    gt: Alignment | None = None
    """The truth, for metrics and for the Cramer-Rao bound; no method is given it."""
    inliers: BoolArray | None = None  # (n,), the true inliers, for the bound
    make_views: Callable[[], tuple[Model | ShapeModel, Sequence[View]]] | None = None
    """Makes the model and its views where they hold more than the keypoints."""

    def model_and_views(self) -> tuple[Model | ShapeModel, list[View]]:
        """The arguments of `cadalign.align`."""
        if self.make_views is not None:
            model, views = self.make_views()
            return model, list(views)
        from cadalign.estimation.model import Model
        from cadalign.estimation.view import View

        view = View(self.camera, self.points_2d, sigma=self.sigma)
        return Model(points_3d=self.points_3d, bounds=self.bounds), [view]


@dataclass(frozen=True)
class Method:
    """A method by name."""

    name: str
    solve: Callable[[Any], Any]
    """Makes an estimate; raises where it has none. A general method takes a `MethodInput` and
    returns an alignment or a result of `cadalign.fit` or `cadalign.align`; another one takes an
    instance of its benchmark, and returns what that measures."""
    solve_many: Callable[[Sequence[Any]], list[Any]] | None = None
    """Makes estimates of a sequence, with an error in the place of one that there is not."""
    is_general: bool = False
    has_statistics: bool = False
    """``solve`` states uncertainties and alternatives, ``solve_many`` does not."""
    is_robust: bool = False  # it searches for inliers

    @property
    def is_registered(self) -> bool:
        """True for a function that a user, or a module of examples, has registered."""
        return isinstance(self.solve, RegisteredFunction)


@dataclass(frozen=True)
class RegisteredFunction:
    """A registered function as the estimate of a general method.

    ``takes`` is `POINTS` or `VIEWS`; the standard deviation of the keypoints is passed on where
    the function ``takes_sigma``.
    """

    function: Portable
    takes: str
    takes_sigma: bool

    def __call__(self, given: MethodInput) -> Alignment | Result:
        """The function's answer, checked."""
        told = {"sigma": given.sigma} if self.takes_sigma else {}
        arguments: tuple[Any, ...]
        if self.takes == VIEWS:
            arguments = given.model_and_views()
        else:  # copies: what the function does to them must not reach other methods
            arguments = given.points_3d.copy(), given.points_2d.copy(), given.camera
        try:
            return checked_answer(self.function(*arguments, **told))
        except SystemExit as error:
            raise CadalignError(f"it called for an exit ({error})") from None


def checked_answer(answer: object) -> Alignment | Result:
    """The answer of a function, if it is a valid alignment or a result.

    Raises InputError if it is something else, or its alignment is none.
    """
    from cadalign.estimation.result import Result

    if not isinstance(answer, Alignment | Result):
        kind = type(answer).__name__
        fix = "return a cadalign.Alignment, or the result of cadalign.fit or cadalign.align"
        raise InputError(f"it returned {kind}, no alignment", where="method", fix=fix)
    found = answer if isinstance(answer, Alignment) else answer.alignment
    parts = (found.rotation, found.translation, found.scale)  # which may not have been checked
    rotation, translation, scale = map(np.asarray, parts)
    checked = Alignment(rotation, translation, scale)
    return checked if isinstance(answer, Alignment) else answer


# Names for a method together with options of `cadalign.fit`.
_VARIANTS: dict[str, dict[str, Any]] = {
    "optimal-huber": {"method": "optimal", "loss": "huber"},
    "optimal-cauchy": {"method": "optimal", "loss": "cauchy"},
}
# Robust ones, named after what they return: the optimum over all inliers, or the best hypothesis of
# a minimal solver as it is. With the linear solver, on 6 points, these are the AEPnP paper's two
# steps: RANSAC-AEPnP, and the same with non-linear refinement.
_RANSAC: dict[str, dict[str, Any]] = {
    "ransac-optimal": {"minimal": "ap4p", "refine": True},
    "ransac-ap4p": {"minimal": "ap4p", "refine": False},
    "ransac-aepnp": {"minimal": "aepnp", "refine": False},
    "ransac-aepnp-refined": {"minimal": "aepnp", "refine": True},
}
# 99.8 % of Gaussian errors in the plane are shorter than this, in standard deviations.
_INLIER_BOUND = 3.5


@cache
def fit_methods() -> dict[str, Method]:
    """The methods by name, the Cramer-Rao bound last."""
    found = [
        Method(
            name,
            partial(_fit, name=name),
            partial(_fit_many, name=name),
            is_general=True,
            has_statistics=name == "optimal" or name in _VARIANTS or name in _RANSAC,
            is_robust=name in _RANSAC,
        )
        for name in (*METHODS, *_VARIANTS, *_RANSAC)
    ]
    limit = Method(LIMIT, _bound, is_general=True)
    return {method.name: method for method in (*found, limit)}


def fit_options(name: str, *, sigma: float, ransac: RansacOptions | None) -> dict[str, Any]:
    """The options of `cadalign.fit` and `cadalign.fit_batch` that make it a method.

    Robust methods take what lies within 3.5 ``sigma`` [px] for an inlier, or go by ``ransac``, but
    for the minimal solver and the refinement, which are the method's own.
    """
    if name in _RANSAC:
        common = ransac or RansacOptions(max_reproj_error=_INLIER_BOUND * sigma)
        return {"sigma": sigma, "ransac": replace(common, **_RANSAC[name])}
    return {"sigma": sigma, **_VARIANTS.get(name, {"method": name})}


def _fit(given: MethodInput, *, name: str) -> Result:
    from cadalign.estimation.fit import fit

    how = fit_options(name, sigma=given.sigma, ransac=given.ransac)
    return fit(given.points_3d, given.points_2d, given.camera, **how)


def _fit_many(inputs: Sequence[MethodInput], *, name: str) -> list[Alignment | CadalignError]:
    """The alignments of many instances, in batches of one standard deviation and camera."""
    from cadalign.estimation.fit import fit_batch

    found: list[Alignment | CadalignError] = []
    for (sigma, camera), group in groupby(inputs, key=lambda given: (given.sigma, given.camera)):
        some = list(group)
        batch = fit_batch(
            [given.points_3d for given in some],
            [given.points_2d for given in some],
            camera,
            **fit_options(name, sigma=sigma, ransac=None),
        )
        found += [batch.errors.get(b) or batch.alignment(b) for b in range(len(batch))]
    return found


def _bound(given: MethodInput) -> Alignment:
    from cadalign.evaluation.metrics.cramer_rao import limit_estimate

    if given.gt is None:
        raise InputError("the Cramer-Rao bound needs the true alignment", where="methods")
    kept = slice(None) if given.inliers is None else given.inliers
    return limit_estimate(given.points_3d[kept], given.points_2d[kept], given.camera, given.gt)


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
