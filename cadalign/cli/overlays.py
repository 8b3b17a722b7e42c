"""Pictures of the aligned model over the photos of an observation, for `cadalign fit --overlay`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cadalign.datasets import load_mesh
from cadalign.errors import InputError
from cadalign.estimation.result import Result
from cadalign.geometry.mesh import Mesh
from cadalign.io.observation import Observation
from cadalign.render import OverlayStyle, Scene, overlay_model
from cadalign.render.drawing.color import ByteImage
from cadalign.render.drawing.result_overlay import photo_of

if TYPE_CHECKING:
    from cadalign.cli.fit import Fit


def overlay_style(command: Fit, observation: Observation, *, is_learned: bool) -> OverlayStyle:
    """The style that the options ask for.

    Raises
    ------
    InputError
        If the opacity is out of range, or the observation names no model to draw.
    """
    if observation.model is None and not is_learned:
        raise InputError(
            f"{command.observation} names no model to draw",
            where="--overlay",
            fix="give the file's `model` a mesh, or leave out the option",
        )
    try:
        return OverlayStyle(mode=command.overlay_mode, opacity=command.overlay_opacity)
    except InputError as error:
        flag = f"--overlay-{error.where}"
        raise InputError(error.what, where=flag, fix=error.fix) from None


def draw_overlays(
    observation: Observation,
    result: Result,
    mesh: Mesh | None,
    style: OverlayStyle,
) -> tuple[ByteImage, ...]:
    """Draw the overlay of every view.

    ``mesh`` is the object's; by default the observation's model.

    Raises
    ------
    InputError
        If there is no mesh.
    """
    if mesh is None:
        if observation.model is None:
            raise InputError("no mesh of the object is known", where="--overlay")
        mesh = load_mesh(observation.model)
    scene = Scene(mesh)
    pictures = []
    for image, view in zip(observation.views, result.views, strict=True):
        photo = photo_of(image, view.camera)
        pictures.append(overlay_model(photo, view.camera, scene, view.alignment, style=style))
    return tuple(pictures)
