"""Pictures of a video with the objects of its tracks drawn in, and these objects as they move."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence

import numpy as np

from cadalign.batch.tracks import FoundTrack
from cadalign.errors import InputError
from cadalign.export.glb import MovingObject
from cadalign.geometry.box import Box
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh
from cadalign.io.images import Video
from cadalign.render.drawing.canvas import ByteImage
from cadalign.render.drawing.overlay import draw_overlay
from cadalign.render.raycast.renderer import cast_geometry
from cadalign.render.scene import Scene


def draw_video(video: Video, found: Sequence[FoundTrack], *, first: int = 0) -> Iterator[ByteImage]:
    """Draw box, keypoints and mesh of every track over the pictures of its frames.

    Frames that no track has are as they were; objects that are nearer are drawn later. ``first`` is
    the number of the video's first frame among the tracks' ones.

    Raises
    ------
    InputError
        If the pictures are not of the camera's size.
    DataError
        If a picture cannot be read.
    """
    shown: dict[int, list[tuple[FoundTrack, int]]] = defaultdict(list)
    for each in found:
        for place, number in enumerate(each.track.frames):
            shown[number].append((each, place))
    scenes = {each.track.name: None if each.mesh is None else Scene(each.mesh) for each in found}
    for number, picture in video.pictures(first=first):
        drawn = picture
        for each, place in sorted(shown[number], key=_nearness):
            drawn = _draw(drawn, each, place, scenes[each.track.name])
        yield drawn


def require_size(video: Video, camera: Camera) -> None:
    """Refuse a video whose pictures are not of the camera's size."""
    if video.size != (camera.width, camera.height):
        size = "{} x {} px".format(*video.size)
        what = f"its pictures are {size}, those of the camera {camera.width} x {camera.height}"
        raise InputError(what, where=str(video.path), fix="give the camera of this video")


def moving_object(each: FoundTrack) -> MovingObject:
    """The object of a track with its motion; its box where it has no mesh."""
    path = each.path
    mesh = each.mesh if each.mesh is not None else _box_mesh(each)
    # Times in glTF are not negative.
    times = path.times - min(float(path.times[0]), 0.0)
    return MovingObject(each.track.name, mesh.stretched(path.scale), times, path.poses)


def _nearness(shown: tuple[FoundTrack, int]) -> float:
    each, place = shown
    return -float(each.result.views[place].alignment.translation[2])


def _draw(picture: ByteImage, each: FoundTrack, place: int, scene: Scene | None) -> ByteImage:
    view, points = each.result.views[place], each.result.points_3d
    camera, alignment = view.camera, view.alignment
    box = Box.from_model(each.result.bounds, alignment)
    if not camera.sees(box.corners).any():
        return picture
    row_of = {label: row for row, label in enumerate(each.result.ids)}
    own = alignment.apply(points[[row_of[label] for label in view.ids]])
    return draw_overlay(
        picture,
        camera,
        est_box=box,
        est_frame=None if scene is None else cast_geometry(scene, camera, alignment),
        observed=view.points_2d,
        reprojected=camera.project_where_ahead(own),
        axes=False,
        legend=False,
    )


def _box_mesh(each: FoundTrack) -> Mesh:
    low, high = each.result.bounds
    box = Box((low + high) / 2, np.eye(3), high - low)
    faces = []
    for across, (a, b) in ((1, (2, 4)), (2, (4, 1)), (4, (1, 2))):  # bits of corners
        for start in (0, across):
            faces += [[start, start + a, start + a + b], [start, start + a + b, start + b]]
    return Mesh(box.corners, np.array(faces), source=each.track.name)
