"""Objects of a video: a detector's keypoints by track, the table of poses, and pictures."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cadalign.datasets import ImageKeypoints
from cadalign.datasets.detections.image_keypoints import plain_name
from cadalign.errors import DataError, InputError, quote
from cadalign.estimation.result import Result
from cadalign.estimation.tracks.motion import Trajectory
from cadalign.estimation.view import View
from cadalign.evaluation.runs.tables import read_groups
from cadalign.evaluation.runs.work import Columns, Row
from cadalign.export.glb import MovingObject
from cadalign.geometry.box import Box
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.rotations import quat_wxyz_from_rotation
from cadalign.io.images import Video, frame_numbers
from cadalign.render.drawing.canvas import ByteImage
from cadalign.render.drawing.overlay import draw_overlay
from cadalign.render.raycast.renderer import cast_geometry
from cadalign.render.scene import Scene

_MOST_FRAMES = 100_000  # of a track, those without a detection included
COLUMNS: Columns = (
    *(("track", str), ("frame", int), ("image", str), ("time", float)),
    *((name, float) for name in ("tx", "ty", "tz", "qw", "qx", "qy", "qz")),
    *((name, float) for name in ("rotation_std_deg", "tx_std", "ty_std", "tz_std")),
    *((name, float) for name in ("speed", "angular_speed_deg")),
    *(("keypoints", int), ("inliers", int), ("rms_px", float)),
)
"""Columns of the table of poses: that of the model in the camera, its uncertainty [degrees, model
units], speeds in a second, keypoints and root mean square residual of the inliers."""


class VideoTrack(NamedTuple):
    """One object of a video: a view of each frame, the frames' numbers and images."""

    name: str
    views: tuple[View, ...]
    frames: tuple[int, ...]
    images: tuple[str, ...]


class FoundTrack(NamedTuple):
    """The estimate of a track, with the object's mesh before the stretch, where one is known."""

    track: VideoTrack
    result: Result
    mesh: Mesh | None = None

    @property
    def path(self) -> Trajectory:
        """The poses over time."""
        assert self.result.trajectory is not None
        return self.result.trajectory


def tracks_of(
    objects: Sequence[ImageKeypoints],
    camera: Camera | None,
    ids: Sequence[object],
    *,
    rate: float,
    sigma: float,
    min_score: float,
) -> list[VideoTrack]:
    """The objects of videos by their track, each with a view of all frames from first to last.

    Frames are numbered by `frame_numbers`; ``rate`` is that of the frames [1/s]. Images of several
    folders are several videos, whose tracks are named after them. Without a ``camera`` each file's
    own is taken. Keypoints are those of the model's ``ids``, by name, by semantic id, or in the
    model's order.

    Raises DataError if two objects of one frame have the same track, the keypoints are none of the
    model's, images are not of the camera's size, or frames are too far apart to have numbers;
    InputError if no camera is known.
    """
    numbers = frame_numbers([each.image or "" for each in objects])
    by_track: dict[tuple[str, str], dict[int, ImageKeypoints]] = defaultdict(dict)
    images = {(_video(name), number): name for name, number in numbers.items()}
    for each in objects:
        image = each.image or ""
        own, frame = by_track[_video(image), each.track or "0"], numbers[image]
        if frame in own:
            what = f"a second object of track {quote(each.track)} in image {quote(each.image)}"
            fix = "give each object of an image a track_id of its own"
            raise DataError(what, where=each.source, fix=fix)
        own[frame] = each
    found = []
    videos = {video for video, _ in by_track}
    has_names = len({Path(video).name for video in videos}) == len(videos)
    for (video, name), own in by_track.items():
        known = camera or next(iter(own.values())).camera
        if known is None:
            raise InputError("tracks need one", where="camera", fix="give its file")
        frames = range(min(own), max(own) + 1)
        if len(frames) > _MOST_FRAMES:
            what = f"track {quote(name)} goes from frame {frames[0]} to {frames[-1]}"
            fix = "name images by the numbers of their frames, not by times"
            raise DataError(what, where=own[frames[0]].source, fix=fix)
        views = tuple(
            _view(own.get(k), known, ids, sigma=sigma, min_score=min_score, time=k / rate)
            for k in frames
        )
        names = tuple(images.get((video, k), "") for k in frames)
        called = Path(video).name if has_names else video
        label = name if len(videos) == 1 else f"{called}/{name}"
        found.append(VideoTrack(label, views, tuple(frames), names))
    return found


def with_pictures(tracks: Sequence[VideoTrack], video: Video, *, first: int) -> list[VideoTrack]:
    """Tracks whose views have the video's pictures as evidence, where it has their frame.

    ``first`` is the number of the video's first frame. Raises DataError if a picture cannot be
    read; InputError if the video has none of the frames.
    """
    wanted = {number for track in tracks for number in track.frames}
    shown = {number: pixels for number, pixels in video.pictures(first=first) if number in wanted}
    if not shown:
        raise _apart(video, wanted)
    return [
        track._replace(
            views=tuple(
                replace(view, image=shown.get(number))
                for view, number in zip(track.views, track.frames, strict=True)
            )
        )
        for track in tracks
    ]


