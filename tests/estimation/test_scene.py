"""`align_scene`: objects of one photo share its camera, gravity and the ground."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial import ConvexHull
from support.refusals import refusal_line, refusal_text

from cadalign import (
    Alignment,
    Camera,
    FocalPrior,
    Mesh,
    Model,
    RansacOptions,
    Result,
    SceneObject,
    Size,
    View,
    align,
    align_scene,
)
from cadalign.cli import main
from cadalign.errors import DegenerateError, InputError
from cadalign.estimation.result_parts import Stated
from cadalign.evaluation.simulation import UNIT_BOUNDS, simulate_standing_boxes
from cadalign.geometry.metrics import rotation_error
from cadalign.geometry.rotations import rotation_from_vector
from cadalign.io.observation import Observation
from cadalign.render import Scene, cast_geometry

FOCAL, HEIGHT = 700.0, 1.6
CAMERA = Camera(640, 480, FOCAL, FOCAL, 319.5, 239.5)
UNKNOWN = Camera.without_focal(640, 480)


class Simulated:
    """Boxes of unknown stretch that stand on the ground, seen by a camera that looks down."""

    def __init__(self, seed: int, count: int, noise: float = 1.0, points: int = 10) -> None:
        rng = np.random.default_rng(seed)
        boxes, up = simulate_standing_boxes(
            rng, objects=count, camera=CAMERA, camera_height=HEIGHT, points=points, noise_px=noise
        )
        self.up = up
        self.points = [each.points_3d for each in boxes]
        self.poses = [each.alignment for each in boxes]
        self.pixels = [each.points_2d for each in boxes]

    def objects(self, camera: Camera, *, sized: int = 0, **evidence: Any) -> list[SceneObject]:
        return [
            SceneObject(
                Model(points_3d=points, bounds=UNIT_BOUNDS, stretch_sigma=0.3),
                View(camera, pixels, **evidence),
                size=Size(width=1.0) if number < sized else None,
            )
            for number, (points, pixels) in enumerate(zip(self.points, self.pixels, strict=True))
        ]


@pytest.mark.long
def test_objects_share_their_focal_length_and_it_is_as_uncertain_as_stated() -> None:
    errors: dict[int, list[float]] = {1: [], 4: []}
    stated: dict[int, list[float]] = {1: [], 4: []}
    for seed in range(30):
        for count, found in errors.items():
            scene = align_scene(Simulated(seed, count).objects(UNKNOWN))
            assert not scene.warnings
            found.append(np.log(scene.camera.fx / FOCAL))
            stated[count].append(scene.focal_std)
            for result in scene.results:
                assert isinstance(result, Result)
                assert abs(np.log(result.camera.fx / scene.camera.fx)) < 0.5 * scene.focal_std
    rms = {count: np.sqrt(np.mean(np.square(found))) for count, found in errors.items()}
    assert rms[4] < 0.55 * rms[1]
    for count, found in errors.items():
        inside = np.abs(found) < 1.96 * np.array(stated[count])
        assert inside.mean() >= 0.88


def test_one_object_is_aligned_as_alone() -> None:
    (given,) = Simulated(1, 1).objects(UNKNOWN)
    scene = align_scene([given])
    alone = align(given.model, given.view, focal="estimate")
    assert isinstance(scene.results[0], Result)
    assert scene.results[0].alignment == alone.alignment
    assert scene.camera.fx == pytest.approx(alone.camera.fx, rel=1e-6)
    assert alone.std is not None
    assert scene.focal_std == pytest.approx(alone.std.focal, rel=1e-3)


def test_a_prior_is_that_of_the_other_objects_only_where_there_are_others() -> None:
    first, second = Simulated(0, 2).objects(UNKNOWN)
    alone, together = align_scene([first]), align_scene([first, second])
    sources = [scene.results[0].focal_prior.source for scene in (alone, together)]
    assert sources == ["usual lenses", "the other objects"]


def test_gravity_and_ground_are_shared_where_asked() -> None:
    simulated = Simulated(3, 3)
    scene = align_scene(simulated.objects(CAMERA, sized=1), share=("gravity", "ground"))
    assert scene.camera == CAMERA
    assert scene.focal_std == 0.0
    assert scene.up is not None
    off = np.degrees(np.arccos(scene.up @ simulated.up))
    assert off < 3 * scene.up_std_deg < 6.0
    assert scene.camera_height is not None
    assert abs(np.log(scene.camera_height / HEIGHT)) < 3 * scene.camera_height_std < 0.3
    # The size of the objects without a known length follows from the ground.
    for result, truth in zip(scene.results, simulated.poses, strict=True):
        assert isinstance(result, Result)
        assert result.std is not None
        off = np.abs(np.log(result.alignment.scale / truth.scale))
        assert (off < 4 * np.array(result.std.scale) + 1e-3).all()
    assert "above the ground" in str(scene)
    without = align_scene(simulated.objects(CAMERA), share=("gravity",))
    assert without.camera_height is None


def test_ground_that_tells_nothing_is_warned_of() -> None:
    scene = align_scene(Simulated(0, 2).objects(CAMERA), share=("ground",))
    assert scene.camera_height is None
    assert scene.warnings == (
        "the ground tells nothing: give the size of an object, or the camera's height",
    )


def test_known_camera_height_tells_the_size_of_all() -> None:
    simulated = Simulated(4, 2)
    known = simulated.objects(CAMERA, up=simulated.up, camera_height=HEIGHT)
    scene = align_scene(known, share=("gravity", "ground"))
    assert scene.camera_height == pytest.approx(HEIGHT, rel=0.1)
    for result in scene.results:
        assert isinstance(result, Result)
        assert result.alignment.scale[0] == pytest.approx(1.0, rel=0.15)


@pytest.mark.long
def test_object_that_contradicts_the_others_is_named_and_left_alone() -> None:
    named = 0
    for seed in range(10):
        simulated = Simulated(seed, 4, noise=0.3, points=14)
        objects = simulated.objects(UNKNOWN, sigma=0.3)
        wide = Camera(640, 480, 2100.0, 2100.0, 319.5, 239.5)
        pose = replace(simulated.poses[1], translation=3 * simulated.poses[1].translation)
        other = wide.project(pose.apply(simulated.points[1]))
        objects[1] = replace(objects[1], view=View(UNKNOWN, other, sigma=0.3), name="poster")
        scene = align_scene(objects)
        named += any(
            text.startswith("poster contradicts the focal length") for text in scene.warnings
        )
        assert not any("objects[" in text for text in scene.warnings)
        assert abs(np.log(scene.camera.fx / FOCAL)) < 4 * scene.focal_std
    assert named >= 8


@pytest.mark.parametrize("degrees", [20.0, 180.0])
def test_wrong_gravity_of_one_view_is_named_and_left_out(degrees: float) -> None:
    simulated = Simulated(5, 3)
    objects = simulated.objects(CAMERA)
    axis = np.cross(simulated.up, [0.0, 0.0, 1.0])
    turn = rotation_from_vector(np.radians(degrees) * axis / np.linalg.norm(axis))
    objects[1] = replace(objects[1], view=replace(objects[1].view, up=turn @ simulated.up))
    scene = align_scene(objects, share=("gravity",))
    assert scene.warnings == (
        "the `up` that is given contradicts the objects, and is left out: check it",
    )
    assert scene.up is not None
    assert np.degrees(np.arccos(scene.up @ simulated.up)) < 3 * scene.up_std_deg < 4.0
    for result, truth in zip(scene.results, simulated.poses, strict=True):
        assert isinstance(result, Result)
        assert rotation_error(est=result.alignment, gt=truth) < 4


def test_object_that_lies_is_named_where_gravity_is_given() -> None:
    simulated = Simulated(5, 2)
    objects = simulated.objects(CAMERA)
    lying = Model(points_3d=simulated.points[0][:, [0, 2, 1]] * [1, 1, -1], stretch_sigma=0.3)
    objects[0] = replace(objects[0], model=lying, name="lying")
    objects[1] = replace(objects[1], view=replace(objects[1].view, up=simulated.up))
    (text,) = align_scene(objects, share=("gravity",)).warnings
    assert text == (
        "lying contradicts the direction of gravity of the other objects, or the `up` that is "
        "given, and is aligned alone: check its model, its keypoints, and whether it stands in "
        "this photo"
    )


def test_wrong_prior_on_the_focal_length_is_left_out() -> None:
    scene = align_scene(Simulated(6, 3).objects(UNKNOWN), focal_prior=FocalPrior(2100.0, 0.02))
    assert scene.warnings == (
        "the prior on the focal length contradicts the objects, and is left out: check it",
    )
    assert abs(np.log(scene.camera.fx / FOCAL)) < 3 * scene.focal_std < 0.5


@pytest.mark.parametrize(
    ("first", "second", "name"),
    [
        ({"camera_height": 1.0}, {"camera_height": 2.0}, "camera_height"),
        ({"up": [0, -1, 0.2]}, {"up": [0, 1, -0.2]}, "up"),
    ],
)
def test_views_that_contradict_each_other_are_refused(
    first: dict[str, Any], second: dict[str, Any], name: str
) -> None:
    objects = [
        replace(each, view=replace(each.view, **evidence))
        for each, evidence in zip(Simulated(4, 2).objects(CAMERA), (first, second), strict=True)
    ]
    assert refusal_text(lambda: align_scene(objects, share=("ground",))) == (
        f"objects[1].view.{name}: contradicts the {name} of an object before, which the photo "
        "shares; give the one that is right"
    )
    assert not align_scene(objects, share=()).warnings


def test_calibrated_focal_length_is_estimated_where_asked() -> None:
    objects = Simulated(6, 3).objects(CAMERA.with_focal(2100.0))
    scene = align_scene(objects, focal="estimate")
    assert abs(np.log(scene.camera.fx / FOCAL)) < 3 * scene.focal_std < 0.5


def test_hypotheses_are_aligned_where_nothing_is_shared() -> None:
    ransac = RansacOptions(refine=False)
    scene = align_scene(Simulated(5, 2).objects(CAMERA), ransac=ransac)
    assert not scene.results.errors
    assert refusal_text(lambda: align_scene(Simulated(5, 2).objects(UNKNOWN), ransac=ransac)) == (
        "refine: a hypothesis has no covariance, by which objects share what is unknown; "
        "leave it True, or share nothing"
    )


def test_object_without_covariance_is_aligned_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    objects = Simulated(5, 3).objects(UNKNOWN)

    def bare(model: Model, view: View, **options: Any) -> Result:
        result = align(model, view, **options)
        if model is not objects[1].model:
            return result
        return replace(result, statistics=Stated(None))

    monkeypatch.setattr("cadalign.estimation.scene.align", bare)
    scene = align_scene(objects)
    assert scene.warnings == ("objects[1] has no covariance to share by, and is aligned alone",)
    assert 0 < scene.focal_std < 0.2


def test_bad_object_stops_no_other() -> None:
    objects = Simulated(5, 3).objects(UNKNOWN)
    few = View(UNKNOWN, np.asarray(objects[1].view.points_2d)[:2])
    scene = align_scene([objects[0], replace(objects[1], view=few), objects[2]])
    assert list(scene.results.errors) == [1]
    assert isinstance(scene.results[2], Result)


def test_only_objects_that_can_gain_are_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Keypoints on one line gain by gravity, nothing by the focal length."""
    objects = Simulated(6, 3).objects(UNKNOWN)
    line = np.linspace(0, 1, 10)[:, None] * np.ones(3)
    objects[1] = replace(objects[1], model=replace(objects[1].model, points_3d=line))
    tried: list[object] = []

    def counted(model: Model, *given: Any, **options: Any) -> Result:
        tried.append(model)
        return align(model, *given, **options)

    monkeypatch.setattr("cadalign.estimation.scene.align", counted)
    for share, count, kind in (("focal", 1, DegenerateError), ("gravity", 2, Result)):
        tried.clear()
        scene = align_scene(objects, share=("focal", share))
        assert sum(model is objects[1].model for model in tried) == count
        assert isinstance(scene.results[1], kind)


