"""Estimates of the methods, as alignments of the data set's model."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.estimation.align import align
from cadalign.estimation.fit import fit
from cadalign.estimation.model import Model
from cadalign.estimation.options import SIMILAR_SCALE_SIGMA
from cadalign.estimation.result import Result
from cadalign.estimation.view import View
from cadalign.evaluation.instances.record import box_alignment
from cadalign.evaluation.methods.method import SHAPE, Method, MethodInput
from cadalign.evaluation.outcome import LeftOutError
from cadalign.evaluation.photos.protocols import (
    DEPTH,
    EPNP,
    GRAVITY,
    MASK,
    PRIOR,
    RIGID,
    SIMILAR,
    STRETCHED,
    TRUTH,
    Protocol,
    parts_of,
)
from cadalign.evaluation.photos.sighting import Sighting
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.box import Box
from cadalign.geometry.mesh import Mesh
from cadalign.shapes.model import ShapeModel

_UP_SIGMA_DEG = 3.0  # of rigs and phones, and of objects that stand upright
_UP_OF_MODELS = "y"  # what `Model` takes for up


@dataclass(frozen=True, eq=False)
class PhotoEstimate:
    """An estimate of an object.

    Parameters
    ----------
    alignment : Alignment
        Of the data set's model, in its own unit: takes its box to the estimated one.
    box : Box
        The object's box in the camera's frame.
    result : Result, optional
        With shape and covariances.
    """

    alignment: Alignment
    box: Box
    result: Result | None = None


@dataclass(frozen=True, eq=False)
class PhotoInstance:
    """An object in a photo, with what methods are given of it.

    Parameters
    ----------
    sighting : Sighting
    protocol : Protocol
        Of the data set.
    shapes : tuple of ShapeModel
        Each for the category that it names.
    similar_sigma : float
        Standard deviation of the object's keypoints from the model's [diagonals of the model].
    is_shown : bool
        Its pictures are drawn.
    """

    sighting: Sighting
    protocol: Protocol
    shapes: tuple[ShapeModel, ...]
    similar_sigma: float
    is_shown: bool


def photo_method(name: str) -> Method:
    """The method of a name; see `cadalign.evaluation.photos.protocols`."""
    return Method(name, partial(estimate_object, name))


def estimate_object(method: str, instance: PhotoInstance) -> PhotoEstimate:
    """The estimate of a method.

    Raises
    ------
    LeftOutError
        If the object lacks what the method needs.
    CadalignError
        If there is no estimate.
    """
    sighting = instance.sighting
    base, evidence = parts_of(method)
    if base == TRUTH:
        return _truth(sighting)
    if base == EPNP:
        points = sighting.points_3d * sighting.width
        found = fit(points, sighting.points_2d, sighting.camera, method="epnp")
        return _of_model(found.alignment, sighting)
    if base == SHAPE:
        return _of_shape(sighting, instance.shapes, evidence)
    model = _model(base, sighting, instance.similar_sigma, with_mesh=MASK in evidence)
    result = align(model, _view(sighting, evidence, up_axis=_up_axis(sighting)))
    return _of_model(result.alignment, sighting, result)


def given_of(instance: PhotoInstance) -> MethodInput:
    """An object as general methods are given it."""
    sighting = instance.sighting
    return MethodInput(
        sighting.points_3d * sighting.width,
        sighting.points_2d,
        sighting.camera,
        sighting.sigma,
        bounds=sighting.bounds * sighting.width,
        gt=sighting.target.gt,
        make_views=lambda: _with_all_evidence(instance),
    )


def _with_all_evidence(instance: PhotoInstance) -> tuple[Model, list[View]]:
    """The model to be stretched, and the view with all evidence that there is for it."""
    sighting = instance.sighting
    target, up_axis = sighting.target, _up_axis(sighting)
    has_mesh = target.cad is not None and target.cad.has_mesh
    kinds = {
        MASK: has_mesh and target.found.mask_path is not None,
        DEPTH: target.photo.depth is not None,
        GRAVITY: target.photo.up is not None and up_axis is not None,
    }
    evidence = [kind for kind, is_there in kinds.items() if is_there]
    model = _model(STRETCHED, sighting, instance.similar_sigma, with_mesh=has_mesh)
    return model, [_view(sighting, evidence, up_axis=up_axis)]


def estimate_of_answer(answer: Alignment | Result, sighting: Sighting) -> PhotoEstimate:
    """The estimate of an object by a general method's answer."""
    if isinstance(answer, Alignment):
        return _of_model(answer, sighting)
    is_of_model = tuple(answer.ids) == tuple(sighting.model.names)
    return _of_model(answer.alignment, sighting, answer if is_of_model else None)


