"""Objects of photos as methods get them, and their estimates of the data set's model."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.datasets.photos.photo import NamedPoints, PhotoKeypoints
from cadalign.estimation.align import align
from cadalign.estimation.fit import fit
from cadalign.estimation.model import Model
from cadalign.estimation.options import SIMILAR_SCALE_SIGMA
from cadalign.estimation.result import Result
from cadalign.estimation.view import View
from cadalign.evaluation.instances.record import box_alignment
from cadalign.evaluation.methods import SHAPE
from cadalign.evaluation.photos.options import (
    EPNP,
    GRAVITY,
    IMAGE,
    MASK,
    PRIOR,
    RIGID,
    SIMILAR,
    STRETCHED,
    TRUTH,
    PhotosOptions,
    Protocol,
    parts_of,
)
from cadalign.evaluation.photos.target import PhotoTarget, rectangle_of
from cadalign.evaluation.runs.work import LeftOutError
from cadalign.geometry.alignment import Alignment, Box
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh
from cadalign.shapes.model import ShapeModel

ANNOTATED, DETECTED = "annotated", "detected"
_LEAST_SCORE = 0.4  # of a detected keypoint that methods are given
_LEAST_PX = 0.5  # a standard deviation that keypoints are given at least
# Evidence about the model's outline, which needs a mesh.
_OUTLINED = frozenset({MASK, IMAGE})
_FOCAL_PRIOR = 0.2  # of the logs of scales, while the focal length is estimated


@dataclass(frozen=True, eq=False)
class Sighting:
    """The keypoints of an object that methods are given."""

    target: PhotoTarget
    camera: Camera  # with a focal length
    source: str  # annotated or detected: where the keypoints come from
    names: tuple[str, ...]  # (n,), the given keypoints
    points_2d: FloatArray  # (n, 2), [px]
    sigma: float  # their standard deviation [px]
    model: NamedPoints  # all keypoints of the model, in its own unit
    bounds: FloatArray  # (2, 3), the model's box, in its own unit
    width: float  # factor of the model's size that gives it the object's width
    protocol: Protocol  # of the data set

    @property
    def points_3d(self) -> FloatArray:
        """The given keypoints on the model (n, 3), in its own unit."""
        row_of = {name: row for row, name in enumerate(self.model.names)}
        return self.model.xyz[[row_of[name] for name in self.names]]


def sight(target: PhotoTarget, protocol: Protocol, options: PhotosOptions) -> Sighting:
    """Collect what methods are given of an object.

    Raises LeftOutError if it has no camera, no model, or too few keypoints; and DataError if its
    model cannot be read.
    """
    camera, cad = target.camera, target.cad
    if camera is None:
        raise LeftOutError("the photo's camera is not known")
    if cad is None:
        raise LeftOutError("no model is annotated for the object")
    model = cad.model.load_keypoints()
    marks = target.found.keypoints
    if marks is None or model is None:
        raise LeftOutError("there are no keypoints")
    names, pixels = _marked(marks, model)
    if len(names) < options.min_keypoints:
        raise LeftOutError(f"{len(names)} keypoints are fewer than {options.min_keypoints}")
    bounds, gt = target.bounds, target.gt
    assert bounds is not None  # of the keypoints at least
    sighting = Sighting(
        target=target,
        camera=camera,
        source=ANNOTATED if marks.scores is None else DETECTED,
        names=names,
        points_2d=pixels,
        sigma=_sigma(target, protocol, options),
        model=model,
        bounds=bounds,
        width=1.0 if gt is None else float(gt.scale[0]),
        protocol=protocol,
    )
    return sighting if camera.focal_known else _calibrated(sighting)


def _marked(marks: PhotoKeypoints, model: NamedPoints) -> tuple[tuple[str, ...], FloatArray]:
    """The visible keypoints that the model has, and their pixels."""
    good = marks.visible & np.isin(marks.names, model.names)
    if marks.scores is not None:
        good &= marks.scores > _LEAST_SCORE
    return tuple(np.array(marks.names)[good].tolist()), marks.points_2d[good]


def _sigma(target: PhotoTarget, protocol: Protocol, options: PhotosOptions) -> float:
    """The standard deviation of keypoints [px] that methods are given."""
    if options.sigma is not None:
        return options.sigma
    if protocol.sigma_of_width is not None and target.photo.camera is not None:
        return protocol.sigma_of_width * target.photo.camera.width
    left, top, right, bottom = rectangle_of(target.found)
    return max(protocol.sigma_of_side * float(max(right - left, bottom - top)), _LEAST_PX)


def _calibrated(sighting: Sighting) -> Sighting:
    found = fit(
        sighting.points_3d * sighting.width,
        sighting.points_2d,
        sighting.camera,
        sigma=sighting.sigma,
        stretch_sigma=_FOCAL_PRIOR,
        focal="estimate",
    )
    return replace(sighting, camera=found.camera)


# Methods ------------------------------------------------------------------------------------------


_UP_SIGMA_DEG = 3.0  # of rigs and phones, and of objects that stand upright


@dataclass(frozen=True, eq=False)
class PhotoEstimate:
    """An estimate of an object."""

    alignment: Alignment
    """Takes the box of the data set's model, in its own unit, to the estimated one."""
    box: Box  # the object's box in the camera's frame
    result: Result | None = None  # with shape and covariances


