"""Evidence beyond keypoints: the fields of an image, declared once, and an object's known lengths.

`DeclaredEvidence` declares each field with its type in observation files and the help text of its
command line option: `cadalign.View` takes the fields as arguments, `cadalign.io.observation` reads
and writes them, `cadalign.cli.options` makes options of them. `register_fields` adds fields of
further kinds of evidence to all three.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, IntArray, as_floats, as_one_or_each, as_points, as_positive
from cadalign.errors import InputError, require_kind
from cadalign.geometry.camera import Camera
from cadalign.io.documents import Finite, PathText, Point3, Positive
from cadalign.io.files import as_path

_Row4 = tuple[Finite, Finite, Finite, Finite]
_AXIS = tuple[float, float, float]
LENGTHS = ("width", "height", "length")
"""Names of the lengths along the model's x, y and z."""
_LENGTH_SIGMA = 0.01  # relative


@dataclass(frozen=True)
class EvidenceField:
    """A field of evidence beyond keypoints.

    Parameters
    ----------
    name : str
        The argument of `cadalign.View`, the key in observation files, and the option of commands.
    stored : type
        Its type in observation files, as `cadalign.io.documents` checks it.
    help : str
        Meaning, unit and default, for the command line.
    option : type, optional
        Type of the option of commands; None for no option.
    refines : str, optional
        The field without which it means nothing.
    check : function of the value, optional
        Returns the value that is kept; raises InputError if it is invalid.
    """

    name: str
    stored: Any
    help: str
    option: Any = None
    refines: str | None = None
    check: Callable[[Any], Any] | None = None

    def checked(self, value: Any) -> Any:
        """The value that is kept, where it is valid."""
        if self.check is not None:
            return self.check(value)
        return as_positive(value, name=self.name) if self.stored is Positive else value


_registered: dict[str, EvidenceField] = {}


def register_fields(*added: EvidenceField) -> None:
    """Add fields; see `cadalign.estimation.evidence_kinds.register_evidence`."""
    for each in added:
        _registered[each.name] = each


def remove_fields(*names: str) -> None:
    """Remove registered fields."""
    for name in names:
        _registered.pop(name, None)


def evidence_fields() -> tuple[EvidenceField, ...]:
    """All declared fields, then the registered ones."""
    return (*_declared(), *_registered.values())


@cache
def _declared() -> tuple[EvidenceField, ...]:
    own = fields(DeclaredEvidence)
    return tuple(EvidenceField(each.name, **each.metadata) for each in own if each.metadata)


def as_arguments(values: Mapping[str, Any]) -> dict[str, Any]:
    """Values of fields as arguments of `DeclaredEvidence`, with registered ones as ``more``."""
    more = {name: value for name, value in values.items() if name in _registered}
    return {name: value for name, value in values.items() if name not in more} | {"more": more}


def _stored_as(stored: Any, text: str, option: Any = None, refines: str | None = None) -> Any:
    declared = {"stored": stored, "help": text, "option": option, "refines": refines}
    return field(default=None, metadata=declared)


