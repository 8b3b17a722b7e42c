"""`cadalign fit` with a shape, several views or evidence beyond keypoints, by `align`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import fields
from typing import TYPE_CHECKING, Any

from cadalign.cli.options import named_as_flags
from cadalign.errors import InputError
from cadalign.estimation.align import align
from cadalign.estimation.model import Model
from cadalign.estimation.observed import model_of, size_of, views_of
from cadalign.estimation.options import FitOptions
from cadalign.estimation.result import Result
from cadalign.geometry.mesh import Mesh
from cadalign.io.documents import in_file
from cadalign.io.observation import Observation
from cadalign.render.drawing.color import ByteImage
from cadalign.render.drawing.result_overlay import draw_result, mesh_of
from cadalign.shapes.model import ShapeModel

if TYPE_CHECKING:
    from cadalign.cli.fit import Fit

_RANSAC = ("max_reproj_error", "seed")  # options that the search for inliers has here
_SWITCHES = ("exif", "scale_prior")  # options that are on
_OF_THE_MODEL = ("stretch", "known_axis", "scale_prior_sigma")  # options that a learned shape lacks


def fit_joint(
    command: Fit, observation: Observation, status: AbstractContextManager[Any]
) -> tuple[Result, list[ByteImage], Mesh | None]:
    """Align to all evidence; returns the result, a picture of every view and the object's mesh.

    ``status`` is entered while the alignment is computed.
    """
    _check_flags(command, observation)
    options = command.options_for(observation)
    if options.focal == "estimate":
        is_shaped = command.shape_of(observation) or command.shape_sigma
        beside = "a shape" if is_shaped else f"the file's {_evidence(observation)}"
        raise InputError(
            f"the focal length is unknown, and is not estimated together with {beside}",
            where=f"{command.observation}: camera",
            fix="write into the file what `cadalign fit` without a shape estimates",
        )
    model = _model(command, observation, options)
    with in_file(command.observation):
        views = views_of(observation, model, sigma=command.sigma_for_all(observation))
        size = size_of(observation)
    with status, _located(command):
        result = align(
            model,
            views,
            size=size,
            init=observation.init,
            loss=options.loss,
            loss_scale=options.loss_scale,
            ransac=command.ransac if command.robust else None,
        )
    mesh = mesh_of(observation, result)
    drawn = zip(observation.views, views, strict=True) if command.picture else ()
    pictures = [
        draw_result(image, result, mesh=mesh, mask=view.mask_image, number=number)
        for number, (image, view) in enumerate(drawn)
    ]
    return result, pictures, mesh


@contextmanager
def _located(command: Fit) -> Iterator[None]:
    """Let errors about arguments name the command line's option, or else the file."""
    try:
        with named_as_flags(command):
            yield
    except InputError as error:
        if str(error.where).startswith("--"):
            raise
        with in_file(command.observation):
            raise


def _evidence(observation: Observation) -> str:
    """Name of the first field of a file that `cadalign.fit` does not take."""
    if observation.others:
        return "views"
    if observation.depths is not None:
        return "depth"
    return next(iter(observation.evidence.given), "size" if observation.size else "init")


def _model(command: Fit, observation: Observation, options: FitOptions) -> Model | ShapeModel:
    shape = command.shape_of(observation)
    if shape is not None:
        if observation.symmetry is not None:
            raise InputError(
                "has no effect together with a learned shape",
                where=f"{command.observation}: symmetry",
                fix="leave out one of the two",
            )
        return ShapeModel.open(shape)
    from cadalign.datasets import load_mesh

    mesh = None if observation.model is None else load_mesh(observation.model)
    with _located(command):
        return model_of(observation, options=options, shape_sigma=command.shape_sigma, mesh=mesh)


def _check_flags(command: Fit, observation: Observation) -> None:
    """Refuse options that have no effect with the evidence."""
    if command.shape is not None and command.shape_sigma is not None:
        raise InputError(
            "--shape has learned how far objects of the category differ",
            where="--shape-sigma",
            fix="give one of the two options",
        )
    learned = command.shape_of(observation)
    is_shaped = learned is not None or command.shape_sigma is not None
    switches = _SWITCHES if is_shaped else ("exif",)
    changed = [name for name in ("similar", "focal", *switches) if _is_changed(command, name)]
    names = ["method", *(_OF_THE_MODEL if learned is not None else ())]
    changed += [name for name in names if _is_changed(command.fitting, name)]
    names = [field.name for field in fields(command.ransac) if field.name not in _RANSAC]
    changed += [name for name in names if _is_changed(command.ransac, name)]
    for name in changed:
        where = ("--no-" if name in (*_SWITCHES, "refine") else "--") + name.replace("_", "-")
        raise InputError(
            f"has no effect together with {_cause(command, observation)}",
            where=where,
            fix="leave out one of the two",
        )


def _cause(command: Fit, observation: Observation) -> str:
    """Name of what makes the fit a joint one."""
    if command.shape is not None:
        return "--shape"
    if command.shape_sigma is not None:
        return "--shape-sigma"
    return f"the file's {'shape' if command.shape_of(observation) else _evidence(observation)}"


def _is_changed(options: Any, name: str) -> bool:
    (default,) = (field.default for field in fields(options) if field.name == name)
    return bool(getattr(options, name) != default)
