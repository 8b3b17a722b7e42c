"""Pictures of a video: frames of files and folders, their numbers, refusals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cadalign.errors import DataError
from cadalign.io.images import Video, frame_numbers, write_image
from cadalign.render.drawing.movie import write_movie

COUNT, WIDTH, HEIGHT = 6, 64, 48


def picture(number: int) -> np.ndarray:
    """Grey, lighter with each frame, darker in its upper half."""
    image = np.full((HEIGHT, WIDTH, 3), 60 + 30 * number, dtype=np.uint8)
    image[: HEIGHT // 2] = 20
    return image


def test_the_frames_of_a_file_are_read_in_order(tmp_path: Path) -> None:
    path = tmp_path / "clip.mp4"
    write_movie(path, map(picture, range(COUNT)), fps=12.5)
    video = Video.open(path)
    assert video.size == (WIDTH, HEIGHT)
    assert video.rate == pytest.approx(12.5)
    found = dict(video.pictures(first=1))
    assert list(found) == list(range(1, COUNT + 1))
    for number, image in found.items():
        assert image.shape == (HEIGHT, WIDTH, 3)
        assert abs(float(image[-8:].mean()) - (60 + 30 * (number - 1))) < 4
        assert abs(float(image[:8].mean()) - 20) < 4


def test_a_video_that_was_held_sideways_is_turned(tmp_path: Path) -> None:
    import av
    from av.video.stream import VideoStream

    if not hasattr(VideoStream, "set_display_rotation"):
        pytest.skip("this PyAV writes no rotation")
    path, turned = tmp_path / "clip.mp4", tmp_path / "turned.mp4"
    write_movie(path, map(picture, range(COUNT)), fps=10)
    with av.open(str(path)) as source, av.open(str(turned), "w") as target:
        own = source.streams.video[0]
        stream = target.add_stream_from_template(own)
        stream.set_display_rotation(90)
        for packet in source.demux(own):
            if packet.dts is not None:
                packet.stream = stream
                target.mux(packet)
    video = Video.open(turned)
    assert video.size == (HEIGHT, WIDTH)
    _, image = next(video.pictures())
    assert image[:, :8].mean() < 40 < image[:, -8:].mean()  # the upper half, counterclockwise


def test_the_photos_of_a_folder_have_the_numbers_of_their_names(tmp_path: Path) -> None:
    for number in (10, 9, 2):
        write_image(tmp_path / f"frame_{number}.png", picture(number // 2))
    (tmp_path / "notes.txt").write_text("")
    video = Video.open(tmp_path)
    assert (video.size, video.rate) == ((WIDTH, HEIGHT), None)
    assert [number for number, _ in video.pictures()] == [2, 9, 10]


def test_images_without_numbers_are_counted() -> None:
    assert frame_numbers(["b.png", "a.png", "b.png"]) == {"b.png": 0, "a.png": 1}
    assert frame_numbers([]) == {}


def test_numbers_that_all_images_share_are_none_of_frames() -> None:
    names = ["0007_640x480_v2.png", "0009_640x480_v2.png"]
    assert list(frame_numbers(names).values()) == [7, 9]
    assert list(frame_numbers(["a1.png", "b1.png"]).values()) == [0, 1]


def test_what_is_no_video_is_refused(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    with pytest.raises(DataError, match="there is no photo in it"):
        Video.open(tmp_path / "folder")
    (tmp_path / "text.mp4").write_text("no video")
    with pytest.raises(DataError, match="not a video that can be read"):
        Video.open(tmp_path / "text.mp4")
    with pytest.raises(DataError, match=r"gone\.mp4"):
        Video.open(tmp_path / "gone.mp4")