@dataclass(frozen=True, eq=False, kw_only=True)
class DeclaredEvidence:
    """Evidence of an image beyond keypoints; None for what is not known.

    `cadalign.View` describes the fields; ``more`` holds values of registered ones by name.
    """

    mask: npt.ArrayLike | str | os.PathLike[str] | None = _stored_as(
        PathText, "Mask of the object, a grey PNG of the photo's size.", Path
    )
    mask_sigma: float | None = _stored_as(
        Positive,
        "Standard deviation of the mask's contour [px]; estimated by default.",
        float,
        refines="mask",
    )
    depth: npt.ArrayLike | str | os.PathLike[str] | None = _stored_as(
        PathText,
        "Depth image that is registered to the photo, a PNG of 16 bits; 0 where unknown.",
        Path,
    )
    depth_scale: float | None = _stored_as(
        Positive,
        "Units per count of the depth image; 0.001 by default, millimetres to metres.",
        float,
        refines="depth",
    )
    depth_sigma: npt.ArrayLike | None = _stored_as(
        Positive,
        "Relative standard deviation of the depths; 0.01 by default.",
        float,
        refines="depth",
    )
    up: npt.ArrayLike | None = _stored_as(
        Point3,
        "Upward direction in the camera's frame, whose y points down: 0 -1 0 for a level one.",
        _AXIS,
    )
    up_sigma_deg: npt.ArrayLike | None = _stored_as(
        Positive,
        "Standard deviation of this direction [degrees]; 1 by default.",
        float,
        refines="up",
    )
    camera_height: float | None = _stored_as(
        Positive, "Height of the camera above the plane that the object stands on.", float
    )
    camera_height_sigma: float | None = _stored_as(
        Positive,
        "Relative standard deviation of this height; 0.02 by default.",
        float,
        refines="camera_height",
    )
    cam_from_rig: npt.ArrayLike | None = _stored_as(
        tuple[_Row4, _Row4, _Row4, _Row4],
        "The camera's known pose in the frame that the views share.",
    )
    more: Mapping[str, Any] = field(default_factory=dict)

    @property
    def given(self) -> dict[str, Any]:
        """The fields that are known, by name."""
        values = {name: getattr(self, name) for name in DeclaredEvidence.__dataclass_fields__}
        known = values | dict(values.pop("more"))
        return {name: value for name, value in known.items() if value is not None}

    @property
    def sources(self) -> tuple[str, ...]:
        """Names of the fields that are known and are evidence by themselves."""
        values = vars(self) | dict(self.more)
        return tuple(
            each.name
            for each in evidence_fields()
            if not each.refines and values.get(each.name) is not None
        )

    def _check_more(self) -> None:
        if not self.more:
            return
        checked = {}
        for name, value in self.more.items():
            if name not in _registered:
                fix = f"known are {', '.join(_registered) or 'none'}"
                raise InputError(f"unknown evidence {name!r}", where="more", fix=fix)
            checked[name] = None if value is None else _registered[name].checked(value)
        object.__setattr__(self, "more", checked)


@dataclass(frozen=True, eq=False, kw_only=True)
class ImageEvidence(DeclaredEvidence):
    """Evidence of an image as an observation file holds it, with paths of mask and depth image.

    Raises
    ------
    InputError
        If a number is not positive, a sigma or scale is given without its measurement, or an
        array has a wrong shape.
    """

    mask: Path | None = None
    depth: Path | None = None
    depth_sigma: float | None = None
    up: FloatArray | None = None
    up_sigma_deg: float | None = None
    cam_from_rig: FloatArray | None = None

    def __post_init__(self) -> None:
        self._check_more()
        given = self.given
        for each in evidence_fields():
            if each.name not in given:
                continue
            # depth_sigma may be that of depths of the keypoints
            if each.name != "depth_sigma" and each.refines not in {None, *given}:
                what, fix = f"given without {each.refines}", f"give {each.refines}, too"
                raise InputError(what, where=each.name, fix=fix)
            if each.stored is Positive and each.name not in self.more:
                value = as_positive(given[each.name], name=each.name)
                object.__setattr__(self, each.name, value)
        _keep_paths(self, "mask", "depth")
        for name, shape in (("up", (3,)), ("cam_from_rig", (4, 4))):
            if (value := getattr(self, name)) is not None:
                object.__setattr__(self, name, as_floats(value, name=name, shape=shape))
        if self.up is not None and not self.up.any():
            raise InputError("a direction must not be zero", where="up")


