"""`cadalign render`: pictures of one model."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from cadalign.cli.common import create_parent, say
from cadalign.cli.options import name_flags
from cadalign.errors import InputError
from cadalign.io.images import JPEG_ENDING

if TYPE_CHECKING:
    from cadalign.render.viewpoints import Angles

_ENDINGS = (".png", JPEG_ENDING)


@dataclass(frozen=True)
class Render:
    """Draw a model: one view, or a contact sheet of several views."""

    model: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MODEL")]
    """The model: an OBJ, PLY, GLB, glTF, STL or OFF file."""
    out: Path = Path("render.png")
    """Picture to write: .png or .jpg."""
    view: tuple[str, ...] = ("iso",)
    """Views to draw: iso, front, right, back, left, top, bottom, all of these (all), or
    azimuth,elevation[,roll] in degrees. Write --view=-30,20 for a value that begins with a
    minus."""
    resolution: str = "640x480"
    """Width and height of each view [px]."""
    keypoints: Path | None = None
    """Keypoint file to draw: the model's NAME.keypoints.json."""
    fov: float = 35.0
    """Horizontal field of view [degrees]."""

    def run(self) -> int:
        """Draw and write; returns the exit code."""
        from cadalign.datasets.model_keypoints import ModelKeypoints
        from cadalign.io.images import write_image
        from cadalign.io.meshes.files import load_mesh
        from cadalign.render.layers import contact_sheet, keypoint_picture
        from cadalign.render.raycast import RaycastRenderer
        from cadalign.render.scene import Scene
        from cadalign.render.viewpoints import pose_in_view, visible_keypoints

        with name_flags(self, elevation="--view"):
            camera, views = self._camera(), self._views()
            scene, pictures = Scene(load_mesh(self.model)), {}
            xyz = None if self.keypoints is None else ModelKeypoints.load(self.keypoints).xyz
            for name, view in views.items():
                pose = pose_in_view(scene, camera, view)
                picture = RaycastRenderer().render(scene, camera, pose).composite()
                if xyz is not None:
                    visible = visible_keypoints(scene, xyz, camera, pose)
                    picture = keypoint_picture(picture, camera, xyz, pose, visible)
                pictures[name] = picture
            create_parent(self.out)
            write_image(self.out, contact_sheet(pictures) if len(pictures) > 1 else picture)
        say(f"Written: {self.out}")
        return 0

    def _camera(self) -> Any:
        """Return the camera of each picture; raises InputError if an option is invalid."""
        from cadalign.geometry.camera import Camera
        from cadalign.render.scene import check_image_size

        size = re.fullmatch(r"(\d{1,9})[xX](\d{1,9})", self.resolution.strip())
        if size is None or not (int(size[1]) and int(size[2])):
            what, fix = (
                f"{self.resolution!r} is not a resolution",
                "give WIDTHxHEIGHT, such as 640x480",
            )
            raise InputError(what, where="--resolution", fix=fix)
        camera = Camera.from_fov(int(size[1]), int(size[2]), fov_x=self.fov)
        check_image_size(camera)
        if self.out.suffix.lower() not in _ENDINGS:
            what = f"{self.out.name} is neither a PNG nor a JPEG file"
            fix = f"give a name that ends in {' or '.join(_ENDINGS)}"
            raise InputError(what, where="--out", fix=fix)
        return camera

    def _views(self) -> dict[str, Angles]:
        from cadalign.render.viewpoints import VIEWS, Angles

        views: dict[str, Angles] = {}
        for word in self.view:
            every = {name: Angles(*angles) for name, angles in VIEWS.items()}
            views |= every if word == "all" else {word: Angles.parse(word)}
        if not views:
            raise InputError("no view is given", where="--view", fix="give one or more")
        return views