@pytest.mark.long
def test_mask_alone_takes_the_focal_length_of_the_others() -> None:
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float) - 0.5
    corners[corners[:, 1] > 0] *= [0.4, 1.0, 0.6]
    corners[corners[:, 1] > 0] += [0.1, 0.0, 0.15]
    mesh = Mesh(corners, ConvexHull(corners).simplices.astype(np.int64))
    turn = rotation_from_vector([2.6, 0.5, 0.3])
    truth = Alignment(turn, [0.4, 0.1, 3.0], np.ones(3))
    seen = View(UNKNOWN, mask=cast_geometry(Scene(mesh), CAMERA, truth).mask)
    others = Simulated(5, 3).objects(UNKNOWN)
    masked = SceneObject(Model(mesh=mesh, stretch="none"), seen)
    scene = align_scene([masked, *others])
    found = scene.results[0]
    assert isinstance(found, Result)
    assert rotation_error(est=found.alignment, gt=truth) < 2
    assert abs(np.log(found.camera.fx / FOCAL)) < 3 * found.std.focal < 0.3
    assert scene.camera.fx == pytest.approx(align_scene(others).camera.fx)


def test_prior_on_the_focal_length_counts_once() -> None:
    objects = Simulated(6, 3).objects(UNKNOWN)
    tight = FocalPrior(FOCAL, 0.001)
    scene = align_scene(objects, focal_prior=tight)
    assert scene.focal_std == pytest.approx(0.001, rel=0.05)
    assert scene.focal_std < 0.001


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"share": ("size",)}, "share: ('size',) is not what objects share; give some of focal"),
        ({"share": "focal"}, "share: 'focal' is not what objects share"),
        ({"objects": []}, "objects: expected at least one object"),
        ({"objects": [1]}, "objects[0]: expected a cadalign.SceneObject, got int"),
        ({"tilt_sigma_deg": -1}, "tilt_sigma_deg: "),
        ({"share": 5}, "share: 5 is not what objects share; give some of focal"),
        ({"share": None}, "share: None is not what objects share"),
        ({"share": ["focal", ["x"]]}, "share: ['focal', ['x']] is not what objects share"),
        ({"loss": "foo"}, "loss: unknown loss 'foo'; known are linear, huber, cauchy"),
        ({"focal": "guess"}, "focal: unknown focal 'guess'; known are known, estimate"),
        ({"ransac": 3}, "ransac: expected a cadalign.RansacOptions, got int"),
    ],
)
def test_wrong_arguments_are_refused(changes: dict[str, Any], message: str) -> None:
    arguments = {"objects": Simulated(0, 2).objects(UNKNOWN), **changes}
    with pytest.raises(InputError) as caught:
        align_scene(**arguments)
    assert str(caught.value).startswith(message)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"model": 3}, "objects: no object can be aligned: model: expected a cadalign.Model or a "),
        ({"size": 1.0}, "objects: no object can be aligned: size: expected a cadalign.Size, got "),
        ({"init": 1}, "objects: no object can be aligned: init: expected a cadalign.Alignment, "),
        ({"view": [1]}, "objects[0].view: expected a cadalign.View, got list; give the object's "),
    ],
)
def test_wrong_fields_of_all_objects_are_refused(changes: dict[str, Any], message: str) -> None:
    objects = [replace(each, **changes) for each in Simulated(0, 2).objects(UNKNOWN)]
    with pytest.raises(InputError) as caught:
        align_scene(objects)
    assert str(caught.value).startswith(message)