@dataclass(frozen=True, eq=False)
class Size:
    """Known lengths of an object's box along the model's axes.

    Parameters
    ----------
    width, height, length : float, optional
        Along x, y, z [the unit in which pose and size are wanted].
    sigma : float or (3,) float, optional
        Standard deviation of the lengths, relative; by default 0.01, 1 %.

    Raises
    ------
    InputError
        If no length is given, or a value is not positive.

    Examples
    --------
    >>> Size(height=0.81, sigma=0.005).lengths.tolist()
    [nan, 0.81, nan]
    """

    width: float | None = None
    height: float | None = None
    length: float | None = None
    sigma: npt.ArrayLike | None = None

    def __post_init__(self) -> None:
        for name in LENGTHS:
            if getattr(self, name) is not None:
                object.__setattr__(self, name, as_positive(getattr(self, name), name=name))
        if np.isnan(self.lengths).all():
            fix = "give width, height or length"
            raise InputError("no length is given", where="size", fix=fix)
        if self.sigma is not None:
            as_one_or_each(self.sigma, name="size.sigma", count=3, entries="lengths")

    @property
    def relative(self) -> FloatArray:
        """Relative standard deviation, one or (3,)."""
        sigma = _LENGTH_SIGMA if self.sigma is None else self.sigma
        return np.asarray(sigma, dtype=np.float64)

    @property
    def given(self) -> dict[str, Any]:
        """The arguments that are given, by name."""
        return {name: value for name, value in vars(self).items() if value is not None}

    @property
    def lengths(self) -> FloatArray:
        """Lengths (3,) along x, y, z; NaN where unknown."""
        return np.array([getattr(self, name) for name in LENGTHS], dtype=float)

    @property
    def deviations(self) -> FloatArray:
        """Standard deviations (3,) of the lengths; NaN where unknown."""
        return np.asarray(self.lengths * self.relative)


@dataclass(frozen=True, eq=False)
class ObservedImage:
    """Keypoints of the object in one image, and further evidence of the image.

    Parameters
    ----------
    points_3d : (n, 3) float
        Model points [model units].
    points_2d : (n, 2) float
        Image points [px].
    camera : Camera
    sigma : (n,) float, optional
        Standard deviation of each image point [px].
    ids : (n,) int, optional
        Meaning of each keypoint; the same number on all models of a category.
    names : tuple of n str, optional
        Name of each keypoint.
    scores : (n,) float, optional
        Trust in each keypoint, for the ``scores`` of `cadalign.fit`.
    image : Path, optional
        The photo.
    depths : (n,) float, optional
        Depth of each keypoint [model units]; NaN where unknown.
    evidence : ImageEvidence
        What is known beyond keypoints.

    Raises
    ------
    InputError
        If shapes don't match, a value is NaN or infinite, or depths are given twice.
    """

    points_3d: FloatArray
    points_2d: FloatArray
    camera: Camera
    sigma: FloatArray | None = None
    ids: IntArray | None = None
    names: tuple[str, ...] | None = None
    scores: FloatArray | None = None
    image: Path | None = None
    depths: FloatArray | None = field(default=None, kw_only=True)
    evidence: ImageEvidence = field(default_factory=ImageEvidence, kw_only=True)

    def __post_init__(self) -> None:
        require_kind(self.camera, Camera, "camera")
        points_3d = as_points(self.points_3d, name="points_3d", dimension=3)
        points_2d = as_floats(self.points_2d, name="points_2d", shape=(len(points_3d), 2))
        object.__setattr__(self, "points_3d", points_3d)
        object.__setattr__(self, "points_2d", points_2d)
        _keep_paths(self, "image")
        for name in ("sigma", "scores"):
            if (value := getattr(self, name)) is not None:
                checked = as_floats(value, name=name, shape=(len(points_3d),))
                object.__setattr__(self, name, checked)
        if self.depths is None:
            if self.evidence.depth_sigma is not None and self.evidence.depth is None:
                raise InputError("given without depth", where="depth_sigma", fix="give depth, too")
            return
        if self.evidence.depth is not None:
            raise InputError(
                "a depth image and depths of keypoints are given",
                where="depth",
                fix="leave out one of the two",
            )
        depths = np.asarray(self.depths, dtype=np.float64)
        if depths.shape != (len(points_3d),):
            what = f"shape {depths.shape}, expected ({len(points_3d)},)"
            raise InputError(what, where="depths")
        object.__setattr__(self, "depths", depths)

    @property
    def has_more(self) -> bool:
        """True where more than keypoints is known."""
        return self.depths is not None or bool(self.evidence.given)


def _keep_paths(given: object, *names: str) -> None:
    """Make paths of the texts in some fields of a frozen dataclass; None stays."""
    for name in names:
        if (value := getattr(given, name)) is not None:
            object.__setattr__(given, name, as_path(value, name))
