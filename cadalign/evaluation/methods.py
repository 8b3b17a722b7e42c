"""Methods and metrics by name: those of `cadalign.fit`, and functions of users.

A function of ``(points_3d, points_2d, camera)`` that returns an alignment or a result is a method,
one of keywords such as ``est`` and ``gt`` that returns a number a metric::

    cadalign.evaluate("keypointnet", methods=[my_function, "my_module:solve", "optimal"])

On the command line, ``--methods my_module:solve optimal`` does the same. Worker processes import
the module; a function that they cannot import runs without workers.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Collection, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial
from importlib import import_module
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cadalign.arrays import BoolArray, FloatArray, is_number, is_real
from cadalign.errors import CadalignError, InputError, quote, unknown
from cadalign.estimation.options import METHODS, RansacOptions
from cadalign.evaluation.metrics import Metric, metric_named
from cadalign.evaluation.options import Function, is_function, name_of
from cadalign.evaluation.runs.work import Columns
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera

if TYPE_CHECKING:
    from cadalign.estimation.result import Result
    from cadalign.evaluation.simulation import SimulatedProblem

LIMIT = "limit"
"""The pseudo-method of the Cramer-Rao bound; see `cadalign.evaluation.metrics.errors`."""
SHAPE = "shape"
"""The alignment of a category's learned shape, in runs that have one."""
_ARGUMENTS = ("est", "gt", "result", "points_3d", "points_2d", "camera", "sigma", "bounds")
_FIX = "give module:function"


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

    @classmethod
    def of_problem(
        cls, problem: SimulatedProblem, sigma: float, *, ransac: RansacOptions | None = None
    ) -> MethodInput:
        """A simulated problem with the noise [px] that methods are told."""
        inliers = None if problem.outliers is None else ~problem.outliers
        seen = problem.points_3d, problem.points_2d, problem.camera
        return cls(*seen, sigma, ransac=ransac, gt=problem.alignment, inliers=inliers)


def pose_of(estimate: Any) -> Alignment:
    """The alignment of an estimate."""
    found: Alignment = estimate if isinstance(estimate, Alignment) else estimate.alignment
    return found


@dataclass(frozen=True)
class Method:
    """A method by name."""

    name: str
    solve: Callable[[Any], Any]
    """Makes an estimate; raises where it has none. A general method takes a `MethodInput` and
    returns an alignment or a result of `cadalign.fit`; another one takes an
    instance of its benchmark, and returns what that measures."""
    solve_many: Callable[[Sequence[Any]], list[Any]] | None = None
    """Makes estimates of a sequence, with an error in the place of one that there is not."""
    is_general: bool = False
    has_statistics: bool = False
    """``solve`` states uncertainties and alternatives, ``solve_many`` does not."""


# Names for a method together with options of `cadalign.fit`.
_VARIANTS: dict[str, dict[str, Any]] = {
    "optimal-huber": {"method": "optimal", "loss": "huber"},
    "optimal-cauchy": {"method": "optimal", "loss": "cauchy"},
}
# Robust ones, the minimal solver and whether the optimum over all inliers is returned. With the
# linear solver, on 6 points, these are the AEPnP paper's RANSAC-AEPnP, and the same refined.
_RANSAC: dict[str, dict[str, Any]] = {
    "ransac-optimal": {"minimal": "ap4p", "refine": True},
    "ransac-ap4p": {"minimal": "ap4p", "refine": False},
    "ransac-aepnp": {"minimal": "aepnp", "refine": False},
    "ransac-aepnp-refined": {"minimal": "aepnp", "refine": True},
}
_INLIER_BOUND = 3.5  # [standard deviations], longer than 99.8 % of Gaussian errors in the plane


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
        errors = batch.errors  # made anew at every look
        found += [errors.get(b) or batch.alignment(b) for b in range(len(batch))]
    return found


def _bound(given: MethodInput) -> Alignment:
    from cadalign.evaluation.metrics.errors import limit_estimate

    if given.gt is None:
        raise InputError("the Cramer-Rao bound needs the true alignment", where="methods")
    kept = slice(None) if given.inliers is None else given.inliers
    return limit_estimate(given.points_3d[kept], given.points_2d[kept], given.camera, given.gt)


# Functions of users -------------------------------------------------------------------------------


@lru_cache(maxsize=64)
def imported(text: str, *, where: str) -> Callable[..., Any]:
    """Import ``module:function``; the working directory is searched, too.

    Raises InputError if the module cannot be imported, or has no such function.
    """
    module_name, _, name = text.partition(":")
    if str(Path.cwd()) not in sys.path:
        sys.path.insert(0, str(Path.cwd()))
    try:
        found: Any = import_module(module_name)
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"[:200]
        what = f"{quote(module_name)} cannot be imported ({reason})"
        raise InputError(what, where=where, fix=_FIX) from None
    for part in name.split("."):
        found = getattr(found, part, None)
    if not callable(found):
        what = f"the module {quote(module_name)} has no function {quote(name)}"
        raise InputError(what, where=where, fix=_FIX)
    function: Callable[..., Any] = found
    return function


def _loaded(function: Function, where: str) -> Callable[..., Any]:
    return imported(function, where=where) if isinstance(function, str) else function


