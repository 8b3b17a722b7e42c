"""`cadalign track`: files written, several objects, refusals."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import trimesh
from support.refusals import refusal_line

from cadalign import Camera, ShapeModel
from cadalign.cli import main
from cadalign.datasets import KeypointNet, write_sample_dataset
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.simulated_tracks import TRACK_CAMERA, SimulatedTrack, simulate_track
from cadalign.geometry.rotations import angle_between
from cadalign.io.images import Video, write_image
from cadalign.render import RaycastRenderer, Scene, look_at
from cadalign.render.drawing.movie import write_movie
from cadalign.shapes.examples import examples_of

pytestmark = pytest.mark.slow

FRAMES, POINTS = 20, 8
NAMES = [f"point {row}" for row in range(POINTS)]


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[SimulatedTrack]]:
    """A folder with two objects' detections, their shape and the camera; the truth."""
    folder = tmp_path_factory.mktemp("video")
    rng = np.random.default_rng(0)
    mean, modes = rng.uniform(-0.4, 0.4, (POINTS, 3)), 0.04 * rng.normal(size=(3, POINTS, 3))
    ShapeModel.from_basis(mean, modes, np.ones(3), ids=NAMES).save(folder / "thing.shape")
    objects = [
        simulate_track(rng, mean + np.tensordot(rng.normal(size=3), modes, 1), NAMES, frames=FRAMES)
        for _ in range(2)
    ]
    annotations = []
    for name, each in zip((3, 7), objects, strict=True):
        for k, view in enumerate(each.views):
            if name == 7 and 8 <= k < 11:  # not detected
                continue
            marks = np.zeros((POINTS, 3))
            rows = [NAMES.index(str(own)) for own in view.keypoint_ids]
            marks[rows] = np.column_stack([np.asarray(view.points_2d), np.full(len(rows), 2.0)])
            annotations.append(
                {
                    "image_id": k,
                    "category_id": 1,
                    "track_id": name,
                    "keypoints": marks.ravel().tolist(),
                }
            )
    images = [{"id": k, "file_name": f"frame_{k:04d}.png"} for k in range(FRAMES)]
    category = {"id": 1, "keypoints": NAMES}
    found = {"images": images, "annotations": annotations, "categories": [category]}
    (folder / "found.json").write_text(json.dumps(found))
    (folder / "camera.json").write_text(json.dumps(TRACK_CAMERA.to_dict()))
    return folder, objects


def command(folder: Path, *more: str) -> list[str]:
    files = ["--shape", str(folder / "thing.shape"), "--camera", str(folder / "camera.json")]
    return ["track", str(folder / "found.json"), *files, *more]


