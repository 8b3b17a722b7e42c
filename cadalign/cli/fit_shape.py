"""`cadalign fit` with a shape: the object's own shape is estimated with its pose."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import fields
from typing import TYPE_CHECKING, Any

from cadalign.cli.options import named_as_flags
from cadalign.errors import InputError
from cadalign.fitting.joint.align import align
from cadalign.fitting.joint.model import Model
from cadalign.fitting.joint.observed import similar_model, view_of
from cadalign.fitting.joint.result import AlignResult
from cadalign.fitting.options import FitOptions, Sigma
from cadalign.io.documents import in_file
from cadalign.io.observation import Observation
from cadalign.render.drawing.align_overlay import draw_aligned, mesh_of
from cadalign.render.drawing.color import ByteImage
from cadalign.shapes.model import ShapeModel

if TYPE_CHECKING:
    from cadalign.cli.fit import Fit

_RANSAC = ("max_reproj_error", "seed")  # options that the search for inliers has here
_SWITCHES = ("exif", "scale_prior")  # options that are on
_OF_THE_MODEL = ("stretch", "known_axis", "scale_prior_sigma")  # options that a learned shape lacks


def fit_shape(command: Fit, status: AbstractContextManager[Any]) -> tuple[AlignResult, ByteImage]:
    """Align with a learned shape, or with a model that is only similar; gives result and picture.

    ``status`` is entered while the alignment is computed.
    """
    _check_flags(command)
    path = command.observation
    observation = Observation.load(path, needs_xyz=command.shape is None)
    options = command.options_for(observation)
    if options.focal == "estimate":
        raise InputError(
            "the focal length is unknown, and is not estimated together with a shape",
            where=f"{path}: camera",
            fix="write into the file what `cadalign fit` without a shape estimates",
        )
    model = _model(command, observation, options)
    sigma: Sigma = command.sigma_of(observation) if options.sigma is None else options.sigma
    with in_file(path):
        view = view_of(observation, model, sigma=sigma)
    with status, named_as_flags(command):
        result = align(
            model,
            view,
            loss=options.loss,
            loss_scale=options.loss_scale,
            ransac=command.ransac if command.robust else None,
        )
    mesh = mesh_of(observation, view, result)
    return result, draw_aligned(observation, view, result, mesh=mesh)


def _model(command: Fit, observation: Observation, options: FitOptions) -> Model | ShapeModel:
    if command.shape is not None:
        return ShapeModel.open(command.shape)
    from cadalign.datasets import load_mesh

    assert command.shape_sigma is not None
    mesh = None if observation.model is None else load_mesh(observation.model)
    with named_as_flags(command):
        return similar_model(
            observation, shape_sigma=command.shape_sigma, options=options, mesh=mesh
        )


def _check_flags(command: Fit) -> None:
    """Refuse options that have no effect with a shape."""
    if command.shape is not None and command.shape_sigma is not None:
        raise InputError(
            "--shape has learned how far objects of the category differ",
            where="--shape-sigma",
            fix="give one of the two options",
        )
    flag = "--shape" if command.shape is not None else "--shape-sigma"
    changed = [name for name in ("similar", "focal", *_SWITCHES) if _is_changed(command, name)]
    names = ["method", *(_OF_THE_MODEL if command.shape is not None else ())]
    changed += [name for name in names if _is_changed(command.fitting, name)]
    names = [field.name for field in fields(command.ransac) if field.name not in _RANSAC]
    changed += [name for name in names if _is_changed(command.ransac, name)]
    for name in changed:
        where = ("--no-" if name in (*_SWITCHES, "refine") else "--") + name.replace("_", "-")
        raise InputError(
            f"has no effect together with {flag}", where=where, fix="leave out one of the two"
        )


def _is_changed(options: Any, name: str) -> bool:
    (default,) = (field.default for field in fields(options) if field.name == name)
    return bool(getattr(options, name) != default)