def test_prior_on_a_known_focal_length_is_refused_as_by_align() -> None:
    objects = Simulated(0, 2).objects(CAMERA)
    assert refusal_text(lambda: align_scene(objects, focal_prior=FocalPrior(FOCAL))) == (
        'focal_prior: given for a known focal length; give focal="estimate" with it'
    )


def test_objects_of_two_photos_are_refused() -> None:
    first, second = Simulated(0, 2).objects(UNKNOWN)
    moved = replace(second, view=replace(second.view, camera=CAMERA))
    with pytest.raises(InputError, match="the camera differs from the first object's"):
        align_scene([first, moved])
    flat = replace(first, model=Model(points_3d=first.model.points_3d, up_axis=None))  # type: ignore[union-attr]
    with pytest.raises(InputError, match="the model has no up axis"):
        align_scene([flat, second], share=("gravity",))


# --- files ------------------------------------------------------------------------------------


def write_scene(folder: Path, *, names: tuple[str, ...] = ("left", "right")) -> Path:
    simulated = Simulated(7, 2)
    objects = []
    for number, (points, pixels) in enumerate(zip(simulated.points, simulated.pixels, strict=True)):
        seen = Observation(points, pixels, UNKNOWN, object_name=names[number]).to_dict()
        camera = seen.pop("camera")
        objects.append(seen)
    path = folder / "scene.json"
    path.write_text(json.dumps({"camera": camera, "objects": objects, "share": ["focal"]}))
    return path


