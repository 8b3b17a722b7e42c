"""Registry of metrics that users add: a column of result tables, summaries, tables and pages each.

::

    from cadalign.evaluation import register_metric

    register_metric("flipped", lambda *, est, gt: float(rotation_error(est=est, gt=gt) > 90))
    cadalign.evaluate("keypointnet", metrics=["flipped"])

On the command line it is ``--plugin my_metrics --metrics flipped``, where the module registers it.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Container, Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from cadalign.arrays import is_number, is_real
from cadalign.errors import InputError, quote, unknown
from cadalign.evaluation.methods.method import MethodInput, Portable, code_hash
from cadalign.evaluation.metrics.table import Metric
from cadalign.evaluation.runs.work import Columns
from cadalign.geometry.alignment import Alignment

if TYPE_CHECKING:
    from cadalign.estimation.result import Result

_OF_ESTIMATES = ("est", "gt", "result")
ARGUMENTS = (*_OF_ESTIMATES, "points_3d", "points_2d", "camera", "sigma", "bounds")
"""Names of the parameters that functions may have."""
_REGISTERED: dict[str, RegisteredMetric] = {}


@dataclass(frozen=True, eq=False)
class Compared:
    """An estimated alignment, the true one if it is known, and the result it is of, if any."""

    est: Alignment
    gt: Alignment | None
    result: Result | None = None

    @classmethod
    def of(cls, estimate: Any, gt: Alignment | None) -> Compared:
        """An alignment, a result, or another estimate with an ``alignment`` and perhaps one."""
        from cadalign.estimation.result import Result

        if isinstance(estimate, Alignment):
            return cls(estimate, gt)
        result = estimate if isinstance(estimate, Result) else getattr(estimate, "result", None)
        return cls(estimate.alignment, gt, result)


@dataclass(frozen=True)
class RegisteredMetric:
    """A metric with the function that measures it, and the names of its parameters."""

    metric: Metric
    function: Portable
    parameters: tuple[str, ...]

    def measure(self, found: Compared, given: MethodInput) -> float | None:
        """The number of an estimate; None for NaN, and where the truth is not known.

        Raises InputError if the function raises, or returns no number.
        """
        if "gt" in self.parameters and found.gt is None:
            return None
        where = f"metric {self.metric.key}"
        arguments = {
            name: getattr(found if name in _OF_ESTIMATES else given, name)
            for name in self.parameters
        }
        try:
            value = self.function(**arguments)
        except Exception as error:
            raise InputError(f"{type(error).__name__}: {error}", where=where) from None
        if value is None or (is_real(value) and value != value):
            return None
        if not is_number(value):
            of_kind = f"{type(value).__name__}, no number"
            what = f"{quote(value)}, which is not finite" if is_real(value) else of_kind
            raise InputError(f"it returned {what}", where=where)
        return float(value)


def register_metric(
    name: str,
    function: Callable[..., float | None],
    *,
    label: str = "",
    unit: str = "",
    digits: int = 3,
    better: str | None = "low",
    factor: float = 1.0,
) -> Metric:
    """Register a function as a metric of evaluations.

    Parameters
    ----------
    name : str
        Its name among ``metrics``, and that of its column. A function that was registered by this
        name before is replaced.
    function : callable
        Of keywords, any of ``est`` and ``gt``, the estimated and the true `cadalign.Alignment`;
        ``points_3d`` (n, 3) float [model units], ``points_2d`` (n, 2) float [px], ``camera``,
        ``sigma`` [px] and ``bounds`` (2, 3), what methods were given; and ``result``, the method's
        `cadalign.Result`, None where the method returns an alignment only. It returns a number, or
        None where it has none.
    label, unit : str
        Shown in tables, on pages and at axes; by default the name.
    digits : int
        Shown after the point.
    better : {"low", "high"} or None
        Direction; None for what is no quality.
    factor : float
        Shown is the value times this.

    Returns
    -------
    Metric

    Raises
    ------
    InputError
        If the name is not an identifier, or the function has other parameters.

    Examples
    --------
    >>> import cadalign
    >>> def depth_error(*, est, gt):
    ...     return abs(est.translation[2] - gt.translation[2]) / gt.translation[2]
    >>> metric = register_metric("depth_error", depth_error, unit="%", factor=100)
    >>> table = cadalign.simulate(
    ...     "points", values=[8], runs=2, methods=["aepnp"], metrics=["depth_error"], workers=0
    ... )
    >>> "depth_error" in table.columns
    True
    """
    if not isinstance(name, str) or not name.isidentifier():
        raise InputError(f"{quote(name)} is not an identifier", where="name")
    if better not in ("low", "high", None):
        raise InputError(f"{quote(better)} is neither low, high nor None", where="better")
    metric = Metric(name, label or name.replace("_", " "), unit, digits, better, factor, log=False)
    parameters = _parameters(function)
    _REGISTERED[name] = RegisteredMetric(metric, Portable(function), parameters)
    return metric


def _parameters(function: Callable[..., Any]) -> tuple[str, ...]:
    if not callable(function):
        raise InputError(f"{quote(function)} is not a function", where="function")
    parameters = inspect.signature(function).parameters.values()
    variable = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    required = [p.name for p in parameters if p.default is p.empty and p.kind not in variable]
    others = [name for name in required if name not in ARGUMENTS]
    if others:
        raise unknown("parameter", others[0], ARGUMENTS, where="function")
    return tuple(each.name for each in parameters if each.name in ARGUMENTS)


def choose_metrics(names: Iterable[str], columns: Columns = ()) -> tuple[RegisteredMetric, ...]:
    """The registered metrics of these names, each once.

    Raises InputError if one is unknown, or has the name of a column that is there already.
    """
    chosen, names = [], tuple(names)
    for name in dict.fromkeys(names):
        if name not in _REGISTERED:
            known = ", ".join(_REGISTERED) or "none before register_metric is called"
            what, fix = f"unknown metric {quote(name)}", f"known are {known}"
            raise InputError(what, where="metrics", fix=fix)
        chosen.append(_REGISTERED[name])
    refuse_taken(names, ("seconds", *dict(columns)))
    return tuple(chosen)


def refuse_taken(names: Iterable[str], taken: Container[str]) -> None:
    """Raise InputError for a metric with the name of a column that is there already."""
    for name in names:
        if name in taken:
            fix = "register the function by another name"
            raise InputError(f"the table has a column {quote(name)}", where="metrics", fix=fix)


def metrics_config(metrics: Sequence[RegisteredMetric]) -> dict[str, Any]:
    """Labels, units and hashes of the code for a run's configuration; empty without any."""
    if not metrics:
        return {}
    code = {each.metric.key: code_hash(each.function.function) for each in metrics}
    return {"metrics": [asdict(each.metric) for each in metrics], "metric_functions": code}