def estimate_object(
    sighting: Sighting, *, method: str, shapes: Collection[ShapeModel], similar_sigma: float
) -> PhotoEstimate:
    """The estimate of a method by name; see `PhotosOptions.methods`.

    ``shapes`` are models of the categories that they name, ``similar_sigma`` is the standard
    deviation of the object's keypoints from the model's [diagonals of the model]. Raises
    LeftOutError if the object lacks what the method needs; and CadalignError if there is no
    estimate.
    """
    base, evidence = parts_of(method)
    if base == TRUTH:
        gt, box = sighting.target.gt, sighting.target.gt_box
        if gt is None or box is None:
            raise LeftOutError("the true pose is not known")
        return PhotoEstimate(gt, box)
    if base == EPNP:
        points = sighting.points_3d * sighting.width
        found = fit(points, sighting.points_2d, sighting.camera, method="epnp")
        return estimate_of_model(found.alignment, sighting)
    if base == SHAPE:
        return _of_shape(sighting, shapes, evidence)
    model = _model(base, sighting, similar_sigma, with_mesh=bool(_OUTLINED & evidence))
    result = align(model, _view(sighting, evidence))
    return estimate_of_model(result.alignment, sighting, result)


def with_all_evidence(sighting: Sighting) -> tuple[Model, list[View]]:
    """The model to be stretched, and the view with all evidence that there is for it."""
    target = sighting.target
    has_mesh = target.cad is not None and target.cad.has_mesh
    kinds = {
        MASK: has_mesh and target.found.mask_path is not None,
        GRAVITY: target.photo.up is not None,
    }
    evidence = [kind for kind, is_there in kinds.items() if is_there]
    model = _model(STRETCHED, sighting, 0.0, with_mesh=has_mesh)
    return model, [_view(sighting, evidence)]


def _model(base: str, sighting: Sighting, similar_sigma: float, *, with_mesh: bool) -> Model:
    width, bounds = sighting.width, sighting.bounds * sighting.width
    kind: dict[str, Any] = {}
    if base == RIGID:
        kind = {"stretch": "none"}
    elif base == PRIOR:
        kind = {"stretch_sigma": SIMILAR_SCALE_SIGMA}
    elif base == SIMILAR:
        diagonal = float(np.linalg.norm(np.ptp(bounds, axis=0)))
        kind = {"shape_sigma": similar_sigma * diagonal}
    if with_mesh:
        cad = sighting.target.cad
        if cad is None or not cad.has_mesh:
            raise LeftOutError("the model has no mesh for the mask")
        mesh = cad.scene.mesh
        kind["mesh"] = Mesh(mesh.vertices * width, mesh.faces)
    return Model(
        points_3d=sighting.model.xyz * width,
        ids=sighting.model.names,
        bounds=bounds,
        up_axis=sighting.protocol.up_axis,
        **kind,
    )


def _view(sighting: Sighting, evidence: Collection[str], *, rows: Any = slice(None)) -> View:
    photo, found = sighting.target.photo, sighting.target.found
    given: dict[str, Any] = {}
    if MASK in evidence:
        if found.mask_path is None:
            raise LeftOutError("the object has no mask")
        given["mask"] = found.read_mask()
    if GRAVITY in evidence:
        if photo.up is None:
            raise LeftOutError("the direction of gravity is not known")
        given |= {"up": photo.up, "up_sigma_deg": _UP_SIGMA_DEG}
    if IMAGE in evidence:
        if photo.image is None:
            raise LeftOutError("the image is not there")
        given["image"] = photo.read_image()
    names = tuple(np.array(sighting.names)[rows].tolist())
    pixels = sighting.points_2d[rows]
    return View(sighting.camera, pixels, ids=names, sigma=sighting.sigma, **given)


def estimate_of_model(
    found: Alignment, sighting: Sighting, result: Result | None = None
) -> PhotoEstimate:
    """The estimate of the data set's model, from that of the model with the object's width."""
    bounds = sighting.bounds * sighting.width if result is None else result.bounds
    box = Box.from_model(bounds, found)
    alignment = Alignment(found.rotation, found.translation, found.scale * sighting.width)
    return PhotoEstimate(alignment, box, result)


def _of_shape(
    sighting: Sighting, shapes: Collection[ShapeModel], evidence: Collection[str]
) -> PhotoEstimate:
    category = sighting.target.found.category
    shape = next((each for each in shapes if each.category == category), None)
    if shape is None:
        raise LeftOutError(f"there is no shape model of {category}")
    if _OUTLINED & frozenset(evidence):
        raise LeftOutError("a shape model has no mesh for the mask")
    if GRAVITY in evidence and shape.up_axis is None:
        raise LeftOutError("the shape model has no up axis for gravity")
    known = np.isin(sighting.names, [str(name) for name in shape.ids])
    if not known.any():
        raise LeftOutError("the shape model has none of the keypoints")
    view = _view(sighting, evidence, rows=known)
    result = align(shape, view)
    factor = 1.0
    if shape.unit != "m" and sighting.target.gt is not None:  # the object's width is known
        wanted = float(np.ptp(sighting.bounds[:, 0])) * sighting.width
        factor = wanted / float(result.box.extents[0])
    # Scaled about the camera centre.
    found, shift = result.alignment, result.alignment.translation * factor
    moved = Alignment(found.rotation, shift, found.scale * factor)
    alignment = box_alignment(moved, result.bounds, model_bounds=sighting.bounds)
    return PhotoEstimate(alignment, Box.from_model(result.bounds, moved), result)
