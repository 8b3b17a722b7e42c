"""Align one sample chair to a photo of another: the README's worked example, and its picture.

The photo is a rendering of the one chair; keypoints are joined by their semantic ids. Writes the
picture and, if asked to, the files for `cadalign fit` and `cadalign annotate`.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import tyro

from cadalign import Alignment, Box, Camera, Observation, fit
from cadalign.annotate.lines import Wireframe
from cadalign.annotate.model import ClickableModel
from cadalign.datasets import AnnotatedModel, KeypointNet, ModelKeypoints, write_sample_dataset
from cadalign.io.images import read_image, write_image
from cadalign.render import (
    Angles,
    RaycastRenderer,
    Scene,
    draw_overlay,
    draw_still,
    pose_in_view,
    visible_keypoints,
)
from cadalign.render.drawing.canvas import ByteImage, composite

CAMERA = Camera.from_fov(640, 720, fov_x=33.0)
VIEW = Angles(azimuth=143.0, elevation=24.0)
PHOTO_GROUND = (206, 208, 212)
LINE = (35, 208, 255)


def main(
    *,
    out: Path | None = None,
    photo_of: str = "006",
    model: str = "000",
    files: Path | None = None,
    width: int = 1500,
) -> None:
    """Align one sample chair to a photo of another.

    Parameters
    ----------
    out : Path, optional
        Where to write the picture; by default beside the files, or docs/other_chair.png.
    photo_of : str
        The sample chair in the photo.
    model : str
        The sample chair that is aligned to it.
    files : Path, optional
        Folder for the photo, the observation and the model's keypoints.
    width : int
        Width of the picture in pixels.
    """
    with tempfile.TemporaryDirectory() as folder:
        root = files or Path(folder)
        chairs = KeypointNet(write_sample_dataset(root / "sample"))
        seen, own = (chairs["chair", f"sample_chair_{name}"] for name in (photo_of, model))
        photo = root / "photo.png"
        observation = observe(seen, own, photo)
        observation.save(root / "photo.json")
        ModelKeypoints.of_model(own).save(root / f"{own.model_id}.keypoints.json")
        result = fit(observation.points_3d, observation.points_2d, observation.camera, sigma=None)
        print(result)

        scene = Scene(own.load_mesh())
        image = read_image(photo, CAMERA)
        aligned = draw_overlay(
            with_wireframe(image, ClickableModel(scene.mesh), result.alignment),
            CAMERA,
            est_box=Box.from_model(scene.bounds, result.alignment),
            observed=observation.points_2d,
            reprojected=CAMERA.project(result.alignment.apply(observation.points_3d)),
            legend=False,
        )
        out = out or (Path("docs") if files is None else files) / "other_chair.png"
        write_row(out, [image, still(scene), aligned], width=width)


def observe(seen: AnnotatedModel, model: AnnotatedModel, photo: Path) -> Observation:
    """Render the photo; its visible keypoints, with the other model's points of the same ids."""
    scene = Scene(seen.load_mesh())
    pose = pose_in_view(scene, CAMERA, VIEW)
    write_image(photo, still(scene))
    visible = visible_keypoints(scene, seen.keypoints.xyz, CAMERA, pose)
    in_photo = seen.keypoints.xyz[visible]
    shared, rows, model_rows = np.intersect1d(
        seen.keypoints.ids[visible], model.keypoints.ids, return_indices=True
    )
    return Observation(
        points_3d=model.keypoints.xyz[model_rows],
        points_2d=CAMERA.project(pose.apply(in_photo[rows])),
        camera=CAMERA,
        ids=shared,
        image=photo,
        model=model.mesh_path,
        fit_options={"sigma": None},  # two chairs agree less well than pixels do
    )


def still(scene: Scene) -> ByteImage:
    """A picture of a chair, (h, w, 3) uint8."""
    pose = pose_in_view(scene, CAMERA, VIEW)
    color = draw_still(RaycastRenderer(), scene, CAMERA, pose, samples=16)
    return composite(color, PHOTO_GROUND)


def with_wireframe(image: ByteImage, model: ClickableModel, alignment: Alignment) -> ByteImage:
    """The photo with the lines of the stretched model."""
    drawn = image.copy()
    for start, end in Wireframe.of_model(model).seen_in(CAMERA, alignment):
        ends = [tuple(np.round(16 * point).astype(int).tolist()) for point in (start, end)]
        cv2.line(drawn, *ends, LINE, 1, cv2.LINE_AA, shift=4)
    return drawn


def write_row(path: Path, pictures: Sequence[np.ndarray], *, width: int) -> None:
    """Write pictures of one height side by side, shrunk to a width [px] in all."""
    row = np.hstack(pictures)
    height = round(row.shape[0] * width / row.shape[1])
    path.parent.mkdir(parents=True, exist_ok=True)
    write_image(path, cv2.resize(row, (width, height), interpolation=cv2.INTER_AREA))


if __name__ == "__main__":
    tyro.cli(main)
