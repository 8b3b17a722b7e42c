"""`cadalign track`: objects through a video, from a detector's keypoints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from cadalign.cli.common import answer, beside, exit_code, file_stems, make_folder, say, waiting
from cadalign.cli.options import CameraOptions, named_as_flags
from cadalign.errors import CadalignError, InputError, refuse_unused
from cadalign.estimation.options import RansacOptions
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.geometry.camera import Camera
from cadalign.io.files import keeping, remove_earlier
from cadalign.io.observation import with_lens

if TYPE_CHECKING:
    from cadalign.batch.tracks import FoundTrack, VideoTrack
    from cadalign.datasets import ImageKeypoints
    from cadalign.estimation.tracks.motion import Motion
    from cadalign.io.images import Video
    from cadalign.shapes.model import ShapeModel

_ENDINGS = (".tum", ".txt")
_RATE = 30.0
_KITTI_RATE = 10.0  # Geiger et al., "Vision meets Robotics: The KITTI Dataset", 2013


@dataclass(frozen=True)
class TrackCommand(CameraOptions):
    """Track objects of a learned shape through a video.

    Keypoints of one track are one object: its shape is shared by all frames, and its poses follow
    each other smoothly; frames in which it was not detected get a pose, too. Writes for each track
    its trajectory in the forms of TUM (<track>.tum, with times) and KITTI (<track>.txt),
    results.parquet with a row for each frame of each track, index.html with plots over time,
    tracks.glb with the moving objects, and with --video the pictures with what was found drawn in,
    overlay.mp4.
    """

    detections: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DETECTIONS")]
    """COCO keypoint JSON with track_id, CSV with the columns image, track, name, u, v, or a folder
    of KITTI's cars with car_tracks.json."""
    shape: Path | None = None
    """The learned shape, a file of `cadalign shape learn`; by default that of a folder of KITTI's
    cars."""
    video: Path | None = None
    """The video, a file or a folder of its pictures, to draw into."""
    image: bool = False
    """Use the video's pictures as evidence, too: the outline of the object is sought in each. It
    takes a tenth of a second a frame, and the shape needs models with meshes."""
    first_frame: int = 0
    """Number of the first frame of a video file among the frames of the detections."""
    out: Path | None = None
    """Folder to write to; by default <detections>_tracks beside the detections."""
    rate: float | None = None
    """Frames in a second; an image's frame is the last number in its name that differs from image
    to image. By default the video's, or 30, or the 10 of KITTI's cars."""
    sigma: float = 2.0
    """Standard deviation of the keypoints [px], where the file has none."""
    min_score: float = 0.1
    """Score above which a keypoint is used."""
    robust: bool = False
    """Expect outliers: keypoints that do not fit shape and motion are left out, and so are frames
    that are flipped."""
    angular_sigma: float | None = None
    """Strength of the angular acceleration [degrees / s^1.5]; estimated by default."""
    linear_sigma: float | None = None
    """Strength of the linear acceleration [model units / s^1.5]; estimated by default."""

    def run(self) -> int:
        """Write trajectories, table, page and animation; returns the exit code."""
        from cadalign.batch.tracks import tracks_of
        from cadalign.datasets import read_image_keypoints
        from cadalign.estimation.tracks.motion import Motion
        from cadalign.io.images import Video

        objects, shape = read_image_keypoints(self.detections), self._read_shape()
        video = None if self.video is None else Video.open(self.video)
        with named_as_flags(self):
            motion = Motion(self.angular_sigma, self.linear_sigma)
            for name, value in (("rate", self.rate), ("sigma", self.sigma)):
                if value is not None and not value > 0:
                    raise InputError(f"{value:g} is not positive", where=name)
            if video is None or video.path.is_dir():
                refuse_unused(self, ["first_frame"], "without the file of a video")
            rate = self._rate(video)
            tracks = tracks_of(
                objects,
                self._camera(objects, video),
                shape.ids,
                rate=rate,
                sigma=self.sigma,
                min_score=self.min_score,
            )
        if video is not None:
            from cadalign.batch.tracks import require_size

            folders = {str(Path(image).parent) for each in tracks for image in each.images if image}
            if len(folders) > 1:
                what = f"the detections are of {len(folders)} videos"
                raise InputError(what, where="--video", fix="give the detections of one")
            require_size(video, tracks[0].views[0].camera)
        if self.image:
            from cadalign.batch.tracks import with_pictures

            if video is None:
                fix = "give --video"
                raise InputError("pictures as evidence need the video", where="--image", fix=fix)
            tracks = with_pictures(tracks, video, first=self.first_frame)
        folder = self.out or beside(self.detections, "_tracks")
        RunFolder(folder).refuse_run()
        make_folder(folder)
        found, failures = self._estimate(tracks, shape, motion)
        if found:
            with keeping([self.detections, self.shape, self.video, self.camera]):
                self._write(folder, found, failures, video)
            say(f"Trajectories: {folder}")
        return exit_code(len(failures), len(tracks))

    def _rate(self, video: Video | None) -> float:
        """Frames in a second: as given, the video's, or what is usual for the detections."""
        usual = _RATE if self.shape else _KITTI_RATE
        return self.rate or (video.rate if video else None) or usual

    def _read_shape(self) -> ShapeModel:
        from cadalign.datasets.photos.kitti_keypoints import car_shape
        from cadalign.shapes.model import ShapeModel

        if self.shape is not None:
            return ShapeModel.open(self.shape)
        folder = self.detections if self.detections.is_dir() else self.detections.parent
        shape = car_shape(folder)
        if shape is None:
            fix = "give a file of `cadalign shape learn`"
            raise InputError("tracks need one", where="--shape", fix=fix)
        return shape

    def _camera(self, objects: Sequence[ImageKeypoints], video: Video | None) -> Camera | None:
        """The camera of the options, for pictures of the video's or the detections' size."""
        changes = self.of_camera
        size = objects[0].size if video is None else video.size
        camera = changes.read_camera(size)
        if changes.focal is None and changes.fov is None:
            return camera
        if camera is None and size is None:
            what = "the size of the pictures is unknown"
            raise InputError(what, where="camera", fix="give --video, or the camera's file")
        known = camera or Camera.without_focal(*(size or (1, 1)))
        return with_lens(known, changes.focal, fov=changes.fov)

    def _estimate(
        self, tracks: Sequence[VideoTrack], shape: ShapeModel, motion: Motion
    ) -> tuple[list[FoundTrack], dict[str, str]]:
        """Estimate every track, and say how; also why some could not be."""
        from cadalign.batch.tracks import FoundTrack
        from cadalign.estimation.align import align

        found, failures = [], dict[str, str]()
        ransac = RansacOptions() if self.robust else None
        for track in tracks:
            try:
                with waiting(f"track {track.name}"):
                    result = align(shape, track.views, motion=motion, ransac=ransac)
            except CadalignError as error:
                failures[track.name] = str(error)
                answer(f"track {track.name}: {error}")
                continue
            found.append(FoundTrack(track, result, result.known_mesh(None)))
            inliers = int(result.inliers.sum())
            shares = [each.share for each in result.evidence if each.kind == "photo"]
            pictures = f", {sum(map(bool, shares))} of {len(shares)} pictures" if shares else ""
            answer(
                f"track {track.name}: {len(track.views)} frames, {inliers} of "
                f"{len(result.inliers)} keypoints, rms {result.rms:.3g} px{pictures}"
            )
        return found, failures

    def _write(
        self,
        folder: Path,
        found: Sequence[FoundTrack],
        failures: Mapping[str, str],
        video: Video | None,
    ) -> None:
        """Write the folder; what an earlier run wrote of other tracks is removed."""
        from cadalign.batch.tracks import COLUMNS, draw_video, moving_object, rows_of, tracks_in
        from cadalign.evaluation.runs.tables import write_rows
        from cadalign.export.camera_files import write_kitti, write_tum
        from cadalign.export.glb import write_moving_glb
        from cadalign.render.drawing.movie import write_movie
        from cadalign.report.track_page import write_track_page

        stems = file_stems((each.track.name for each in found), "track")
        earlier = file_stems(tracks_in(folder / "results.parquet"), "track")
        stale = [folder / f"{each}{end}" for each in set(earlier) - set(stems) for end in _ENDINGS]
        if earlier and video is None:
            stale.append(folder / "overlay.mp4")
        remove_earlier(folder, stale)
        for each, stem in zip(found, stems, strict=True):
            write_tum(folder / f"{stem}.tum", each.path.times, each.path.poses)
            write_kitti(folder / f"{stem}.txt", each.path.poses)
        rows = [row for each in found for row in rows_of(each)]
        write_rows(folder / "results.parquet", COLUMNS, rows)
        write_moving_glb(folder / "tracks.glb", [moving_object(each) for each in found])
        count = f"{len(found)} track{'s' * (len(found) != 1)}"
        write_track_page(
            folder / "index.html",
            found,
            title=f"Tracks of {self.detections.stem}",
            summary=f"{count} of {self.detections.name}, {len(rows):,} frames in all.",
            settings={
                "detections": str(self.detections),
                "shape": str(self.shape or "KITTI's cars"),
                "noise where the file has none": f"{self.sigma:g} px",
                "outliers expected": "yes" if self.robust else "no",
            },
            failures=failures,
        )
        if video is not None:
            with waiting("drawing"):
                drawn = draw_video(video, found, first=self.first_frame)
                write_movie(folder / "overlay.mp4", drawn, fps=self._rate(video))