def check_names(functions: Iterable[Function], taken: Container[str], where: str) -> None:
    """Raise InputError for functions without names for tables, or with names that are taken."""
    known: set[str] = set()
    for function in functions:
        name = name_of(function)
        if not name.isidentifier():
            what = f"a function that is called {name} has no name for tables"
            raise InputError(what, where=where, fix="define it by def")
        if name in known or name in taken:
            what = f"{quote(name)} is the name of more than one"
            raise InputError(what, where=where, fix="give the function another name")
        known.add(name)


def _answer_of(given: MethodInput, *, function: Function) -> Alignment | Result:
    """The answer of a user's function to an instance, checked."""
    loaded = _loaded(function, "methods")
    told = {"sigma": given.sigma} if _takes_sigma(loaded) else {}
    # Copies: what the function does to them must not reach other methods.
    arguments = given.points_3d.copy(), given.points_2d.copy(), given.camera
    try:
        return _checked_answer(loaded(*arguments, **told))
    except SystemExit as error:
        raise CadalignError(f"it called for an exit ({error})") from None


def _checked_answer(answer: object) -> Alignment | Result:
    """The answer of a function; raises InputError if it is no valid alignment and no result."""
    from cadalign.estimation.result import Result

    if not isinstance(answer, Alignment | Result):
        kind = type(answer).__name__
        fix = "return a cadalign.Alignment, or the result of cadalign.fit or cadalign.align"
        raise InputError(f"it returned {kind}, no alignment", where="method", fix=fix)
    found = answer if isinstance(answer, Alignment) else answer.alignment
    checked = Alignment(found.rotation, found.translation, found.scale)
    return checked if isinstance(answer, Alignment) else answer


@lru_cache(maxsize=64)
def _takes_sigma(function: Callable[..., Any]) -> bool:
    try:
        return "sigma" in inspect.signature(function).parameters
    except (TypeError, ValueError):  # of some functions that are not written in Python
        return False


def choose_methods(
    chosen: Iterable[Any], own: Mapping[str, Method] | None = None
) -> tuple[Method, ...]:
    """The methods of these names and functions, each once.

    ``own`` are a benchmark's own methods by name, by default those of `cadalign.fit`. Raises
    InputError if a method is unknown, or none is given.
    """
    table = fit_methods() if own is None else own
    return tuple(
        Method(name_of(each), partial(_answer_of, function=each), is_general=True)
        if is_function(each)
        else table[each]
        for each in checked_methods(chosen, own)
    )


def checked_methods(chosen: Iterable[Any], own: Collection[str] | None = None) -> tuple[Any, ...]:
    """The names and functions, each once, if all are known; see `choose_methods`."""
    known = fit_methods() if own is None else own
    found = tuple(dict.fromkeys(chosen))
    if not found:
        fix = f"known are {', '.join(known)}"
        raise InputError("none is given", where="methods", fix=fix)
    for each in found:
        if not is_function(each) and each not in known:
            raise unknown("method", each, known, where="methods")
    check_names(filter(is_function, found), known, "methods")
    for function in filter(is_function, found):
        _loaded(function, "methods")
    return found


# Metrics ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FunctionMetric:
    """A metric with the function that measures it, and the names of its parameters."""

    metric: Metric
    function: Function
    parameters: tuple[str, ...]

    @classmethod
    def of(cls, function: Function) -> FunctionMetric:
        """A function of keywords, any of those that it may have."""
        if not is_function(function):
            raise InputError(f"{quote(function)} is no function", where="metrics", fix=_FIX)
        parameters = inspect.signature(_loaded(function, "metrics")).parameters.values()
        variable = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
        required = [p.name for p in parameters if p.default is p.empty and p.kind not in variable]
        others = [name for name in required if name not in _ARGUMENTS]
        if others:
            raise unknown("parameter", others[0], _ARGUMENTS, where="metrics")
        taken = tuple(each.name for each in parameters if each.name in _ARGUMENTS)
        return cls(metric_named(name_of(function)), function, taken)

    def measure(self, estimate: Any, given: MethodInput) -> float | None:
        """The number of an estimate; None for NaN, and where the truth is not known.

        ``estimate`` is an alignment, or has one as its ``alignment``. Raises InputError if the
        function raises, or returns no number.
        """
        from cadalign.estimation.result import Result

        if "gt" in self.parameters and given.gt is None:
            return None
        where = f"metric {self.metric.key}"
        result = estimate if isinstance(estimate, Result) else getattr(estimate, "result", None)
        known = {**vars(given), "est": pose_of(estimate), "result": result}
        arguments = {name: known[name] for name in self.parameters}
        try:
            value = _loaded(self.function, "metrics")(**arguments)
        except Exception as error:
            raise InputError(f"{type(error).__name__}: {error}", where=where) from None
        if value is None or (is_real(value) and value != value):
            return None
        if not is_number(value):
            of_kind = f"{type(value).__name__}, no number"
            what = f"{quote(value)}, which is not finite" if is_real(value) else of_kind
            raise InputError(f"it returned {what}", where=where)
        return float(value)


def choose_metrics(
    functions: Iterable[Function], columns: Columns = ()
) -> tuple[FunctionMetric, ...]:
    """The functions as metrics, each once.

    Raises InputError if one is none, or has the name of a column that is there already.
    """
    found = tuple(FunctionMetric.of(each) for each in dict.fromkeys(functions))
    check_names((each.function for each in found), ("seconds", *dict(columns)), "metrics")
    return found
