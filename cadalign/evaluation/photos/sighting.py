"""One object of a photo as methods get it: keypoints, model, camera and evidence; and its truth."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from cadalign.arrays import BoolArray, FloatArray
from cadalign.datasets.photos.photo import NamedPoints, PhotoObject
from cadalign.estimation.fit import fit
from cadalign.evaluation.outcome import LeftOutError
from cadalign.evaluation.photos.protocols import SIMULATED, KeypointOptions, Protocol
from cadalign.evaluation.photos.target import Cad, PhotoTarget, rectangle_of
from cadalign.geometry.camera import Camera
from cadalign.render.views.visibility import visible_keypoints
from cadalign.seeding import instance_rng

ANNOTATED, DETECTED = "annotated", "detected"
_LEAST_PX = 0.5  # a standard deviation that keypoints are given at least
_RIM = 2  # width of a mask's rim [px]
_FOCAL_PRIOR = 0.2  # of the logs of scales, while the focal length is estimated


@dataclass(frozen=True, eq=False)
class Sighting:
    """The keypoints of an object that methods are given.

    Parameters
    ----------
    target : PhotoTarget
    camera : Camera
        With a focal length.
    source : {"annotated", "detected", "simulated"}
        Where the keypoints come from.
    names : tuple of n str
        The given keypoints.
    points_2d : (n, 2) float
        [px]
    sigma : float
        Their standard deviation [px].
    model : NamedPoints
        All keypoints of the model, in its own unit.
    bounds : (2, 3) float
        The model's box, in its own unit.
    width : float
        Factor of the model's size that gives it the object's width.
    up_axis : str
        The model's upward axis.
    """

    target: PhotoTarget
    camera: Camera
    source: str
    names: tuple[str, ...]
    points_2d: FloatArray
    sigma: float
    model: NamedPoints
    bounds: FloatArray
    width: float
    up_axis: str

    @property
    def points_3d(self) -> FloatArray:
        """The given keypoints on the model (n, 3), in its own unit."""
        row_of = {name: row for row, name in enumerate(self.model.names)}
        return self.model.xyz[[row_of[name] for name in self.names]]


def sight(target: PhotoTarget, protocol: Protocol, options: KeypointOptions) -> Sighting:
    """Collect what methods are given of an object.

    Raises
    ------
    LeftOutError
        If it has no camera, no model, or too few keypoints.
    DataError
        If its model cannot be read.
    """
    camera, cad = target.camera, target.cad
    if camera is None:
        raise LeftOutError("the photo's camera is not known")
    if cad is None:
        raise LeftOutError("no model is annotated for the object")
    model = cad.model.load_keypoints()
    marks = target.found.keypoints
    if marks is not None and model is not None and not protocol.marks_are_truth:
        source = ANNOTATED if marks.scores is None else DETECTED
        names, pixels = _marked(target.found, model, options.min_score)
    else:
        source = SIMULATED
        model, names, pixels = _simulated(target, camera, cad, model, options)
    if len(names) < options.min_keypoints:
        raise LeftOutError(f"{len(names)} keypoints are fewer than {options.min_keypoints}")
    bounds, gt = target.bounds, target.gt
    assert bounds is not None  # of the keypoints at least
    has_stretch = gt is not None and target.found.truth.cam_from_model is not None
    sighting = Sighting(
        target=target,
        camera=camera,
        source=source,
        names=names,
        points_2d=pixels,
        sigma=_sigma(target, protocol, options, source),
        model=model,
        bounds=bounds,
        width=float(gt.scale[0]) if gt is not None and has_stretch else 1.0,
        up_axis=protocol.up_axis,
    )
    return sighting if camera.focal_known else _calibrated(sighting)


def _marked(
    found: PhotoObject, model: NamedPoints, min_score: float
) -> tuple[tuple[str, ...], FloatArray]:
    """The visible keypoints that the model has, and their pixels."""
    marks = found.keypoints
    assert marks is not None
    good = marks.visible & np.isin(marks.names, model.names)
    if marks.scores is not None:
        good &= marks.scores > min_score
    return tuple(np.array(marks.names)[good].tolist()), marks.points_2d[good]


def _simulated(
    target: PhotoTarget,
    camera: Camera,
    cad: Cad,
    model: NamedPoints | None,
    options: KeypointOptions,
) -> tuple[NamedPoints, tuple[str, ...], FloatArray]:
    """Points of the model, those that the photo shows, and their pixels with noise.

    Of a model without a mesh they are its keypoints, whatever hides them.
    """
    gt = target.found.truth.cam_from_model
    if gt is None:
        raise LeftOutError("there are no keypoints, nor a pose to simulate them with")
    if not camera.focal_known:
        raise LeftOutError("there are no keypoints, nor a focal length to simulate them with")
    if cad.has_mesh:
        model = cad.spread_points(options.simulated_points)
        seen = visible_keypoints(cad.scene, model.xyz, camera, gt)
        if target.found.mask_path is not None and seen.any():
            seen[seen] = _in_mask(
                target.found.read_mask(), camera.project(gt.apply(model.xyz[seen]))
            )
    elif model is not None:
        pixels = camera.project_where_ahead(gt.apply(model.xyz))
        seen = np.isfinite(pixels).all(axis=1) & camera.contains(pixels)
    else:
        raise LeftOutError("there are neither keypoints nor a mesh to simulate them on")
    name = target.names["model_id"]
    noise = instance_rng(options.seed, name, "keypoints").standard_normal((len(model), 2))
    pixels = camera.project_where_ahead(gt.apply(model.xyz)) + options.simulated_noise_px * noise
    return model, tuple(np.array(model.names)[seen].tolist()), pixels[seen]


def _in_mask(mask: BoolArray, pixels: FloatArray) -> BoolArray:
    """True for pixels (n, 2) in a mask or at its rim, where silhouettes have their corners."""
    near = ndimage.binary_dilation(mask, iterations=_RIM)
    columns, rows = np.round(pixels).astype(int).T
    height, width = mask.shape
    return np.asarray(near[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)])


def _sigma(target: PhotoTarget, protocol: Protocol, options: KeypointOptions, source: str) -> float:
    """The standard deviation of keypoints [px] that methods are given."""
    if source == SIMULATED:
        return max(options.simulated_noise_px, _LEAST_PX)
    if options.sigma is not None:
        return options.sigma
    if protocol.sigma_of_width is not None and target.photo.camera is not None:
        return protocol.sigma_of_width * target.photo.camera.width
    left, top, right, bottom = rectangle_of(target.found)
    return max(protocol.sigma_of_side * float(max(right - left, bottom - top)), _LEAST_PX)


def _calibrated(sighting: Sighting) -> Sighting:
    """The sighting with an estimated focal length."""
    found = fit(
        sighting.points_3d * sighting.width,
        sighting.points_2d,
        sighting.camera,
        sigma=sighting.sigma,
        scale_prior_sigma=_FOCAL_PRIOR,
        focal="estimate",
    )
    return replace(sighting, camera=found.camera)
