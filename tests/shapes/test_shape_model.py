"""`ShapeModel`: learning, bases, files and validation."""

from __future__ import annotations

import os
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.refusals import refusal_text

import cadalign
from cadalign.datasets import KeypointNet
from cadalign.errors import InputError
from cadalign.geometry.rotations import vector_from_rotation
from cadalign.io.files import Seal
from cadalign.shapes.basis import find_mirror, is_symmetry
from cadalign.shapes.examples import Example
from cadalign.shapes.model import ShapeModel
from cadalign.shapes.outputs import SEAL
from cadalign.shapes.parts import FewKeypoints, ShapeComponent

TABLE = np.array(
    [[-1, 0, -2], [1, 0, -2], [-1, 0, 2], [1, 0, 2], [-1, 1, -2], [1, 1, -2], [0, 1.5, 0]],
    dtype=float,
)
IDS = list(range(7))
CHI_SQUARE_95 = 7.815  # three degrees of freedom


def tables(
    count: int, *, seed: int = 0, spread: float = 0.2, noise: float = 0.02, missing: float = 0.0
) -> list[Example]:
    """Tables of random sizes, some with missing keypoints."""
    rng = np.random.default_rng(seed)
    found = []
    for row in range(count):
        points = TABLE * rng.lognormal(0, spread, 3) + rng.normal(0, noise, TABLE.shape)
        kept = np.flatnonzero(rng.random(len(points)) >= missing)
        kept = kept if len(kept) else np.arange(2)
        bounds = np.array([points.min(axis=0) - 0.1, points.max(axis=0) + 0.1])
        found.append(Example(f"table {row}", kept.tolist(), points[kept], bounds))
    return found


@pytest.fixture(scope="module")
def learned() -> ShapeModel:
    return ShapeModel.learn(tables(80, missing=0.2), category="table", up_axis="y")


@pytest.mark.long
def test_the_mean_is_the_mean_of_the_models(learned: ShapeModel) -> None:
    expected = np.mean([each.points_3d for each in tables(80)], axis=0)
    assert learned.ids == tuple(IDS)
    assert np.abs(learned.mean[:-2] - expected).max() < 0.1
    assert learned.mean[-2:] == pytest.approx(
        np.mean([each.bounds for each in tables(80)], axis=0), abs=0.1
    )


@pytest.mark.slow
def test_the_modes_are_the_three_sizes(learned: ShapeModel) -> None:
    component = max(learned.components, key=lambda each: each.weight)
    shares = component.variance / np.trace(component.covariance)
    assert shares[:3].sum() > 0.9
    assert (np.diff(component.variance) <= 1e-12).all()


@pytest.mark.long
def test_a_symmetric_category_gets_a_symmetric_shape() -> None:
    """The mirror is across x or z; without it a mean of 60 models is not symmetric."""
    mean = ShapeModel.learn(tables(60), components=1).components[0].mean[:-2]
    gaps = []
    for axis, partners in ((0, [1, 0, 3, 2, 5, 4, 6]), (2, [2, 3, 0, 1, 4, 5, 6])):
        image = mean[partners]
        image[:, axis] = -image[:, axis]
        image[:, axis] += (mean - image)[:, axis].mean()
        gaps.append(np.abs(image - mean).max())
    assert min(gaps) < 1e-6


@pytest.mark.long
def test_two_kinds_of_objects_get_two_components() -> None:
    rng = np.random.default_rng(5)
    high = [Example(f"{row}", IDS, TABLE + rng.normal(0, 0.05, (7, 3))) for row in range(40)]
    flat = [
        Example(f"flat {row}", IDS, TABLE * [1, 0.2, 0.5] + rng.normal(0, 0.05, (7, 3)))
        for row in range(20)
    ]
    model = ShapeModel.learn([*high, *flat])
    assert len(model.components) == 2
    assert model.components[0].weight == pytest.approx(2 / 3, abs=0.02)
    assert len(ShapeModel.learn(high).components) == 1


@pytest.mark.long
def test_learning_does_not_depend_on_the_unit() -> None:
    models, factor = tables(30), 730.0
    scaled = [
        Example(each.model_id, each.ids, each.points_3d * factor, each.bounds * factor)
        for each in models
        if each.bounds is not None
    ]
    plain, other = ShapeModel.learn(models), ShapeModel.learn(scaled)
    assert len(plain.components) == len(other.components)
    assert other.mean == pytest.approx(plain.mean * factor, rel=1e-5, abs=1e-5 * factor)


