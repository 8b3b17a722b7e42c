"""Methods and metrics by name: methods of `cadalign.fit`, and functions of users.

A method is a function of ``(points_3d, points_2d, camera)`` that returns an alignment or a result.
A metric is a function of keywords such as ``est`` and ``gt`` that returns a number::

    cadalign.evaluate("keypointnet", methods=[my_function, "my_module:solve", "optimal"])

On the command line, use ``--methods my_module:solve optimal``. Worker processes import the module;
a function that they cannot import needs ``workers=0``.
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
from cadalign.errors import CadalignError, InputError, quote, unknown_name
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
"""Name of the Cramer-Rao bound among methods; see `cadalign.evaluation.metrics.errors`."""
SHAPE = "shape"
"""Name of the alignment of a category's learned shape."""
_ARGUMENTS = ("est", "gt", "result", "points_3d", "points_2d", "camera", "sigma", "bounds")
_FIX = "give module:function"


@dataclass(frozen=True, eq=False)
class MethodInput:
    """The input of general methods."""

    points_3d: FloatArray  # (n, 3), keypoints on the model [model units]
    points_2d: FloatArray  # (n, 2), their observations [px]
    camera: Camera
    sigma: float  # standard deviation of the observations [px] as methods get it
    bounds: FloatArray | None = None  # (2, 3), lowest and highest coordinates of the model
    ransac: RansacOptions | None = None  # for RANSAC methods
    gt: Alignment | None = None
    """The truth, for metrics and the Cramer-Rao bound; hidden from methods."""
    inliers: BoolArray | None = None  # (n,), true inliers, for the Cramer-Rao bound

    @classmethod
    def from_problem(
        cls, problem: SimulatedProblem, sigma: float, *, ransac: RansacOptions | None = None
    ) -> MethodInput:
        """The input of a simulated problem; ``sigma`` [px] is the noise as methods get it."""
        inliers = None if problem.outliers is None else ~problem.outliers
        seen = problem.points_3d, problem.points_2d, problem.camera
        return cls(*seen, sigma, ransac=ransac, gt=problem.alignment, inliers=inliers)


def pose_of(estimate: Any) -> Alignment:
    """The alignment of an estimate."""
    found: Alignment = estimate if isinstance(estimate, Alignment) else estimate.alignment
    return found


@dataclass(frozen=True)
class Method:
    """A method: its name and how it solves instances."""

    name: str
    solve: Callable[[Any], Any]
    """Returns an estimate, or raises. A general method takes a `MethodInput` and returns an
    alignment or a result of `cadalign.fit`; any other method takes an instance of its benchmark and
    returns an estimate that the benchmark measures."""
    solve_many: Callable[[Sequence[Any]], list[Any]] | None = None
    """Returns an estimate or an error for each input of a sequence."""
    is_general: bool = False
    has_statistics: bool = False
    """True if ``solve`` states uncertainties and alternatives, which ``solve_many`` does not."""


# Names of methods with further options of `cadalign.fit`.
_VARIANTS: dict[str, dict[str, Any]] = {
    "optimal-huber": {"method": "optimal", "loss": "huber"},
    "optimal-cauchy": {"method": "optimal", "loss": "cauchy"},
}
# RANSAC methods: the minimal solver, and whether the optimum over all inliers is returned. The last
# two are the AEPnP paper's RANSAC-AEPnP (linear solver, 6 points), and the same refined.
_RANSAC: dict[str, dict[str, Any]] = {
    "ransac-optimal": {"minimal": "ap4p", "refine": True},
    "ransac-ap4p": {"minimal": "ap4p", "refine": False},
    "ransac-aepnp": {"minimal": "aepnp", "refine": False},
    "ransac-aepnp-refined": {"minimal": "aepnp", "refine": True},
}
_INLIER_BOUND = 3.5  # [standard deviations], exceeds 99.8 % of Gaussian errors in the plane


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
    """The options of `cadalign.fit` and `cadalign.fit_batch` for a method.

    RANSAC methods use ``ransac``, by default an inlier threshold of 3.5 ``sigma`` [px]; the method
    sets the minimal solver and the refinement.
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
    """Fit many instances, in batches with one standard deviation and camera."""
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
        errors = batch.errors  # a property that is computed on each access
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
def import_function(text: str, *, where: str) -> Callable[..., Any]:
    """Import ``module:function``, also from the working directory.

    Raises InputError if the module cannot be imported, or lacks the function.
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


