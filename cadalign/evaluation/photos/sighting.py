"""Keypoints and cameras of objects in photos that methods are given."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.datasets.photos.photo import NamedPoints, PhotoKeypoints
from cadalign.estimation.fit import fit
from cadalign.evaluation.photos.options import PhotosOptions, Protocol
from cadalign.evaluation.photos.target import PhotoTarget, rectangle_of
from cadalign.evaluation.runs.work import LeftOutError
from cadalign.geometry.camera import Camera

ANNOTATED, DETECTED = "annotated", "detected"
_LEAST_SCORE = 0.4  # of a detected keypoint that methods are given
_LEAST_PX = 0.5  # a standard deviation that keypoints are given at least
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
    good = np.isin(marks.names, model.names)
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