def test_file_of_several_objects_is_aligned_together(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_scene(tmp_path)
    assert main(["fit", str(path)]) == 0
    printed = capsys.readouterr().out
    assert printed.startswith("scene of 2 objects\n  focal length ")
    written = json.loads((tmp_path / "scene_fit" / "scene.json").read_text())
    assert [each["name"] for each in written["objects"]] == ["left", "right"]
    results = [
        Result.from_json((tmp_path / "scene_fit" / name / "fit.json").read_text())
        for name in ("left", "right")
    ]
    for result, truth in zip(results, Simulated(7, 2).poses, strict=True):
        assert rotation_error(est=result.alignment, gt=truth) < 10
        assert result.camera.fx == pytest.approx(written["camera"]["params"][0], rel=0.05)
    assert (tmp_path / "scene_fit" / "left" / "overlay.png").is_file()
    document = json.loads((tmp_path / "scene_fit" / "left" / "fit.json").read_text())
    assert document["observation"] == "observation.json"


def test_file_of_several_objects_names_what_is_wrong(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_scene(tmp_path, names=("box", "box"))
    assert main(["fit", str(path)]) == 1
    assert "objects[1]: two objects are named 'box'" in capsys.readouterr().err
    data = json.loads(path.read_text())
    path.write_text(json.dumps(data | {"objects": []}))
    assert main(["fit", str(path)]) == 1
    assert "objects: expected a list of objects" in capsys.readouterr().err
    path.write_text(json.dumps(data | {"share": ["colour"]}))
    data["objects"][1]["object"] = "other"
    path.write_text(json.dumps(data | {"share": ["colour"]}))
    assert main(["fit", str(path)]) == 1
    message = f"{path}: share: ['colour'] is not what objects share"
    assert message in " ".join(capsys.readouterr().err.split())


def test_json_of_several_objects_has_their_fits_and_errors(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_scene(tmp_path)
    data = json.loads(path.read_text())
    data["objects"][1]["keypoints"] = data["objects"][1]["keypoints"][:2]
    path.write_text(json.dumps(data))
    assert main(["fit", str(path), "--json"]) == 3
    left, right = json.loads(capsys.readouterr().out)["objects"]
    written = json.loads((tmp_path / "scene_fit" / "left" / "fit.json").read_text())
    assert left == {"name": "left", "folder": "left", "fit": written}
    assert right["error"].startswith("points_3d: 2 keypoints are too few")


def test_several_objects_are_no_observation_of_a_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_scene(tmp_path)
    message = "several objects of one photo, not one observation; give it alone to `cadalign fit`"
    for number, inputs in enumerate(([path, path], [tmp_path])):
        out = str(tmp_path / f"run_{number}")
        assert main(["fit", *map(str, inputs), "--out", out]) == 1
        assert message in " ".join(capsys.readouterr().err.split())
    assert main(["fit", str(path), "--out", str(tmp_path / "done")]) == 0
    assert main(["fit", str(tmp_path / "done")]) == 1
    assert "the folder holds no observation" in capsys.readouterr().err


def test_every_object_has_a_folder_of_its_own(tmp_path: Path) -> None:
    path = write_scene(tmp_path, names=("a/b", "A_b"))
    assert main(["fit", str(path)]) == 0
    written = json.loads((tmp_path / "scene_fit" / "scene.json").read_text())
    folders = {each["name"]: each["folder"] for each in written["objects"]}
    assert folders == {"a/b": "a_b", "A_b": "A_b_2"}
    for name, folder in folders.items():
        seen = Observation.load(tmp_path / "scene_fit" / folder / "observation.json")
        assert seen.object_name == name


def test_objects_of_an_earlier_fit_do_not_stay(tmp_path: Path) -> None:
    folder = tmp_path / "scene_fit"
    path = write_scene(tmp_path)
    assert main(["fit", str(path)]) == 0
    (folder / "right" / "notes.txt").touch()
    data = json.loads(path.read_text())
    data["objects"][0]["object"] = "front"
    data["objects"][1]["keypoints"] = data["objects"][1]["keypoints"][:2]  # fails
    path.write_text(json.dumps(data))
    assert main(["fit", str(path)]) == 3
    assert sorted(each.name for each in folder.iterdir()) == ["front", "right", "scene.json"]
    assert [each.name for each in (folder / "right").iterdir()] == ["notes.txt"]
    (tmp_path / "observation.json").touch()
    (folder / "scene.json").write_text('{"objects": [{"folder": ".."}, {"folder": 3}, 4]}')
    assert main(["fit", str(path)]) == 3
    assert (tmp_path / "observation.json").exists()


def test_no_object_is_written_outside_of_the_folder(tmp_path: Path) -> None:
    path = write_scene(tmp_path, names=("..", "scene.json"))
    assert main(["fit", str(path)]) == 0
    written = json.loads((tmp_path / "scene_fit" / "scene.json").read_text())
    assert [each["folder"] for each in written["objects"]] == ["object", "scene.json_2"]
    assert not (tmp_path / "fit.json").exists()


def test_options_that_hold_for_no_scene_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_scene(tmp_path)
    assert refusal_line(capsys, "fit", path, "--method", "epnp") == (
        "--method: has no effect together with the file's objects; leave out one of the two"
    )
    assert refusal_line(capsys, "fit", path, "--overlay", tmp_path / "drawn.png") == (
        "--overlay: draws one object, the file has several; "
        "give it with an object's observation.json, which is written without it"
    )
    data = json.loads(path.read_text())
    path.write_text(json.dumps(data | {"share": 5}))
    assert refusal_line(capsys, "fit", path) == (
        f"{path}: share: 5 is not what objects share; give some of focal, gravity, ground"
    )


def test_options_of_one_object_alone_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_scene(tmp_path)
    data = json.loads(path.read_text())
    data["objects"][1]["fit"] = {"loss": "cauchy"}
    path.write_text(json.dumps(data))
    assert refusal_line(capsys, "fit", path) == (
        "right: fit.loss: 'cauchy', but 'linear' for left; "
        "give objects of one photo the same options, beside `objects`"
    )
    del data["objects"][1]["fit"]
    path.write_text(json.dumps(data | {"fit": {"loss": "cauchy"}}))
    assert main(["fit", str(path)]) == 0


def test_calibrated_focal_length_of_a_file_is_estimated_where_asked(tmp_path: Path) -> None:
    path = write_scene(tmp_path)
    camera = CAMERA.with_focal(3 * FOCAL).to_dict()
    path.write_text(json.dumps(json.loads(path.read_text()) | {"camera": camera}))
    assert main(["fit", str(path), "--focal", "estimate"]) == 0
    written = json.loads((tmp_path / "scene_fit" / "scene.json").read_text())
    assert abs(np.log(written["camera"]["params"][0] / FOCAL)) < 3 * written["focal_std"] < 0.6