def test_every_track_gets_its_trajectory_and_rows(
    video: tuple[Path, list[SimulatedTrack]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, objects = video
    assert main(command(folder, "--out", str(tmp_path / "out"))) == 0
    assert "track 3: 20 frames" in capsys.readouterr().out
    table = pq.read_table(tmp_path / "out" / "results.parquet").to_pydict()
    assert table["track"] == ["3"] * FRAMES + ["7"] * FRAMES
    assert table["image"][:2] == ["frame_0000.png", "frame_0001.png"]
    assert table["keypoints"][FRAMES + 9] == 0  # it has a pose all the same
    for name, each in zip((3, 7), objects, strict=True):
        lines = np.loadtxt(tmp_path / "out" / f"{name}.tum")
        np.testing.assert_allclose(lines[:, 0], each.times, atol=1e-8)
        truth = np.array([pose.translation for pose in each.poses])
        assert np.abs(lines[:, 1:4] - truth).max() < 0.4
        matrices = np.loadtxt(tmp_path / "out" / f"{name}.txt").reshape(-1, 3, 4)
        np.testing.assert_allclose(matrices[:, :, 3], lines[:, 1:4], atol=1e-8)
        assert len(matrices) == FRAMES


def test_the_page_and_the_animation_hold_every_track(
    video: tuple[Path, list[SimulatedTrack]], tmp_path: Path
) -> None:
    assert main(command(video[0], "--out", str(tmp_path))) == 0
    page = (tmp_path / "index.html").read_text()
    (text,) = re.findall(r'id="payload">(.*?)</script>', page)
    payload = json.loads(text)
    assert [row["method"] for row in payload["headline"]["rows"]] == ["3", "7"]
    plots = {plot["id"]: plot for plot in payload["plots"]}
    assert {"place_ahead", "turn_y", "speed", "turning", "residual"} <= set(plots)
    assert not any(plot["y"]["log"] for plot in plots.values())
    lines = np.loadtxt(tmp_path / "7.tum")
    (ahead,) = (t for t in plots["place_ahead"]["traces"] if t["method"] == "7")
    np.testing.assert_allclose(ahead["y"], lines[:, 3], rtol=1e-5)
    assert (np.array(ahead["low"]) < ahead["y"]).all()
    assert (np.array(ahead["high"]) > ahead["y"]).all()
    residuals = next(t for t in plots["residual"]["traces"] if t["method"] == "7")
    assert residuals["y"][9] is None  # nothing was detected
    assert min(plots["speed"]["traces"][0]["low"]) >= 0
    scene = trimesh.load(tmp_path / "tracks.glb")
    assert isinstance(scene, trimesh.Scene)
    assert len(scene.geometry) == 2


def is_red(picture: np.ndarray) -> np.ndarray:
    """Pixels (h, w) of the predicted box."""
    red, green, blue = picture.astype(int).transpose(2, 0, 1)
    return np.asarray((red > green + 60) & (red > blue + 60))


def test_the_video_shows_the_objects_where_they_are(
    video: tuple[Path, list[SimulatedTrack]], tmp_path: Path
) -> None:
    folder, objects = video
    size = (TRACK_CAMERA.height, TRACK_CAMERA.width, 3)
    pictures = [np.full(size, 120, dtype=np.uint8) for _ in range(FRAMES + 2)]
    write_movie(tmp_path / "clip.mp4", pictures, fps=30)
    given = ["--video", str(tmp_path / "clip.mp4"), "--first-frame", "-1"]
    assert main(command(folder, "--out", str(tmp_path), *given)) == 0
    overlay = Video.open(tmp_path / "overlay.mp4")
    drawn = [is_red(picture) for _, picture in overlay.pictures()]
    assert (len(drawn), overlay.rate) == (FRAMES + 2, 30.0)
    assert not drawn[0].any()
    assert not drawn[-1].any()
    for k, red in enumerate(drawn[1:-1]):
        corners = []
        for each in objects:
            low, high = each.points_3d.min(axis=0), each.points_3d.max(axis=0)
            corners.append(each.poses[k].apply([(low + high) / 2]))
        rows, columns = np.nonzero(red)
        for u, v in TRACK_CAMERA.project(np.concatenate(corners)):
            assert columns.min() < u < columns.max()
            assert rows.min() < v < rows.max()


def test_a_video_of_another_size_is_refused(
    video: tuple[Path, list[SimulatedTrack]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "pictures").mkdir()
    write_image(tmp_path / "pictures" / "0.png", np.zeros((48, 64, 3), dtype=np.uint8))
    line = refusal_line(capsys, *command(video[0], "--video", str(tmp_path / "pictures")))
    assert "its pictures are 64 x 48 px, those of the camera 640 x 480" in line


def test_a_video_that_has_none_of_the_frames_is_refused(
    video: tuple[Path, list[SimulatedTrack]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, _ = video
    blank = np.zeros((TRACK_CAMERA.height, TRACK_CAMERA.width, 3), np.uint8)
    path = tmp_path / "clip.mp4"
    write_movie(path, iter([blank] * 3), fps=10)
    more = ["--out", str(tmp_path / "out"), "--video", str(path), "--first-frame", "50"]
    for options in (more, [*more, "--image"]):
        assert main(command(folder, *options)) == 1
        message = "clip.mp4: it has none of the frames 0 to 19 of the detections; give their video"
        assert message in capsys.readouterr().err
    assert not (tmp_path / "out" / "overlay.mp4").exists()


def test_a_number_of_the_first_frame_without_a_video_file_is_refused(
    video: tuple[Path, list[SimulatedTrack]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, _ = video
    write_image(tmp_path / "frame_0.png", np.zeros((480, 640, 3), np.uint8))
    for more in ([], ["--video", str(tmp_path)]):
        line = refusal_line(capsys, *command(folder, "--first-frame", "3", *more))
        assert "--first-frame: has no effect without the file of a video; leave it out" in line


def test_images_of_another_size_than_the_cameras_are_refused(
    video: tuple[Path, list[SimulatedTrack]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, _ = video
    found = json.loads((folder / "found.json").read_text())
    for each in found["images"]:
        each |= {"width": 320, "height": 240}
    (tmp_path / "found.json").write_text(json.dumps(found))
    files = ["--shape", str(folder / "thing.shape"), "--camera", str(folder / "camera.json")]
    assert main(["track", str(tmp_path / "found.json"), *files]) == 1
    assert "the image has 320 x 240 pixels, that of the camera 640 x 480" in capsys.readouterr().err


def test_tracks_of_an_earlier_run_do_not_stay(
    video: tuple[Path, list[SimulatedTrack]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, out = video[0], tmp_path / "out"
    out.mkdir()
    (out / "7.tum").write_text("mine")
    found = json.loads((folder / "found.json").read_text())
    found["annotations"] = [each for each in found["annotations"] if each["track_id"] == 3]
    (tmp_path / "one.json").write_text(json.dumps(found))
    one = ["track", str(tmp_path / "one.json"), *command(folder, "--out", str(out))[2:]]
    assert main(one) == 0
    assert (out / "7.tum").read_text() == "mine"  # which no run wrote
    assert main(command(folder, "--out", str(out))) == 0
    (out / "overlay.mp4").touch()
    (out / "notes.txt").touch()
    assert main(one) == 0
    own = ["3.tum", "3.txt", "index.html", "results.parquet", "tracks.glb"]
    assert sorted(path.name for path in out.iterdir()) == sorted([*own, "notes.txt"])


def test_inputs_are_not_written_over(
    video: tuple[Path, list[SimulatedTrack]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shape = tmp_path / "3.txt"  # which the trajectory would be called
    shape.write_bytes((video[0] / "thing.shape").read_bytes())
    before = shape.read_bytes()
    given = command(video[0], "--out", str(tmp_path))
    given[given.index("--shape") + 1] = str(shape)
    assert main(given) == 1
    assert f"{shape}: what is to be written is made from this file" in capsys.readouterr().err
    assert shape.read_bytes() == before


def test_the_table_of_a_run_is_not_written_over(
    video: tuple[Path, list[SimulatedTrack]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = RunFolder(tmp_path)
    run.config_file.write_text("{}")
    run.results.write_bytes(b"a table")
    assert main(command(video[0], "--out", str(tmp_path))) == 1
    assert "holds a run, whose results.parquet would be written over" in capsys.readouterr().err
    assert run.results.read_bytes() == b"a table"


def test_a_run_that_estimates_no_track_names_no_trajectories(
    video: tuple[Path, list[SimulatedTrack]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, _ = video
    assert main(command(folder, "--min-score", "5", "--out", str(tmp_path / "out"))) == 1
    assert "Trajectories" not in capsys.readouterr().err


@pytest.mark.long
def test_pictures_are_evidence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A car that turns before a grey wall, with rough keypoints."""
    dataset = KeypointNet(write_sample_dataset(tmp_path / "sample", per_category=5))
    cars = [dataset[key] for key in sorted(dataset.ids()) if key[0] == "car"]
    known = examples_of(cars[1:], meshes=True, on_progress=lambda done, total: None)
    ShapeModel.learn(known, category="car").save(tmp_path / "car.shape")
    own, scene, rng = cars[0].keypoints, Scene(cars[0].load_mesh()), np.random.default_rng(1)
    camera, truths, rows = (
        Camera(320, 240, 400, 400, 159.5, 119.5),
        [],
        ["image,track,semantic_id,u,v"],
    )
    (tmp_path / "clip").mkdir()
    for k in range(6):
        truths.append(look_at(azimuth=30.0 + 4 * k, elevation=15.0, distance=2.2))
        picture = RaycastRenderer().render(scene, camera, truths[-1])
        wall = np.full((240, 320, 3), 150, dtype=np.uint8)
        write_image(tmp_path / "clip" / f"frame_{k}.png", picture.composite(wall))
        places = camera.project(truths[-1].apply(own.xyz)) + rng.normal(0, 4, (len(own.xyz), 2))
        marks = zip(own.ids, places, strict=True)
        rows += [f"frame_{k}.png,a,{name},{u},{v}" for name, (u, v) in marks]
    (tmp_path / "found.csv").write_text("\n".join(rows))
    (tmp_path / "camera.json").write_text(json.dumps(camera.to_dict()))
    files = {"--shape": "car.shape", "--camera": "camera.json", "--video": "clip", "--out": "out"}
    given = [word for name, file in files.items() for word in (name, str(tmp_path / file))]
    errors = []
    for more in ([], ["--image"]):
        assert main(["track", str(tmp_path / "found.csv"), *given, "--sigma", "4", *more]) == 0
        poses = np.loadtxt(tmp_path / "out" / "a.txt").reshape(-1, 3, 4)[:, :, :3]
        pairs = zip(poses, truths, strict=True)
        errors.append(np.mean([angle_between(est, truth.rotation) for est, truth in pairs]))
    assert errors[1] < 0.9 * errors[0], errors
    assert re.search(r"rms .* px, [456] of 6 pictures", capsys.readouterr().out)


def test_csv_with_tracks_is_read(video: tuple[Path, list[SimulatedTrack]], tmp_path: Path) -> None:
    folder, objects = video
    rows = [
        f"frame_{k:04d}.png,a,{name},{u},{v}"
        for k, view in enumerate(objects[0].views)
        for name, (u, v) in zip(view.keypoint_ids, np.asarray(view.points_2d), strict=True)
    ]
    path = tmp_path / "found.csv"
    of_both = [row.replace(",a,", f",{name},") for name in ("a/b", "a_b") for row in rows]
    path.write_text("\n".join(["image,track,name,u,v", *of_both]))
    files = ["--shape", str(folder / "thing.shape"), "--camera", str(folder / "camera.json")]
    assert main(["track", str(path), *files]) == 0
    for name in ("a_b.tum", "a_b_2.tum", "a_b.txt", "a_b_2.txt"):
        assert (tmp_path / "found_tracks" / name).is_file()


def test_names_count_as_for_fit_and_folders_of_one_name_are_two_videos(
    video: tuple[Path, list[SimulatedTrack]], tmp_path: Path
) -> None:
    folder, objects = video
    rows = [
        f"{place}/left/frame_{k + start:04d}.png,1,{str(name).title().replace(' ', '_')},{u},{v}"
        for place, start in (("a", 0), ("b", FRAMES))
        for k, view in enumerate(objects[0].views)
        for name, (u, v) in zip(view.keypoint_ids, np.asarray(view.points_2d), strict=True)
    ]
    path = tmp_path / "found.csv"
    path.write_text("\n".join(["image,track,name,u,v", *rows]))
    files = ["--shape", str(folder / "thing.shape"), "--camera", str(folder / "camera.json")]
    assert main(["track", str(path), *files]) == 0
    table = pq.read_table(tmp_path / "found_tracks" / "results.parquet").to_pydict()
    assert table["track"] == ["a/left/1"] * FRAMES + ["b/left/1"] * FRAMES
    assert sum(table["keypoints"]) == len(rows)


@pytest.mark.parametrize(
    ("more", "line"),
    [
        (["--rate", "0"], "--rate: 0 is not positive"),
        (["--angular-sigma", "-1"], "--angular-sigma: -1.0 is not positive"),
        (["--image"], "--image: pictures as evidence need the video; give --video"),
    ],
)
def test_bad_options_are_refused(
    video: tuple[Path, list[SimulatedTrack]],
    more: list[str],
    line: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert line in refusal_line(capsys, *command(video[0], *more))


def test_two_objects_of_one_track_in_an_image_are_refused(
    video: tuple[Path, list[SimulatedTrack]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, _ = video
    found = json.loads((folder / "found.json").read_text())
    found["annotations"].append(found["annotations"][0])
    (tmp_path / "found.json").write_text(json.dumps(found))
    given = command(folder)
    given[1] = str(tmp_path / "found.json")
    assert "a second object of track '3' in image 'frame_0000.png'" in refusal_line(capsys, *given)


def test_times_are_no_numbers_of_frames(
    video: tuple[Path, list[SimulatedTrack]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = json.loads((video[0] / "found.json").read_text())
    for k, image in enumerate(found["images"]):
        image["file_name"] = f"{1403636579763555584 + 50_000_000 * k}.png"
    (tmp_path / "found.json").write_text(json.dumps(found))
    given = command(video[0])
    given[1] = str(tmp_path / "found.json")
    line = refusal_line(capsys, *given)
    assert "track '3' goes from frame 1403636579763555584 to " in line
    assert "name images by the numbers of their frames, not by times" in line
