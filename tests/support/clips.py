"""A rendered video of a turning chair, and the marking of its frames by mouse and keys."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from playwright.sync_api import Page

from cadalign.annotate.options import SessionOptions
from cadalign.annotate.session import Session
from cadalign.arrays import FloatArray
from cadalign.cli.annotate import Annotate
from cadalign.geometry import resized_camera
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.rotations import rotation_from_vector
from cadalign.render import RaycastRenderer, visible_keypoints
from cadalign.render.drawing.movie import write_movie
from support.annotating import IDLE, Case, place_of_pixel, wait

FRAMES = 60
CLOSE = 3.0  # [px]
_CLICK_SIGMA = 1.0  # [px]


@dataclass(frozen=True)
class Clip:
    """A video of a turning chair, and the chair's poses in its frames."""

    case: Case
    path: Path
    camera: Camera
    poses: list[Alignment]

    def options(self, out: Path, **changes: Any) -> SessionOptions:
        """Options of a session as the command makes them."""
        out.mkdir(exist_ok=True)
        camera = out / "camera.json"
        camera.write_text(json.dumps(self.camera.to_dict()))
        command = Annotate(
            files=(self.path, self.case.model),
            camera=camera,
            keypoints=self.case.keypoints,
            out=out,
            **changes,
        )
        return command.session

    def seen(self, session: Session, frame: int) -> dict[int, FloatArray]:
        """Pixels of the visible keypoints by their numbers."""
        scene, pose = self.case.instance.scene, self.poses[frame]
        assert scene is not None
        numbers, points = zip(*session.models[0].registry, strict=True)
        xyz = np.array([point.xyz for point in points])
        shown = visible_keypoints(scene, xyz, self.camera, pose)
        pixels = self.camera.project(pose.apply(xyz))
        return {numbers[k]: pixels[k] for k in np.flatnonzero(shown)}


def make_clip(case: Case, folder: Path) -> Clip:
    """Render a video of the object of a case."""
    instance = case.instance
    camera, scene = resized_camera(instance.camera, 320, 240), instance.scene
    assert scene is not None
    start, poses = instance.cam_from_model, []
    for share in np.linspace(0.0, 1.0, FRAMES):
        turn = rotation_from_vector(np.array([0.0, 1.2 * share, 0.0]))
        away = np.array([0.2 * share - 0.1, 0.05 * np.sin(3 * share), 0.3 * share])
        poses.append(Alignment(start.rotation @ turn, start.translation + away, start.scale))
    renderer = RaycastRenderer()
    frames = (renderer.render(scene, camera, pose).composite() for pose in poses)
    path = folder / "chair.mp4"
    assert write_movie(path, frames, fps=30) == FRAMES
    return Clip(case, path, camera, poses)


@dataclass(frozen=True)
class ClipClicks:
    """What it took to mark a clip, and how far predictions were off (n,) and said to be (m,)."""

    marked: int  # clicks in the frames that are marked by hand
    keys: int  # that take the predictions of a frame
    corrected: int  # clicks and drags of what was missing or more than 3 px off
    by_hand: int  # clicks that all frames would take
    gaps: FloatArray
    stated: FloatArray


def mark_clip(page: Page, session: Session, clip: Clip, key_frames: Sequence[int]) -> ClipClicks:
    """Mark some frames by hand, and take the predictions of the others, which are corrected."""
    rng = np.random.default_rng(0)
    numbers = [int(photo.photo.path.stem[-6:]) for photo in session.photos]
    marked, corrected, by_hand = 0, 0, 0
    gaps, stated = list[float](), list[float]()
    for frame in key_frames:
        _go_to(page, frame)
        for keypoint, uv in clip.seen(session, numbers[frame]).items():
            _mark(page, keypoint, uv + rng.normal(0, _CLICK_SIGMA, 2))
            marked += 2
    others = [frame for frame in range(len(numbers)) if frame not in key_frames]
    for frame in others:
        _go_to(page, frame)
        stated += page.evaluate("annotator.state.proposals.map((each) => each.sigma)")
        page.keyboard.press("a")
        wait(page, f"{IDLE} && !annotator.state.proposals.length")
        pairs = session.photos[frame].document.complete_pairs
        placed = {pair.keypoint: np.array(pair.uv) for pair in pairs}
        for keypoint, uv in clip.seen(session, numbers[frame]).items():
            by_hand += 2
            click = uv + rng.normal(0, _CLICK_SIGMA, 2)
            if keypoint not in placed:
                _mark(page, keypoint, click)
                corrected += 2
                continue
            gaps.append(float(np.linalg.norm(placed[keypoint] - uv)))
            if gaps[-1] > CLOSE:
                _drag(page, placed[keypoint], click)
                corrected += 1
    return ClipClicks(
        marked, len(others), corrected, marked + by_hand, np.array(gaps), np.array(stated)
    )


def _go_to(page: Page, frame: int) -> None:
    page.evaluate(f"location.hash = '#{frame + 1}'")
    wait(page, f"{IDLE} && annotator.state.image.number === {frame}")
    page.evaluate("document.querySelector('.keypoints-list').open = true")


def _mark(page: Page, keypoint: int, uv: FloatArray) -> None:
    """Choose a keypoint in the list, then click the photo."""
    page.locator(f'[data-key="{keypoint}"]').click()
    wait(page, f"{IDLE} && annotator.state.pairs.some((pair) => !pair.uv)")
    page.mouse.click(*place_of_pixel(page, uv.tolist()))
    wait(page, f"{IDLE} && annotator.state.pairs.every((pair) => pair.uv)")


def _drag(page: Page, start: FloatArray, end: FloatArray) -> None:
    page.mouse.move(*place_of_pixel(page, start.tolist()))
    page.mouse.down()
    page.mouse.move(*place_of_pixel(page, end.tolist()), steps=4)
    page.mouse.up()
    page.wait_for_timeout(50)
    wait(page, IDLE)
