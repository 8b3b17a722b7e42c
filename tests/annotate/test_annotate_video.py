"""Frames of a video: what is marked in some of them is proposed in the others."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.clips import CLOSE, FRAMES, Clip

from cadalign.annotate.actions import perform
from cadalign.annotate.opening import open_session
from cadalign.annotate.page_state import page_state
from cadalign.annotate.proposals import write_frames
from cadalign.cli import main
from cadalign.datasets import read_image_keypoints
from cadalign.errors import DataError, InputError
from cadalign.io.images import read_photo
from cadalign.render.drawing.movie import write_movie

pytestmark = pytest.mark.long

KEY_FRAMES = (0, 20, 40, 59)


def test_a_video_is_a_work_list_of_its_frames(clip: Clip, tmp_path: Path) -> None:
    options = clip.options(tmp_path / "out", every=20)
    assert options.track
    assert [each.name for each in sorted(options.image.iterdir())] == [
        "frame_000000.png",
        "frame_000020.png",
        "frame_000040.png",
    ]
    kept = options.image / "frame_000020.png"
    kept.write_bytes((options.image / "frame_000000.png").read_bytes())
    clip.options(tmp_path / "out", every=20)
    assert kept.read_bytes() == (options.image / "frame_000000.png").read_bytes()
    with pytest.raises(InputError, match="--every: 0 is not positive"):
        clip.options(tmp_path / "out", every=0)
    damaged = tmp_path / "no.mp4"
    damaged.write_text("no video")
    with pytest.raises(DataError, match="not a video that can be read"):
        write_frames(damaged, tmp_path / "frames", every=1)


def test_keypoints_of_four_frames_are_proposed_in_all_others(clip: Clip, tmp_path: Path) -> None:
    session = open_session(clip.options(tmp_path / "out"))
    session.warm_up()
    assert len(session.photos) == FRAMES
    assert page_state(session, 5)["proposals"] == []
    rng = np.random.default_rng(0)
    clicks = 0
    for frame in KEY_FRAMES:
        for number, uv in clip.seen(session, frame).items():
            click = (uv + rng.normal(0, 1, 2)).tolist()
            perform(session, frame, {"do": "place_uv", "uv": click})
            perform(session, frame, {"do": "place_keypoint", "keypoint": number})
            clicks += 2
    by_hand, wrong, missing, sigmas, gaps = 0, 0, 0, [], []
    for frame in (k for k in range(FRAMES) if k not in KEY_FRAMES):
        seen = clip.seen(session, frame)
        given = {each["keypoint"]: each for each in page_state(session, frame)["proposals"]}
        for number, uv in seen.items():
            by_hand += 2
            missing += number not in given
            if number in given:
                gap = np.linalg.norm(np.array(given[number]["uv"]) - uv)
                wrong += gap > CLOSE
                gaps.append(gap)
                sigmas.append(given[number]["sigma"])
    needed = FRAMES - len(KEY_FRAMES) + wrong + 2 * missing  # one key for a frame, and corrections
    assert needed + clicks < (by_hand + clicks) / 4
    assert np.mean(np.array(gaps) > CLOSE) < 0.02
    assert 0.3 < np.sqrt(np.mean(np.square(gaps))) / np.sqrt(2 * np.mean(np.square(sigmas))) < 2

    perform(session, 10, {"do": "accept"})
    document = session.photos[10].document
    assert len(document.complete_pairs) >= 5
    assert page_state(session, 10)["proposals"] == []
    reopened = open_session(clip.options(tmp_path / "out"))
    assert len(reopened.photos[10].document.complete_pairs) == len(document.complete_pairs)
    written = tmp_path / "keypoints.json"
    command = ["annotate", str(clip.path), str(clip.case.model), "--out", str(tmp_path / "out")]
    command += ["--camera", str(tmp_path / "out" / "camera.json"), "--export", str(written)]
    assert main([*command, "--keypoints", str(clip.case.keypoints)]) == 0
    found = read_image_keypoints(written)
    assert [each.track for each in found] == ["1"] * (len(KEY_FRAMES) + 1)


def test_frames_of_another_video_are_refused_and_further_ones_named(
    clip: Clip, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = write_frames(clip.path, tmp_path / "frames", every=10)
    caplog.clear()
    write_frames(clip.path, folder, every=20)
    assert f"{folder}: has 3 frames beside those of --every 20" in caplog.text
    other = tmp_path / clip.path.name
    pictures = [255 - read_photo(path) for path in sorted(folder.iterdir())]
    write_movie(other, [*pictures, *pictures], fps=30)
    before = {path: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(DataError, match=f"the frames there are not those of {other.name}; rename"):
        write_frames(other, folder, every=1)
    assert {path: path.read_bytes() for path in folder.iterdir()} == before