@pytest.mark.slow
def test_without_bounds_boxes_are_extents_of_keypoints() -> None:
    bare = [replace(each, bounds=None) for each in tables(30)]
    model = ShapeModel.learn(bare, components=1)
    extents = np.array([[e.points_3d.min(axis=0), e.points_3d.max(axis=0)] for e in bare])
    offset = model.mean[-2:] - extents.mean(axis=0)
    assert np.abs(offset).max() < 0.1


@pytest.mark.parametrize("count", [4, 5, 11])
def test_few_models_still_give_a_model(count: int) -> None:
    model = ShapeModel.learn(tables(count, missing=0.3))
    assert np.isfinite(model.components[0].covariance).all()
    assert (np.linalg.eigvalsh(model.components[0].covariance) > 0).all()


def test_few_models_predict_their_errors() -> None:
    """Uncalibrated, the 95 % regions of 6 models hold none of these rotations."""
    model = ShapeModel.learn(tables(6, seed=1, noise=0.2))
    camera = cadalign.Camera(640, 480, 900, 900, 319.5, 239.5)
    within = 0
    for row, each in enumerate(tables(40, seed=2, noise=0.2)):
        rng = np.random.default_rng(row)
        rotation = Rotation.random(random_state=row).as_matrix()
        seen = camera.project(each.points_3d @ rotation.T + [0, 0, 12.0])
        found = cadalign.align(model, cadalign.View(camera, seen + rng.normal(0, 1, seen.shape)))
        error = vector_from_rotation(rotation @ found.alignment.rotation.T)
        within += error @ np.linalg.solve(found.covariance[:3, :3], error) < CHI_SQUARE_95
    assert within >= 34


def test_models_on_one_line_are_learned() -> None:
    model = ShapeModel.learn(
        [Example(f"{row}", IDS, TABLE * [1 + row / 50, 0, 0]) for row in range(20)]
    )
    assert np.abs(model.mean[:7, 1:]).max() < 1e-9


@pytest.mark.parametrize("count", [1, 10])
def test_models_in_another_unit_cause_a_warning(
    count: int, caplog: pytest.LogCaptureFixture
) -> None:
    models = tables(20)
    ShapeModel.learn(models[:6])
    assert not caplog.text
    odd = [
        Example(f"mm {row}", each.ids, each.points_3d * 1000)
        for row, each in enumerate(models[:count])
    ]
    ShapeModel.learn([*models[count:], *odd], components=1)
    assert f"models of another size than the others: {count} of 20, such as" in caplog.text
    assert "give all in one unit" in caplog.text


@pytest.mark.parametrize(
    ("turn", "words"),
    [
        ([[1, 0, 0], [0, 0, -1], [0, 1, 0]], "with (x, z, -y) as (x, y, z);"),
        ([[-1, 0, 0], [0, 1, 0], [0, 0, 1]], "with (-x, y, z) as (x, y, z), mirrored;"),
    ],
)
def test_models_with_other_axes_cause_a_warning(
    turn: list[list[int]], words: str, caplog: pytest.LogCaptureFixture
) -> None:
    models = tables(20)
    points = models[3].points_3d @ np.transpose(turn) + [0, 0.4, 0]
    models[3] = Example("odd one", models[3].ids, 2 * points)
    ShapeModel.learn(models, components=1)
    assert "models with other axes than the others: 1 of 20, such as 'odd one'" in caplog.text
    assert words in caplog.text


def test_models_without_a_common_keypoint_are_refused() -> None:
    models = [
        Example(f"{row}", [f"{row // 2} {label}" for label in IDS], TABLE + row)
        for row in range(40)
    ]
    with pytest.raises(InputError, match="20 groups share no keypoint, for example those of"):
        ShapeModel.learn(models)


def test_models_that_are_all_the_same_are_learned_without_a_warning() -> None:
    with warnings.catch_warnings(action="error"):
        model = ShapeModel.learn([Example(f"{row}", IDS, TABLE) for row in range(20)])
    assert np.abs(model.mean[:7] - TABLE).max() < 1e-3


