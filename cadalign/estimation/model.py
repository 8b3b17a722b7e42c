"""A CAD model with keypoints, for `align` without a learned category."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from cadalign.arrays import as_floats, as_points, as_positive, read_only
from cadalign.errors import InputError, require_kind
from cadalign.estimation.options import SIMILAR_SCALE_SIGMA, FitOptions
from cadalign.geometry.alignment import extent
from cadalign.geometry.mesh import Mesh, check_near
from cadalign.geometry.symmetry import Symmetry, check_symmetry
from cadalign.shapes.parts import check_axis, check_ids


@dataclass(frozen=True, eq=False, kw_only=True)
class Model:
    """One CAD model: its keypoints, and how far the object may differ from it.

    Parameters
    ----------
    points_3d : (n, 3) float
        Keypoints, in the model's coordinates. A model with a mesh needs none if views have masks.
    ids : sequence of n int or str, optional
        Their semantic ids or names; default: 0 to n - 1.
    bounds : (2, 3) float, optional
        Minimum and maximum coordinates; default: bounds of the mesh, otherwise of the keypoints.
    mesh : Mesh, optional
        The model's surface, for masks, photos and `Result.mesh`.
    shape_sigma : float, optional
        For an object that is only similar: standard deviation of its keypoints from the model's,
        along each axis, before the stretch [model units]. None if the object is the stretched
        model.
    stretch : str, optional
        As for `cadalign.fit`.
    stretch_sigma : float, optional
        As for `cadalign.fit`. With ``shape_sigma`` the default is 0.2, since similar objects have
        similar proportions.
    up_axis : {"y", "x", "z"} or None
        The model's axis that points up, for `View.up` and camera heights; None if no axis does.
    symmetry : Symmetry, optional
        As for `cadalign.fit`. If the object's size is estimated, a quarter turn that swaps two
        stretches is an equivalent alignment too.

    Raises
    ------
    InputError
        If shapes don't match, ids repeat, a value is NaN or infinite, or an option is invalid.

    Examples
    --------
    >>> corners = [[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]
    >>> Model(points_3d=corners, shape_sigma=0.02).bounds.tolist()
    [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]
    """

    points_3d: npt.ArrayLike = ()
    ids: Sequence[Hashable] | None = None
    bounds: npt.ArrayLike | None = None
    mesh: Mesh | None = None
    shape_sigma: float | None = None
    stretch: str | None = None
    stretch_sigma: float | None = None
    up_axis: str | None = "y"
    symmetry: Symmetry | None = None

    def __repr__(self) -> str:
        mesh = "" if self.mesh is None else f", {self.mesh!r}"
        sigma = "" if self.shape_sigma is None else f", shape_sigma={self.shape_sigma:g}"
        return f"Model({np.shape(self.points_3d)[0]} keypoints{mesh}{sigma})"

    def __post_init__(self) -> None:
        given_points = np.empty((0, 3)) if np.size(self.points_3d) == 0 else self.points_3d
        points = as_points(given_points, name="points_3d", dimension=3)
        if not len(points) and self.mesh is None:
            raise InputError("no keypoints given", where="points_3d", fix="give some, or a mesh")
        object.__setattr__(self, "points_3d", read_only(points))
        object.__setattr__(self, "ids", checked_ids(self.ids, len(points)))
        if self.mesh is not None:
            require_kind(self.mesh, Mesh, "mesh", fix="read it with cadalign.load_mesh")
            check_near(points, self.mesh.bounds, where="points_3d")
        if self.shape_sigma is not None:
            if not len(points):
                fix = "give points_3d, or omit shape_sigma"
                raise InputError("the model has no keypoints", where="shape_sigma", fix=fix)
            sigma = as_positive(self.shape_sigma, name="shape_sigma")
            object.__setattr__(self, "shape_sigma", sigma)
        given = self.bounds
        if given is None:
            given = self.mesh.bounds if self.mesh is not None else extent(points)
        bounds = as_floats(given, name="bounds", shape=(2, 3))
        if (bounds[1] < bounds[0]).any():
            raise InputError("the first row must hold the minimum coordinates", where="bounds")
        object.__setattr__(self, "bounds", read_only(bounds))
        if self.symmetry is not None:
            check_symmetry(self.symmetry)
        if self.up_axis is not None:
            check_axis(self.up_axis, "up_axis")
        self.fit_options()

    def fit_options(self) -> FitOptions:
        """The options of the plain fit to this model."""
        prior = self.stretch_sigma
        if prior is None and self.shape_sigma is not None:
            prior = SIMILAR_SCALE_SIGMA
        return FitOptions(stretch=self.stretch, stretch_sigma=prior)


def is_exact_model(model: object) -> bool:
    """True for a CAD model whose shape is exact up to the stretch."""
    return isinstance(model, Model) and model.shape_sigma is None


def checked_ids(ids: Iterable[Any] | None, count: int) -> tuple[Hashable, ...]:
    """Checked ids of ``count`` keypoints, by default 0, 1, ...; raises InputError."""
    if ids is None:
        return tuple(range(count))
    if isinstance(ids, str | bytes) or not isinstance(ids, Iterable):
        what = f"expected a sequence of numbers or names, got {type(ids).__name__}"
        raise InputError(what, where="ids", fix="give the id of each keypoint")
    listed = list(ids)
    if len(listed) != count:
        raise InputError(f"{len(listed)} ids for {count} keypoints", where="ids")
    return check_ids(listed, "ids") if listed else ()
