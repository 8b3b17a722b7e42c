"""`cadalign track`: objects through a video, from a detector's keypoints."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from cadalign.cli.evidence import CameraOptions
from cadalign.cli.options import make_folder, named_as_flags, new_console, say, waiting
from cadalign.cli.runs import NOTHING_WORKED, SOME_FAILED, SUCCESS
from cadalign.errors import CadalignError, InputError
from cadalign.estimation.options import RansacOptions


@dataclass(frozen=True)
class TrackCommand(CameraOptions):
    """Track objects of a learned shape through a video.

    Keypoints of one track are one object: its shape is shared by all frames, and its poses follow
    each other smoothly; frames in which it was not detected get a pose, too. Writes for each track
    its trajectory in the forms of TUM (<track>.tum, with times) and KITTI (<track>.txt), and
    results.parquet with a row for each frame of each track.
    """

    detections: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DETECTIONS")]
    """COCO keypoint JSON with track_id, or CSV with the columns image, track, name, u, v."""
    shape: Path
    """The learned shape, a file of `cadalign shape learn`."""
    out: Path | None = None
    """Folder to write to; by default <detections>_tracks beside the detections."""
    rate: float = 30.0
    """Frames in a second; an image's frame is the last number in its name."""
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
        """Write trajectories and table; returns the exit code."""
        from cadalign.batch.tracks import COLUMNS, rows_of, tracks_of
        from cadalign.datasets import read_image_keypoints
        from cadalign.estimation.align import align
        from cadalign.estimation.tracks.motion import Motion
        from cadalign.evaluation.runs.tables import write_rows
        from cadalign.export.trajectories import write_kitti, write_tum
        from cadalign.shapes.model import ShapeModel

        objects, shape = read_image_keypoints(self.detections), ShapeModel.open(self.shape)
        with named_as_flags(self):
            motion = Motion(self.angular_sigma, self.linear_sigma)
            for name in ("rate", "sigma"):
                if not getattr(self, name) > 0:
                    raise InputError(f"{getattr(self, name):g} is not positive", where=name)
            camera = self.read_camera(objects[0].size)
        if camera is None:
            raise InputError("tracks need one", where="--camera", fix="give its file")
        tracks = tracks_of(
            objects,
            camera,
            shape.ids,
            rate=self.rate,
            sigma=self.sigma,
            min_score=self.min_score,
        )
        folder = self.out or self.detections.with_name(f"{self.detections.stem}_tracks")
        make_folder(folder)
        rows, failed, console = [], 0, new_console(stderr=False)
        ransac = RansacOptions() if self.robust else None
        for track in tracks:
            try:
                with waiting(f"track {track.name}"):
                    result = align(shape, track.views, motion=motion, ransac=ransac)
            except CadalignError as error:
                failed += 1
                console.print(f"track {track.name}: {error}", markup=False)
                continue
            path = result.trajectory
            assert path is not None
            stem = re.sub(r"[^\w.-]+", "_", track.name) or "track"
            write_tum(folder / f"{stem}.tum", path.times, path.poses)
            write_kitti(folder / f"{stem}.txt", path.poses)
            rows += list(rows_of(track, result))
            inliers = int(result.inliers.sum())
            console.print(
                f"track {track.name}: {len(track.views)} frames, {inliers} of "
                f"{len(result.inliers)} keypoints, rms {result.rms:.3g} px",
                markup=False,
            )
        if rows:
            write_rows(folder / "results.parquet", COLUMNS, rows)
        say(f"Trajectories: {folder}")
        if failed == len(tracks):
            return NOTHING_WORKED
        return SOME_FAILED if failed else SUCCESS