def test_boxes_move_with_modes_that_stretch_and_shift_the_keypoints() -> None:
    """Boxes larger than the keypoints move by the same factors about the same point."""
    mode = TABLE * [0.1, -0.2, 0.3] + [0.5, 0.0, -0.25]
    box = np.array([TABLE.min(axis=0) - 0.3, TABLE.max(axis=0) + 0.1])
    component = ShapeModel.from_basis(TABLE, [mode], [2.0], box=box).components[0]
    moved = component.modes[0] * np.sign((component.modes[0][:-2] * mode).sum())
    assert moved[:-2] == pytest.approx(2 * mode)
    assert moved[-2:] == pytest.approx(2 * (box * [0.1, -0.2, 0.3] + [0.5, 0.0, -0.25]))


@pytest.mark.parametrize("axis", [0, 2])
def test_a_mirror_pairs_the_keypoints_that_it_exchanges(axis: int) -> None:
    """Keypoints in any order, off the origin, with noise; those on the mirror are unpaired."""
    rng = np.random.default_rng(3)
    one_side = rng.uniform(0.2, 1.0, (4, 3))
    flip = np.where(np.arange(3) == axis, -1.0, 1.0)
    middle = rng.uniform(-0.5, 0.5, (2, 3)) * (flip > 0)
    box = np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
    every = np.concatenate([one_side, one_side * flip, middle])
    order = rng.permutation(len(every))
    rows = np.concatenate([every[order], box]) + 0.7 * (flip < 0)
    models = rows + rng.normal(0, 0.01, (6, *rows.shape))
    found = find_mirror(models, axis)
    assert found.offset == pytest.approx(0.7, abs=0.02)
    mirror_image = [*range(4, 8), *range(4), 8, 9]
    assert [order[row] for row in found.partners] == [mirror_image[k] for k in order]


def test_shares_are_those_of_the_models_with_a_keypoint() -> None:
    rng = np.random.default_rng(0)
    examples = [
        Example(f"{k}", list("abcdefgh")[: 8 - k % 2], rng.normal(size=(8, 3))[: 8 - k % 2])
        for k in range(20)
    ]
    assert ShapeModel.learn(examples).shares == (1.0,) * 7 + (0.5,)


def test_from_basis_keeps_the_covariance_of_its_modes() -> None:
    rng = np.random.default_rng(0)
    modes, sigmas = rng.normal(size=(3, 7, 3)), np.array([0.3, 0.0, 0.1])
    model = ShapeModel.from_basis(TABLE, modes, sigmas, residual_sigma=0.05)
    flat = sigmas[:, None] * modes.reshape(3, -1)
    expected = flat.T @ flat + 0.05**2 * np.eye(21)
    assert model.components[0].covariance[:21, :21] == pytest.approx(expected, abs=1e-12)


def test_the_nearest_model_is_itself(learned: ShapeModel) -> None:
    assert learned.training is not None
    whole = np.flatnonzero(np.isfinite(learned.training.points_3d[..., 0]).all(axis=1)).tolist()
    for row in (whole[0], whole[-1]):
        assert learned.nearest(learned.training.points_3d[row]) == row


def test_numpy_texts_are_saved_and_other_types_refused(tmp_path: Path) -> None:
    """Other types could be written, but not read."""
    models = [Example(np.str_(f"{row}"), IDS, TABLE * (1 + row / 9)) for row in range(5)]
    path = tmp_path / "table.shape"
    ShapeModel.learn(models, category=np.str_("table"), unit=np.str_("m")).save(path)
    read = ShapeModel.open(path)
    assert (read.category, read.unit) == ("table", "m")
    assert read.training is not None
    assert read.training.model_ids[1] == "1"
    assert refusal_text(lambda: Example(3, IDS, TABLE)) == (  # type: ignore[arg-type]
        "model_id: expected a text, got int 3; give str(...) of it"
    )
    assert refusal_text(lambda: replace(read, category=3)) == (  # type: ignore[arg-type]
        "category: expected a text, got int 3; give str(...) of it"
    )
    unwritable = ShapeModel.from_basis(TABLE[:4], np.zeros((0, 4, 3)), [], ids=[10**30, 1, 2, 3])
    assert "cannot be saved" in refusal_text(lambda: unwritable.save(path))


