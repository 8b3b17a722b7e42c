"""Objects of a video: a detector's keypoints grouped by track, and the table of their poses."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from cadalign.datasets import ImageKeypoints
from cadalign.errors import DataError, InputError, quote
from cadalign.estimation.result import Result
from cadalign.estimation.tracks.motion import Trajectory
from cadalign.estimation.view import View
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh
from cadalign.io.images import frame_numbers

if TYPE_CHECKING:
    from cadalign.evaluation.runs.tables import Columns, Row

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

    A frame's number is the last one in its image's name, or its place among the images; ``rate``
    is that of the frames [1/s]. Images of several folders are several videos, whose tracks are
    named after them. Without a ``camera`` each file's own is taken. Keypoints are those of the
    model's ``ids``, by name, by semantic id, or in the model's order.

    Raises
    ------
    DataError
        If two objects of one frame have the same track, the keypoints are none of the model's, or
        frames are too far apart to have numbers.
    InputError
        If no camera is known.
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
    has_one = len({video for video, _ in by_track}) == 1
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
        label = name if has_one else f"{video}/{name}"
        found.append(VideoTrack(label, views, tuple(frames), names))
    return found


def _video(image: str) -> str:
    """Name of the video that an image is of: its folder's."""
    return Path(image).parent.name


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
    given: Sequence[object] | None = seen.names if seen.names is not None else seen.ids
    if given is None:
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
    from cadalign.geometry.rotations import quat_wxyz_from_rotation

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
