"""Chromium: the frames of a video marked by the mouse and the keys alone, then tracked."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser, expect
from support.annotating import opened_page
from support.clips import CLOSE, FRAMES, Clip, mark_clip

from cadalign import ShapeModel
from cadalign.annotate.exporting import coco_of
from cadalign.annotate.opening import open_session
from cadalign.annotate.session import Session
from cadalign.cli import main
from cadalign.geometry.rotations import angle_between

pytestmark = pytest.mark.long

EVERY = 6


def test_a_clip_is_marked_by_few_clicks_and_tracked(
    browser: Browser, clip: Clip, tmp_path: Path
) -> None:
    session = open_session(clip.options(tmp_path / "out", every=EVERY))
    session.warm_up()
    with opened_page(browser, session, width=1100, height=900) as page:
        clicks = mark_clip(page, session, clip, (0, 4, 9))
        page.keyboard.press("Control+z")  # what was taken last is proposed again
        expect(page.get_by_text("predicted from other frames")).to_be_visible()
        page.keyboard.press("a")
        expect(page.get_by_text("predicted from other frames")).to_be_hidden()
    assert (clicks.keys, len(clicks.gaps) > 50) == (FRAMES // EVERY - 3, True)
    assert np.mean(clicks.gaps < CLOSE) > 0.95
    assert clicks.marked + clicks.keys + clicks.corrected < clicks.by_hand / 2
    assert_tracked(session, clip, tmp_path)


def assert_tracked(session: Session, clip: Clip, folder: Path) -> None:
    """`cadalign track` reads what the session exports, and finds the object's motion."""
    _, known = zip(*session.models[0].registry, strict=True)
    places = np.array([point.xyz for point in known])
    sizes = ShapeModel.from_basis(
        places, 0.01 * places[None], np.ones(1), ids=[point.name for point in known]
    )
    sizes.save(folder / "chair.shape")
    (folder / "found.json").write_text(json.dumps(coco_of(session)))
    files = ["--shape", folder / "chair.shape", "--camera", folder / "out" / "camera.json"]
    command = ["track", folder / "found.json", *files, "--out", folder / "tracks"]
    assert main([str(each) for each in command]) == 0
    found = np.loadtxt(folder / "tracks" / "1.txt").reshape(-1, 3, 4)
    assert len(found) == FRAMES - EVERY + 1  # also frames that were not taken
    for pose, truth in zip(found, clip.poses, strict=False):
        assert angle_between(pose[:, :3], truth.rotation) < 3.0