def test_a_mesh_is_found_from_any_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert Example("m", IDS, TABLE, mesh_path="a.obj").mesh_path == tmp_path / "a.obj"  # type: ignore[arg-type]
    odd = Path(os.fsdecode(b"caf\xe9.obj"))
    text = refusal_text(lambda: Example("m", IDS, TABLE, mesh_path=odd))
    assert text.endswith("the path is not UTF-8; rename the file or its folder")


def test_a_saved_model_is_the_same(learned: ShapeModel, tmp_path: Path) -> None:
    few = FewKeypoints(typical=9.5, share=0.8)
    learned = replace(learned, inflation=1.25, degrees_of_freedom=5.0, few_keypoints=few)
    learned.save(tmp_path / "table.shape")
    opened = cadalign.ShapeModel.open(tmp_path / "table.shape")
    for name in ("category", "ids", "has_box", "up_axis", "unit", "inflation"):
        assert getattr(opened, name) == getattr(learned, name)
    assert opened.degrees_of_freedom == learned.degrees_of_freedom
    assert opened.few_keypoints == few
    assert opened.box_margins is not None
    assert learned.box_margins is not None
    assert (opened.box_margins.margins == learned.box_margins.margins).all()
    assert (opened.box_margins.tolerances == learned.box_margins.tolerances).all()
    for mine, other in zip(learned.components, opened.components, strict=True):
        assert mine.weight == other.weight
        assert mine.residual_sigma == other.residual_sigma
        assert (mine.mean == other.mean).all()
        assert (mine.modes == other.modes).all()
    assert opened.training is not None
    assert learned.training is not None
    assert opened.training.model_ids == learned.training.model_ids
    assert opened.training.points_3d.tobytes() == learned.training.points_3d.tobytes()


@pytest.mark.parametrize(
    "change",
    [{"inflation": 0.0}, {"inflation": np.nan}, {"degrees_of_freedom": 2.0}],
)
def test_numbers_out_of_range_are_refused(learned: ShapeModel, change: dict[str, float]) -> None:
    with pytest.raises(InputError, match=next(iter(change))):
        replace(learned, **change)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def content(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("shapes") / "small.shape"
    ShapeModel.learn(tables(6), category="table").save(path)
    return path.read_bytes()


def test_wrong_files_are_refused(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "a.shape"
    assert refusal_text(lambda: ShapeModel.open(path)) == f"{path}: no such file"
    path.write_bytes(b"hello")
    again = "learn it with: cadalign shape learn"
    assert refusal_text(lambda: ShapeModel.open(path)) == f"{path}: not a shape file; {again}"
    Seal(SEAL.magic, 9, SEAL.noun, SEAL.fix).write(path, content[64:])
    assert refusal_text(lambda: ShapeModel.open(path)) == (
        f"{path}: the shape file has version 9, but this cadalign reads version 1; {again}"
    )
    path.write_bytes(content[:-1])
    assert "bytes, but only" in refusal_text(lambda: ShapeModel.open(path))


@pytest.mark.parametrize(
    ("place", "value", "what"),
    [
        ("ids", [1, 2], "components[0]: 9 rows, expected 4"),
        ("weight", -1.0, "weight: -1.0 is not in (0, 1] - at `$.components[0]`"),
        ("mean", 3, "Expected `object`, got `int` - at `$.components[0].mean`"),
    ],
)
def test_damaged_parts_of_a_file_are_named(
    content: bytes, tmp_path: Path, place: str, value: Any, what: str
) -> None:
    path = tmp_path / "a.shape"
    document = msgspec.msgpack.decode(content[64:])
    (document if place == "ids" else document["components"][0])[place] = value
    SEAL.write(path, msgspec.msgpack.encode(document))
    text = refusal_text(lambda: ShapeModel.open(path))
    assert text.startswith(f"{path}: the shape file is invalid: {what}")


def test_more_components_than_models_are_refused() -> None:
    assert refusal_text(lambda: ShapeModel.learn(tables(5), components=8)) == (
        "components: 8 are more than the 5 models"
    )
    model = ShapeModel.learn(tables(5), components=3)
    assert sum(each.weight for each in model.components) == pytest.approx(1)


def test_refusals(learned: ShapeModel) -> None:
    def learn(*models: Example) -> str:
        return refusal_text(lambda: ShapeModel.learn(models))

    some = tables(4)
    named = Example("named", ["a", "b"], TABLE[:2])
    assert learn(*some[:3]) == (
        "models of object: 3 are too few to learn a shape from; give at least 4"
    )
    assert learn(*some, named) == (
        "model named: keypoint ids are names, but numbers in model table 0; "
        "use one kind in all models"
    )
    assert learn(*some, some[0]) == "model 'table 0': occurs twice"
    assert refusal_text(lambda: Example("m", [1, 1], TABLE[:2])) == "model m, ids: 1 occurs twice"
    assert refusal_text(lambda: Example("m", [1, "a"], TABLE[:2])) == (
        "model m, ids: some are numbers and some are names; use one kind"
    )
    assert "NaN or infinite" in refusal_text(lambda: Example("m", [1], np.full((1, 3), np.nan)))
    assert refusal_text(lambda: learned.rows([1, 99, 98])) == (
        "ids: table has no keypoint 99, 98; "
        "leave out what it lacks, or give one of [0, 1, 2, 3, 4, 5, 6]"
    )
    assert refusal_text(lambda: ShapeModel.learn(some, components=0)) == (
        "components: 0 is not a whole number >= 1"
    )
    elsewhere = np.array([[-100.0, 0, -200], [-90, 10, -190]])
    assert refusal_text(lambda: Example("m", IDS, TABLE, bounds=elsewhere)) == (
        "model m, bounds: no keypoint lies in the box from [-100.0, 0.0, -200.0] to "
        "[-90.0, 10.0, -190.0]; give the box in the keypoints' axes and unit"
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"deviations": [-1.0]}, "deviations: -1 is negative"),
        ({"deviations": [np.nan]}, "deviations: NaN or infinite values in row 0"),
        ({"modes": np.zeros((1, 6, 3))}, "modes: shape (1, 6, 3), expected (n, 7, 3)"),
        ({"ids": ["a"]}, "ids: 1 for 7 keypoints"),
        ({"ids": ["a"] * 7}, "ids: 'a' occurs twice"),
        ({"box": [[1, 0, 0], [0, 1, 1]]}, "box: the least corner [1.0, 0.0, 0.0] exceeds"),
        ({"up_axis": "w"}, "up_axis: 'w' is not an axis; give x, y or z"),
        ({"residual_sigma": -1}, "residual_sigma: -1 is not a standard deviation"),
    ],
)
def test_a_wrong_basis_is_refused(change: dict[str, object], message: str) -> None:
    given: dict[str, object] = {"modes": np.ones((1, 7, 3)), "deviations": [1.0]}
    text = refusal_text(lambda: ShapeModel.from_basis(TABLE, **(given | change)))  # type: ignore[arg-type]
    assert text.startswith(message)