def _up_axis(sighting: Sighting) -> str | None:
    return _UP_OF_MODELS if sighting.up_axis == _UP_OF_MODELS else None


def _truth(sighting: Sighting) -> PhotoEstimate:
    gt, box = sighting.target.gt, sighting.target.gt_box
    if gt is None or box is None:
        raise LeftOutError("the true pose is not known")
    return PhotoEstimate(gt, box)


def _model(base: str, sighting: Sighting, similar_sigma: float, *, with_mesh: bool) -> Model:
    """The data set's model with the object's width."""
    width, bounds = sighting.width, sighting.bounds * sighting.width
    kind: dict[str, Any] = {}
    if base == RIGID:
        kind = {"stretch": "none"}
    elif base == PRIOR:
        kind = {"scale_prior_sigma": SIMILAR_SCALE_SIGMA}
    elif base == SIMILAR:
        diagonal = float(np.linalg.norm(np.ptp(bounds, axis=0)))
        kind = {"shape_sigma": similar_sigma * diagonal}
    return Model(
        points_3d=sighting.model.xyz * width,
        ids=sighting.model.names,
        bounds=bounds,
        mesh=_mesh(sighting) if with_mesh else None,
        **kind,
    )


def _mesh(sighting: Sighting) -> Mesh:
    cad = sighting.target.cad
    if cad is None or not cad.has_mesh:
        raise LeftOutError("the model has no mesh for the mask")
    mesh = cad.scene.mesh
    return Mesh(mesh.vertices * sighting.width, mesh.faces)


def _view(
    sighting: Sighting, evidence: Collection[str], *, up_axis: str | None, rows: Any = slice(None)
) -> View:
    """The photo's view of the object, with some of the evidence it has."""
    photo, found = sighting.target.photo, sighting.target.found
    given: dict[str, Any] = {}
    if MASK in evidence:
        if found.mask_path is None:
            raise LeftOutError("the object has no mask")
        given["mask"] = found.read_mask()
    if DEPTH in evidence:
        if photo.depth is None:
            raise LeftOutError("the photo has no depth")
        given["depth"] = photo.depth.read()
    if GRAVITY in evidence:
        if photo.up is None:
            raise LeftOutError("the direction of gravity is not known")
        if up_axis is None:
            raise LeftOutError("gravity needs a model whose y axis points up, or a shape model")
        given |= {"up": photo.up, "up_sigma_deg": _UP_SIGMA_DEG}
    names = tuple(np.array(sighting.names)[rows].tolist())
    pixels = sighting.points_2d[rows]
    return View(sighting.camera, pixels, ids=names, sigma=sighting.sigma, **given)


def _of_model(found: Alignment, sighting: Sighting, result: Result | None = None) -> PhotoEstimate:
    """The estimate of the data set's model, from that of the model with the object's width."""
    bounds = sighting.bounds * sighting.width if result is None else result.bounds
    box = Box.from_model(bounds, found)
    scale = found.scale * sighting.width
    alignment = Alignment(found.rotation, found.translation, scale)
    return PhotoEstimate(alignment, box, result)


def _of_shape(
    sighting: Sighting, shapes: Collection[ShapeModel], evidence: Collection[str]
) -> PhotoEstimate:
    category = sighting.target.found.category
    shape = next((each for each in shapes if each.category == category), None)
    if shape is None:
        raise LeftOutError(f"there is no shape model of {category}")
    if MASK in evidence:
        raise LeftOutError("a shape model has no mesh for the mask")
    known = np.isin(sighting.names, [str(name) for name in shape.ids])
    if not known.any():
        raise LeftOutError("the shape model has none of the keypoints")
    view = _view(sighting, evidence, up_axis=shape.up_axis, rows=known)
    result = align(shape, view)
    box = result.box
    factor = 1.0 if shape.unit == "m" else _width_factor(sighting, box)
    moved = _enlarged(result.alignment, factor)
    alignment = box_alignment(moved, result.bounds, model_bounds=sighting.bounds)
    return PhotoEstimate(alignment, Box.from_model(result.bounds, moved), result)


def _width_factor(sighting: Sighting, box: Box) -> float:
    """Factor that gives an estimated box the object's width, where that is known."""
    wanted = float(np.ptp(sighting.bounds[:, 0])) * sighting.width
    return wanted / float(box.extents[0]) if sighting.target.gt is not None else 1.0


def _enlarged(alignment: Alignment, factor: float) -> Alignment:
    """The alignment scaled about the camera centre."""
    shift: FloatArray = alignment.translation * factor
    return Alignment(alignment.rotation, shift, alignment.scale * factor)