def _load(function: Function, where: str) -> Callable[..., Any]:
    return import_function(function, where=where) if isinstance(function, str) else function


def check_names(functions: Iterable[Function], taken: Container[str], where: str) -> None:
    """Raise InputError for functions whose names are no identifiers, or are taken."""
    known: set[str] = set()
    for function in functions:
        name = name_of(function)
        if not name.isidentifier():
            what = f"a function named {name} cannot head a column of tables"
            raise InputError(what, where=where, fix="define it with def")
        if name in known or name in taken:
            what = f"the name {quote(name)} is already in use"
            raise InputError(what, where=where, fix="rename the function")
        known.add(name)


def _answer_of(given: MethodInput, *, function: Function) -> Alignment | Result:
    """Call a user's method and check what it returns."""
    loaded = _load(function, "methods")
    options = {"sigma": given.sigma} if _takes_sigma(loaded) else {}
    # Copies, as the function may modify its arguments.
    arguments = given.points_3d.copy(), given.points_2d.copy(), given.camera
    try:
        return _check_answer(loaded(*arguments, **options))
    except SystemExit as error:
        raise CadalignError(f"it called sys.exit ({error})") from None


def _check_answer(answer: object) -> Alignment | Result:
    """Return the alignment or result; raises InputError if it is neither, or invalid."""
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
    except (TypeError, ValueError):  # some functions of C extensions have no signature
        return False


def choose_methods(
    chosen: Iterable[Any], own: Mapping[str, Method] | None = None
) -> tuple[Method, ...]:
    """The methods of names and functions, without repetition.

    ``own`` are a benchmark's methods by name, by default `fit_methods`. Raises InputError if a
    method is unknown, or none is given.
    """
    table = fit_methods() if own is None else own
    return tuple(
        Method(name_of(each), partial(_answer_of, function=each), is_general=True)
        if is_function(each)
        else table[each]
        for each in validate_methods(chosen, own)
    )


def validate_methods(chosen: Iterable[Any], own: Collection[str] | None = None) -> tuple[Any, ...]:
    """Check names and functions and drop repeated ones; see `choose_methods`."""
    known = fit_methods() if own is None else own
    found = tuple(dict.fromkeys(chosen))
    if not found:
        fix = f"known are {', '.join(known)}"
        raise InputError("none is given", where="methods", fix=fix)
    for each in found:
        if not is_function(each) and each not in known:
            raise unknown_name("method", each, known, where="methods")
    check_names(filter(is_function, found), known, "methods")
    for function in filter(is_function, found):
        _load(function, "methods")
    return found


# Metrics ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FunctionMetric:
    """A metric with its function and the names of the function's parameters."""

    metric: Metric
    function: Function
    parameters: tuple[str, ...]

    @classmethod
    def from_function(cls, function: Function) -> FunctionMetric:
        """Make a metric; raises InputError for an unknown required parameter."""
        if not is_function(function):
            raise InputError(f"{quote(function)} is no function", where="metrics", fix=_FIX)
        parameters = inspect.signature(_load(function, "metrics")).parameters.values()
        variable = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
        required = [p.name for p in parameters if p.default is p.empty and p.kind not in variable]
        others = [name for name in required if name not in _ARGUMENTS]
        if others:
            raise unknown_name("parameter", others[0], _ARGUMENTS, where="metrics")
        taken = tuple(each.name for each in parameters if each.name in _ARGUMENTS)
        return cls(metric_named(name_of(function)), function, taken)

    def measure(self, estimate: Any, given: MethodInput) -> float | None:
        """Measure an estimate; None for NaN, or if the function needs an unknown truth.

        ``estimate`` is an alignment, or has an ``alignment``. Raises InputError if the function
        raises, or does not return a number.
        """
        from cadalign.estimation.result import Result

        if "gt" in self.parameters and given.gt is None:
            return None
        where = f"metric {self.metric.key}"
        result = estimate if isinstance(estimate, Result) else getattr(estimate, "result", None)
        known = {**vars(given), "est": pose_of(estimate), "result": result}
        arguments = {name: known[name] for name in self.parameters}
        try:
            value = _load(self.function, "metrics")(**arguments)
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
    """Make metrics of functions, without repetition.

    Raises InputError if one is not a function, or has the name of one of the columns.
    """
    found = tuple(FunctionMetric.from_function(each) for each in dict.fromkeys(functions))
    check_names((each.function for each in found), ("seconds", *dict(columns)), "metrics")
    return found