def test_inconsistent_components_are_refused() -> None:
    component = ShapeComponent(1.0, np.vstack([TABLE, TABLE[:2]]), np.zeros((0, 9, 3)), 0.1)
    half = replace(component, weight=0.5)
    with pytest.raises(InputError, match=r"weights sum to 0\.5, not to 1"):
        ShapeModel("table", tuple(IDS), (half,))
    with pytest.raises(InputError, match="9 rows, expected 5"):
        ShapeModel("table", (1, 2, 3), (component,))


@pytest.mark.long
@pytest.mark.parametrize("category", ["chair", "mug"])
def test_held_out_real_models_are_likely(real_data: Path, category: str) -> None:
    """Keypoints predicted from the others have errors far below the category's deviations."""
    dataset = KeypointNet(real_data / "keypointnet")
    model = ShapeModel.from_dataset(dataset, category, split="train", components=1)
    component = model.components[0]
    mean, covariance = component.mean.ravel(), component.covariance
    errors, spreads, whitened = [], [], []
    for each in dataset.subset(categories=[category], split="val")[category]:
        known = [row for row, label in enumerate(each.keypoints.ids) if label in model.ids]
        rows = model.rows(each.keypoints.ids[known])
        left, others = rows[0], rows[1:]
        a, b = (3 * np.atleast_1d(part)[:, None] + np.arange(3) for part in (left, others))
        a, b = a.ravel(), b.ravel()
        gain = np.linalg.solve(covariance[np.ix_(b, b)], covariance[np.ix_(b, a)])
        expected = mean[a] + (each.keypoints.xyz[known[1:]].ravel() - mean[b]) @ gain
        errors.append(each.keypoints.xyz[known[0]] - expected)
        spreads.append(each.keypoints.xyz[known[0]] - mean[a])
        rest = covariance[np.ix_(a, a)] - covariance[np.ix_(a, b)] @ gain
        whitened.append(errors[-1] / np.sqrt(np.diag(rest)))
    assert np.median(np.abs(errors)) < 0.6 * np.median(np.abs(spreads))
    assert 0.6 < (np.abs(whitened) < 1).mean() < 0.95
    assert (np.abs(whitened) < 2).mean() > 0.88


