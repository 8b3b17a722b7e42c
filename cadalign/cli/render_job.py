"""Work of `cadalign render`: arguments checked, files read, pictures drawn and written."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from cadalign.arrays import FloatArray, as_floats, as_points
from cadalign.datasets.models.model_keypoints import ModelKeypoints
from cadalign.datasets.sfm.colmap import Colmap
from cadalign.errors import DataError, InputError, brief, refuse_unused
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh
from cadalign.io.documents import read_json
from cadalign.io.images import JPEG_ENDING
from cadalign.io.meshes.files import load_mesh
from cadalign.render.drawing.canvas import ByteImage, composite
from cadalign.render.drawing.pictures import (
    VIEWS,
    Angles,
    contact_sheet,
    draw_still,
    keypoint_picture,
    pose_in_view,
)
from cadalign.render.probe import make_renderer
from cadalign.render.scene import LIGHT_GREY, Renderer, Scene, check_image_size
from cadalign.render.viewpoints import visible_keypoints

if TYPE_CHECKING:
    from cadalign.cli.render import Render

_COLORS = {"grey": LIGHT_GREY, "white": (255, 255, 255), "black": (0, 0, 0)}
_ENDINGS = (".png", JPEG_ENDING)

LabelledView = tuple[str, Angles | tuple[Camera, Alignment]]
"""A label, and angles or a whole camera."""


@dataclass(frozen=True, eq=False)
class RenderJob:
    """Everything that a picture needs beside the command's options, checked."""

    command: Render
    scene: Scene
    renderer: Renderer
    views: tuple[LabelledView, ...]
    camera: Camera
    background: tuple[int, int, int] | None
    """None is transparent."""
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
        color = parse_background(command.background)
        stretch = as_floats(command.scale, name="--scale", shape=(3,))
        if (stretch <= 0).any():
            raise InputError(f"{command.scale} is not positive", where="--scale")
        views = tuple(view for word in command.view for view in _views(word, stretch))
        if views and not any(isinstance(view, Angles) for _, view in views):
            refuse_unused(command, ["size", "fov"], "beside a model of COLMAP, which has its own")
        if not views:
            raise InputError("no view is given", where="--view", fix="give one or more")
        _refuse_several_sizes(views, camera)
        path = command.keypoints
        if color is None and (ending != ".png" or len(views) > 1 or path is not None):
            what = "only a PNG still without keypoints can be transparent"
            raise InputError(what, where="--background")
        mesh = load_mesh(command.model)
        # Depth, normals, triangles and lines are cast in any case.
        renderer = make_renderer(command.renderer if command.style == "color" else "raycast")
        keypoints = None if path is None else read_keypoints(path, command.model, mesh)
        return cls(command, Scene(mesh), renderer, views, camera, color, keypoints)

    def _draw(self, camera: Camera, pose: Alignment) -> ByteImage:
        """One picture, (h, w, 3) uint8, or (h, w, 4) on a transparent background."""
        style, samples = self.command.style, self.command.samples
        color = draw_still(self.renderer, self.scene, camera, pose, style=style, samples=samples)
        if self.background is None:
            return color
        image = composite(color, self.background)
        if self.keypoints is None:
            return image
        visible = visible_keypoints(self.scene, self.keypoints, camera, pose)
        return keypoint_picture(image, camera, self.keypoints, pose, visible=visible)

    def picture(self) -> ByteImage:
        """Draw a still, or a contact sheet if there are several views."""
        images = []
        for _, view in self.views:
            if isinstance(view, Angles):
                scale = self.command.scale
                camera = self.camera
                pose = pose_in_view(self.scene, camera, view, scale=scale)
            else:
                camera, pose = view
            images.append(self._draw(camera, pose))
        if len(images) == 1:
            return images[0]
        background = self.background or LIGHT_GREY
        return contact_sheet(images, [label for label, _ in self.views], background=background)


def parse_size(text: str) -> tuple[int, int]:
    """Read an image size ``WIDTHxHEIGHT``."""
    match = re.fullmatch(r"(\d{1,9})[xX](\d{1,9})", text.strip())
    if match is None or not (int(match[1]) and int(match[2])):
        raise InputError(
            f"{text!r} is not an image size", where="--size", fix="give WIDTHxHEIGHT, as 640x480"
        )
    return int(match[1]), int(match[2])


def parse_background(text: str) -> tuple[int, int, int] | None:
    """Read a colour's name or ``#rrggbb``; None for ``transparent``."""
    if text == "transparent":
        return None
    if text in _COLORS:
        return _COLORS[text]
    if re.fullmatch(r"#[0-9a-fA-F]{6}", text):
        return int(text[1:3], 16), int(text[3:5], 16), int(text[5:7], 16)
    raise InputError(
        f"{text!r} is not a colour",
        where="--background",
        fix=f"give {', '.join(_COLORS)}, transparent, or #rrggbb",
    )


def read_keypoints(path: Path, model: Path, mesh: Mesh) -> FloatArray:
    """Read keypoints (k, 3) from a list of [x, y, z] or as `ModelKeypoints.load` does."""
    data = read_json(path)
    if isinstance(data, dict) or (isinstance(data, list) and data and isinstance(data[0], dict)):
        return ModelKeypoints.load(path, mesh=mesh, model=model).xyz
    try:
        return as_points(data, name="keypoints", dimension=3)
    except InputError as error:
        raise DataError(error.what, where=str(path), fix="give a list of [x, y, z]") from None


def _refuse_several_sizes(views: Sequence[LabelledView], camera: Camera) -> None:
    """Refuse views of several sizes, angles having ``camera``'s: no contact sheet holds them."""
    sizes = dict[str, str]()
    for label, view in views:
        used = camera if isinstance(view, Angles) else view[0]
        sizes.setdefault(f"{used.width}x{used.height}", label)
    if len(sizes) > 1:
        listed = ", ".join(f"{size} ({label})" for size, label in sizes.items())
        what = f"the views have several sizes, of which no contact sheet is made: {brief(listed)}"
        fix = "give those of one size; --size is that of angles"
        raise InputError(what, where="--view", fix=fix)


def _views(word: str, scale: FloatArray) -> list[LabelledView]:
    if word == "all":
        return [(name, Angles(*angles)) for name, angles in VIEWS.items()]
    if word in VIEWS or not Path(word).is_dir():
        return [(word, Angles.parse(word))]
    views: list[LabelledView] = []
    for name in (model := Colmap(word)).ids:
        photo = model[name]
        check_image_size(photo.camera)
        pose = Alignment(photo.cam_from_world.rotation, photo.cam_from_world.translation, scale)
        views.append((name, (photo.camera, pose)))
    return views
