"""Work of `cadalign render`: arguments checked, files read, pictures drawn and written."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from cadalign.arrays import FloatArray, as_floats, as_points
from cadalign.datasets.models.model_keypoints import ModelKeypoints
from cadalign.errors import DataError, InputError
from cadalign.geometry.camera import Camera
from cadalign.io.documents import read_json
from cadalign.io.images import JPEG_ENDING
from cadalign.io.meshes.files import load_mesh
from cadalign.render.drawing.canvas import ByteImage
from cadalign.render.drawing.pictures import (
    VIEWS,
    Angles,
    contact_sheet,
    keypoint_picture,
    pose_in_view,
)
from cadalign.render.probe import make_renderer
from cadalign.render.scene import Renderer, Scene, check_image_size
from cadalign.render.viewpoints import visible_keypoints

if TYPE_CHECKING:
    from cadalign.cli.render import Render

_ENDINGS = (".png", JPEG_ENDING)


@dataclass(frozen=True, eq=False)
class RenderJob:
    """Everything that a picture needs beside the command's options, checked."""

    command: Render
    scene: Scene
    renderer: Renderer
    views: dict[str, Angles]
    camera: Camera
    keypoints: FloatArray | None

    @classmethod
    def of(cls, command: Render) -> RenderJob:
        """Check the options of the command line and read the files that they name."""
        camera = Camera.from_fov(*parse_size(command.size), fov_x=command.fov)
        check_image_size(camera)
        ending = command.out.suffix.lower()
        if ending not in _ENDINGS:
            fix = f"give a name that ends in {' or '.join(_ENDINGS)}"
            raise InputError(
                f"{command.out.name} is neither a PNG nor a JPEG file", where="--out", fix=fix
            )
        stretch = as_floats(command.scale, name="--scale", shape=(3,))
        if (stretch <= 0).any():
            raise InputError(f"{command.scale} is not positive", where="--scale")
        views = dict(view for word in command.view for view in _views(word).items())
        if not views:
            raise InputError("no view is given", where="--view", fix="give one or more")
        path = command.keypoints
        mesh = load_mesh(command.model)
        renderer = make_renderer(command.renderer)
        keypoints = None if path is None else read_keypoints(path, command.model)
        return cls(command, Scene(mesh), renderer, views, camera, keypoints)

    def _draw(self, view: Angles) -> ByteImage:
        """One picture, (h, w, 3) uint8."""
        samples, camera = self.command.samples, self.camera
        pose = pose_in_view(self.scene, camera, view, scale=self.command.scale)
        image = self.renderer.render(self.scene, camera, pose, samples=samples).composite()
        if self.keypoints is None:
            return image
        visible = visible_keypoints(self.scene, self.keypoints, camera, pose)
        return keypoint_picture(image, camera, self.keypoints, pose, visible=visible)

    def picture(self) -> ByteImage:
        """Draw a still, or a contact sheet if there are several views."""
        images = [self._draw(view) for view in self.views.values()]
        if len(images) == 1:
            return images[0]
        return contact_sheet(images, list(self.views))


def parse_size(text: str) -> tuple[int, int]:
    """Read an image size ``WIDTHxHEIGHT``."""
    match = re.fullmatch(r"(\d{1,9})[xX](\d{1,9})", text.strip())
    if match is None or not (int(match[1]) and int(match[2])):
        raise InputError(
            f"{text!r} is not an image size", where="--size", fix="give WIDTHxHEIGHT, as 640x480"
        )
    return int(match[1]), int(match[2])


def read_keypoints(path: Path, model: Path) -> FloatArray:
    """Read keypoints (k, 3) from a list of [x, y, z] or as `ModelKeypoints.load` does."""
    data = read_json(path)
    if isinstance(data, dict) or (isinstance(data, list) and data and isinstance(data[0], dict)):
        return ModelKeypoints.load(path, model=model).xyz
    try:
        return as_points(data, name="keypoints", dimension=3)
    except InputError as error:
        raise DataError(error.what, where=str(path), fix="give a list of [x, y, z]") from None


def _views(word: str) -> dict[str, Angles]:
    if word == "all":
        return {name: Angles(*angles) for name, angles in VIEWS.items()}
    return {word: Angles.parse(word)}
