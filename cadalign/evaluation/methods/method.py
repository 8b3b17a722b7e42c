"""Methods, what they are given of an instance, and what they may answer."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.errors import CadalignError, InputError
from cadalign.evaluation.portable import Portable
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera

if TYPE_CHECKING:
    from cadalign.estimation.model import Model
    from cadalign.estimation.options import RansacOptions
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
    """An instance as general methods are given it.

    Parameters
    ----------
    points_3d : (n, 3) float
        Keypoints on the model [model units].
    points_2d : (n, 2) float
        Their observations [px].
    camera : Camera
    sigma : float
        Standard deviation of the observations that methods are given [px].
    bounds : (2, 3) float, optional
        Least and greatest coordinates of the model.
    ransac : RansacOptions, optional
        Options of searches for inliers.
    gt : Alignment, optional
        The truth, for metrics and for the Cramer-Rao bound; no method is given it.
    inliers : (n,) bool, optional
        The true inliers, for the bound.
    make_views : callable, optional
        Makes the model and its views where they hold more than the keypoints.
    """

    points_3d: FloatArray
    points_2d: FloatArray
    camera: Camera
    sigma: float
    bounds: FloatArray | None = None
    ransac: RansacOptions | None = None
    gt: Alignment | None = None
    inliers: BoolArray | None = None
    make_views: Callable[[], tuple[Model | ShapeModel, Sequence[View]]] | None = None

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
    """A method by name.

    Parameters
    ----------
    name : str
    solve : callable
        Makes an estimate; raises where it has none. A general method takes a `MethodInput` and
        returns an alignment or a result of `cadalign.fit` or `cadalign.align`; another one takes an
        instance of its benchmark, and returns what that measures.
    solve_many : callable, optional
        Makes estimates of a sequence, with an error in the place of one that there is not.
    is_general : bool
    has_statistics : bool
        ``solve`` states uncertainties and alternatives, ``solve_many`` does not.
    is_robust : bool
        It searches for inliers.
    """

    name: str
    solve: Callable[[Any], Any]
    solve_many: Callable[[Sequence[Any]], list[Any]] | None = None
    is_general: bool = False
    has_statistics: bool = False
    is_robust: bool = False

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

    Raises
    ------
    InputError
        If it is something else, or its alignment is none.
    """
    from cadalign.estimation.result import Result

    if not isinstance(answer, Alignment | Result):
        kind = type(answer).__name__
        fix = "return a cadalign.Alignment, or the result of cadalign.fit or cadalign.align"
        raise InputError(f"it returned {kind}, no alignment", where="method", fix=fix)
    found = answer if isinstance(answer, Alignment) else answer.alignment
    rotation, translation, scale = map(np.asarray, vars_of(found))
    checked = Alignment(rotation, translation, scale)
    return checked if isinstance(answer, Alignment) else answer


def vars_of(alignment: Alignment) -> tuple[Any, Any, Any]:
    """Rotation, translation and scale of an alignment, which may not have been checked."""
    return alignment.rotation, alignment.translation, alignment.scale