def _video(image: str) -> str:
    """The video that an image is of: its folder."""
    return Path(image).parent.as_posix()


def _view(
    seen: ImageKeypoints | None,
    camera: Camera,
    ids: Sequence[object],
    *,
    sigma: float,
    min_score: float,
    time: float,
) -> View:
    """A frame as a view, without keypoints where the object was not detected."""
    if seen is None:
        return View(camera, time=time)
    seen.check_camera(camera)
    given: Sequence[object] | None = seen.ids
    if seen.names is not None:
        own_names = {plain_name(str(each)): each for each in ids}
        given = [own_names.get(plain_name(name), name) for name in seen.names]
    elif given is None:
        if len(seen) != len(ids):
            what = f"{len(seen)} keypoints without names, but the model has {len(ids)}"
            raise DataError(what, where=seen.source, fix="name them in the file's categories")
        given = ids
    kept = [
        row
        for row, name in enumerate(given)
        if name in ids and (seen.scores is None or seen.scores[row] > min_score)
    ]
    if not set(given) & set(ids):
        known = ", ".join(quote(each) for each in list(ids)[:5])
        what = f"no keypoint is one of the model's, which are {known}, ..."
        raise DataError(what, where=seen.source)
    own = sigma if seen.sigma is None else seen.sigma[kept]
    names = [given[row] for row in kept]
    try:
        return View(camera, seen.points_2d[kept], ids=names, sigma=own, time=time)
    except InputError as error:
        raise DataError(error.what, where=f"{seen.source}: {error.where}", fix=error.fix) from None


def rows_of(found: FoundTrack) -> Iterator[Row]:
    """A row of the table for each frame."""
    track, result, path = found.track, found.result, found.path
    places = np.searchsorted(path.times, [float(view.time or 0.0) for view in track.views])
    for number, image, view, k in zip(
        track.frames, track.images, result.views, places.tolist(), strict=True
    ):
        pose, std = view.alignment, view.std
        assert std is not None
        quaternion = quat_wxyz_from_rotation(pose.rotation).tolist()
        turning, moving = np.linalg.norm(path.velocities[k].reshape(2, 3), axis=1).tolist()
        yield {
            "track": track.name,
            "frame": number,
            "image": image,
            "time": float(path.times[k]),
            **dict(zip(("tx", "ty", "tz"), pose.translation.tolist(), strict=True)),
            **dict(zip(("qw", "qx", "qy", "qz"), quaternion, strict=True)),
            "rotation_std_deg": float(std.rotation_deg),
            **dict(zip(("tx_std", "ty_std", "tz_std"), map(float, std.translation), strict=True)),
            "speed": moving,
            "angular_speed_deg": float(np.degrees(turning)),
            "keypoints": len(view.inliers),
            "inliers": int(view.inliers.sum()),
            "rms_px": view.rms,
        }


def tracks_in(table: Path) -> list[str]:
    """The names of the tracks in a table of poses; none where there is no such table."""
    names = dict[str, None]()
    with suppress(DataError):
        for rows in read_groups(table, fix=""):
            if rows.column_names != [name for name, _ in COLUMNS]:
                return []
            names |= dict.fromkeys(rows["track"].to_pylist())
    return list(names)


# Pictures -----------------------------------------------------------------------------------------


def draw_video(video: Video, found: Sequence[FoundTrack], *, first: int = 0) -> Iterator[ByteImage]:
    """Draw box, keypoints and mesh of every track over the pictures of its frames.

    Frames that no track has are as they were; objects that are nearer are drawn later. ``first`` is
    the number of the video's first frame among the tracks' ones. Raises InputError if the pictures
    are not of the camera's size, or none is of a track's frame; DataError if one cannot be read.
    """
    shown: dict[int, list[tuple[FoundTrack, int]]] = defaultdict(list)
    for each in found:
        for place, number in enumerate(each.track.frames):
            shown[number].append((each, place))
    scenes = {each.track.name: None if each.mesh is None else Scene(each.mesh) for each in found}

    def nearness(shown: tuple[FoundTrack, int]) -> float:
        each, place = shown
        return -float(each.result.views[place].alignment.translation[2])

    is_apart = True
    for number, picture in video.pictures(first=first):
        is_apart &= number not in shown
        drawn = picture
        for each, place in sorted(shown.get(number, ()), key=nearness):
            drawn = _draw(drawn, each, place, scenes[each.track.name])
        yield drawn
    if is_apart:
        raise _apart(video, shown)


def _apart(video: Video, frames: Collection[int]) -> InputError:
    """Error about a video that has none of some frames."""
    what = f"it has none of the frames {min(frames)} to {max(frames)} of the detections"
    fix = "give their video, or the number of its first frame"
    return InputError(what, where=str(video.path), fix=fix)


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