def test_a_mirror_is_learned_only_for_a_symmetric_category() -> None:
    """Front and back of chairs differ, so a mirror that exchanges them is not learned."""
    rows = np.array([each.points_3d for each in tables(20)])
    box = np.stack([rows.min(axis=1), rows.max(axis=1)], axis=1)
    completed = np.concatenate([rows, box], axis=1)
    assert is_symmetry(completed, find_mirror(completed, 0))
    leaning = completed + np.where(np.arange(3) == 2, 0.6, 0.0) * completed[..., 1:2]
    assert is_symmetry(leaning, find_mirror(leaning, 0))
    assert not is_symmetry(leaning, find_mirror(leaning, 2))


LETTERS = "abcdefg"
NAMED = ShapeModel.from_basis(TABLE, [TABLE], [0.1], ids=list(LETTERS), category="table")
NAMES = ("front left", "front right", "back left", "back right", "rear", "side", "top")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"names": range(7)}, "names[0]: expected a text, got int 0"),
        ({"names": NAMES[:3]}, "names: 3 for 7 keypoints"),
        ({"names": [*"bacdefg"]}, "names: 'b' is also another keypoint; give each keypoint its ow"),
        ({"names": [*NAMES[:6], "Front_Left"]}, "names: 'Front_Left' is also another keypoint; gi"),
        ({"lines": [(0, 1), (2,)]}, "lines[1]: (2,) is not a pair of rows below 7"),
        ({"lines": [(0, 1, 2)]}, "lines[0]: (0, 1, 2) is not a pair of rows below 7"),
        ({"lines": [(0, 1.5)]}, "lines[0]: (0, 1.5) is not a pair of rows below 7"),
        ({"lines": [(-1, 0)]}, "lines[0]: (-1, 0) is not a pair of rows below 7"),
    ],
)
def test_names_and_lines_that_no_file_could_hold_are_refused(
    change: dict[str, Any], message: str
) -> None:
    assert refusal_text(lambda: replace(NAMED, **change)).startswith(message)


def test_names_and_lines_of_other_kinds_are_kept_as_tuples(tmp_path: Path) -> None:
    shape = replace(NAMED, names=np.array(NAMES), lines=np.array([[0, 1], [2.0, 3]]))
    shape.save(tmp_path / "a.shape")
    for each in (shape, ShapeModel.open(tmp_path / "a.shape")):
        assert (each.names, each.lines) == (NAMES, ((0, 1), (2, 3)))
    assert replace(NAMED, names=[*LETTERS]).rows(["b", "A"]).tolist() == [1, 0]


NUMBERED = replace(NAMED, ids=tuple(range(7)), names=NAMES)


@pytest.mark.parametrize(
    ("ids", "names", "found"),
    [
        ([3, 0], None, (3, 0)),
        (["rear", np.int64(2), "Front_Right"], None, (4, 2, 1)),
        (None, ["top", "leg"], (6, None)),
        ([3, 9], ["leg", "arm"], (3, None)),  # none of the names is the shape's
        ([3, 2], ["front right", "side"], (1, 5)),  # numbers of the user's own
        ([3, 2], ["Front right", "leg"], (1, None)),
    ],
)
def test_names_count_before_ids_if_the_shape_has_one(
    ids: Any, names: Any, found: tuple[int | None, ...]
) -> None:
    assert NUMBERED.resolve(ids, names, where=None) == found
    if None not in found:
        assert NUMBERED.resolve(ids, names) == found


def test_unknown_names_are_listed_with_the_known_ones() -> None:
    text = refusal_text(lambda: NUMBERED.resolve([3, 2], ["rear", "leg"], where="keypoints"))
    assert text.startswith(
        "keypoints: table has no keypoint 'leg'; leave out what it lacks, or give one of ['front l"
    )
    assert refusal_text(NUMBERED.resolve) == "ids: the keypoints have no semantic_id and no name"
