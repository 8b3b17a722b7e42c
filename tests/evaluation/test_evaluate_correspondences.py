"""`cadalign evaluate correspondences`: formats, inputs, rows, summaries, real models, refusals."""

from __future__ import annotations

import csv
import math
import os
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cadalign.cli import main
from cadalign.datasets import BlindPnP, Correspondences, open_correspondences
from cadalign.errors import DataError
from cadalign.evaluation.api import run as do_run
from cadalign.evaluation.experiments.correspondences import (
    _STATISTICS,
    SPEC,
    CorrespondenceOptions,
    errors_of,
    make_problem,
    summarize_shares,
)
from cadalign.evaluation.methods import MethodInput
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.tables import Run, read_table
from cadalign.evaluation.simulation import SimulatedProblem, simulate_problem
from cadalign.evaluation.summary import Group
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera

DATA = os.environ.get("CADALIGN_DATA")
needs_data = pytest.mark.skipif(DATA is None, reason="CADALIGN_DATA is unset")

POINTS = 60
CAMERA = Camera(width=640, height=480, fx=500.0, fy=500.0, cx=319.5, cy=239.5)
ANY = Path()  # replaced by `run`
ONE = CorrespondenceOptions(ANY, outliers=(0.0,), draws=1, methods=("epnp",))
QUICK = CorrespondenceOptions(ANY, outliers=(0.0, 0.3), draws=2, methods=("epnp", "ransac-optimal"))


def seen_image(name: str, seed: int) -> Correspondences:
    """A synthetic image: points about the world's origin, 0.2 px of noise."""
    made = simulate_problem(
        np.random.default_rng(seed),
        points=POINTS,
        noise_px=0.2,
        camera=CAMERA,
        stretch=(1.0, 1.0),
    )
    return Correspondences(name, made.points_3d, made.points_2d, CAMERA, made.alignment)


def write_colmap(folder: Path, *, images: int = 2, broken: tuple[int, ...] = ()) -> Path:
    """Write a COLMAP text model; images in ``broken`` observe a point that does not exist."""
    folder.mkdir(parents=True, exist_ok=True)
    views, points = [], []
    for number in range(images):
        seen = seen_image(f"{number}.jpg", seed=number)
        first = 1 + POINTS * number
        points += [
            f"{first + i} {x!r} {y!r} {z!r} 0 0 0 0.2"
            for i, (x, y, z) in enumerate(seen.points_3d.tolist())
        ]
        pose = seen.cam_from_world
        xyzw = Rotation.from_matrix(pose.rotation).as_quat().tolist()
        numbers = [xyzw[3], *xyzw[:3], *pose.translation.tolist()]
        views.append(f"{number + 1} {' '.join(map(repr, numbers))} 1 {seen.id}")
        ids = [10_000 if number in broken and i == 5 else first + i for i in range(POINTS)]
        # COLMAP's pixels begin half a pixel earlier.
        pixels = (seen.points_2d + 0.5).tolist()
        views.append(" ".join(f"{u!r} {v!r} {i}" for (u, v), i in zip(pixels, ids, strict=True)))
    c = CAMERA
    camera = f"1 PINHOLE {c.width} {c.height} {c.fx} {c.fy} {c.cx + 0.5} {c.cy + 0.5}"
    (folder / "cameras.txt").write_text(camera + "\n")
    (folder / "images.txt").write_text("\n".join(views) + "\n")
    (folder / "points3D.txt").write_text("\n".join(points) + "\n")
    return folder


def write_pickles(folder: Path, names: tuple[str, ...]) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        (folder / f"{name}.pkl").write_bytes(pickle.dumps([np.zeros(3)]))
    return folder


def run(
    root: Path, out: Path, options: CorrespondenceOptions = QUICK, *, workers: int = 0
) -> list[dict[str, object]]:
    """Run the experiment and return its rows."""
    do_run(replace(options, path=root), RunFolder(out), workers=workers, dask=None)
    return read_table(RunFolder(out).results).to_pylist()


@pytest.fixture(scope="module")
def colmap(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_colmap(tmp_path_factory.mktemp("colmap"))


@pytest.fixture(scope="module")
def finished(colmap: Path, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    folder = RunFolder(tmp_path_factory.mktemp("runs") / "run")
    run(colmap, folder.path)
    return folder


def test_formats_are_recognised(tmp_path):
    with pytest.raises(DataError, match=r"no data set of corresp.*points3D.*matches\.pkl"):
        open_correspondences(tmp_path)
    write_pickles(tmp_path, ("matches", "R", "t"))
    assert isinstance(open_correspondences(tmp_path), BlindPnP)


class TestInputs:
    def test_only_the_given_share_is_moved_and_the_rest_is_the_image(self):
        seen = seen_image("a", 1)
        problem = make_problem(seen, 0.35, rng=np.random.default_rng(0))
        wrong = problem.outliers
        assert wrong.sum() == 21
        np.testing.assert_array_equal(problem.points_2d[~wrong], seen.points_2d[~wrong])
        assert np.linalg.norm(problem.points_2d - seen.points_2d, axis=1)[wrong].min() > 0

    def test_the_true_alignment_puts_the_stretched_points_where_they_were(self):
        seen = seen_image("a", 1)
        problem = make_problem(seen, 0.5, rng=np.random.default_rng(0))
        np.testing.assert_allclose(
            problem.alignment.apply(problem.points_3d),
            seen.cam_from_world.apply(seen.points_3d),
            atol=1e-12,
        )
        scale = problem.alignment.scale
        assert scale[0] == 1
        assert ((scale[1:] > 0.5) & (scale[1:] < 2)).all()
        assert scale[1] != scale[2]

    @pytest.mark.long
    def test_moved_points_lie_all_over_the_image_and_where_its_lens_model_holds(self):
        # The lens model is valid up to 230 px from the centre, in half of the image.
        camera = replace(CAMERA, distortion=(-0.7, 0.0, 0.0, 0.0))
        corner = camera.normalize_where_valid(np.zeros((1, 2)))[1]
        assert not corner[0]
        seen = seen_image("a", 1)
        pose = Alignment(np.eye(3), [0, 0, 12], [1, 1, 1])
        points_2d = camera.project(pose.apply(seen.points_3d))
        seen = Correspondences("a", seen.points_3d, points_2d, camera, pose)
        rng = np.random.default_rng(0)
        moved = np.concatenate(
            [p.points_2d[p.outliers] for p in (make_problem(seen, 0.9, rng=rng) for _ in range(20))]
        )
        assert camera.contains(moved, margin=0.5).all()
        assert camera.normalize_where_valid(moved)[1].all()
        radius = np.linalg.norm(moved - (camera.cx, camera.cy), axis=1)
        assert (radius < 115).mean() == pytest.approx(0.25, abs=0.05)

    @pytest.mark.slow
    def test_inputs_depend_on_seed_image_draw_and_share_alone(self, colmap, tmp_path):
        def rows(name, **changes):
            found = run(colmap, tmp_path / name, replace(QUICK, **changes))
            return {
                (row["image"], row["draw"], row["outliers"]): row
                for row in found
                if row["method"] == "ransac-optimal"
            }

        both = rows("both")
        alone = rows("alone", outliers=(0.3,), draws=1, methods=("ransac-optimal",))
        assert set(alone) == {("0.jpg", 0, 0.3), ("1.jpg", 0, 0.3)}
        assert all(both[key] == row for key, row in alone.items())
        other = rows("other", seed=1)
        for key, row in other.items():
            assert row["scale_y_error"] != both[key]["scale_y_error"]
        draws = {both["0.jpg", draw, 0.3]["scale_y_error"] for draw in (0, 1)}
        assert len(draws) == 2


class TestRows:
    def test_there_is_a_row_for_every_image_share_draw_and_method(self, finished):
        rows = read_table(finished.results).to_pylist()
        keys = [(row["image"], row["outliers"], row["draw"], row["method"]) for row in rows]
        assert keys == [
            (image, share, draw, method)
            for image in ("0.jpg", "1.jpg")
            for share in (0.0, 0.3)
            for draw in (0, 1)
            for method in ("epnp", "ransac-optimal")
        ]
        assert {row["status"] for row in rows} == {"ok"}
        timings = read_table(finished.timings).to_pylist()
        assert len(timings) == len(keys)
        assert all(row["seconds"] > 0 for row in timings)

    def test_the_robust_method_succeeds(self, finished):
        for row in read_table(finished.results).to_pylist():
            assert row["points"] == POINTS
            assert row["success"] == (row["method"] == "ransac-optimal")

    def test_errors_are_counted_as_they_are_described(self):
        # All points are at a distance of 10 from the camera.
        points = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]], dtype=float)
        problem = SimulatedProblem(
            points,
            np.zeros((4, 2)),
            CAMERA,
            Alignment(np.eye(3), [0, 0, 10], [1, 1.0, 2.0]),
            None,
        )
        truth = MethodInput.from_problem(problem, 1.0)
        angle = np.radians(0.4)
        turn = [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]

        pose = Alignment(turn, [0, 0.5, 10], [1, 1.005, 1.99])
        row = errors_of(pose, truth)
        assert row["rotation_error_deg"] == pytest.approx(0.4)
        assert row["translation_error"] == pytest.approx(0.05)
        assert (row["scale_y_error"], row["scale_z_error"]) == pytest.approx((0.005, 0.005))
        assert row["success"]
        for scale in ([1, 1.02, 2.0], [1, 1.0, 1.97]):
            assert not errors_of(Alignment(turn, [0, 0, 10], scale), truth)["success"]


class TestBrokenImages:
    @pytest.mark.long
    def test_one_becomes_failed_rows_and_the_others_go_on(self, tmp_path, capsys, no_figures):
        root = write_colmap(tmp_path / "model", images=3, broken=(1,))
        out = tmp_path / "run"
        arguments = ["evaluate", "correspondences", str(root), "--outliers", "0", "--draws", "2"]
        arguments += ["--methods", "epnp", "ransac-optimal", "--workers", "0", "--out", str(out)]
        assert main(arguments) == 3
        rows = read_table(RunFolder(out).results).to_pylist()
        failed = [row for row in rows if row["status"] == "failed"]
        assert len(rows) == 12
        assert {row["image"] for row in failed} == {"1.jpg"}
        assert len(failed) == 4
        assert all("point 10000" in row["reason"] and row["points"] is None for row in failed)
        assert "4 of 12 rows failed" in capsys.readouterr().err
        for summary in summarize_shares(Run.open(out)):
            assert (summary["instances"], summary["failed"]) == (6, 2)
            assert math.isfinite(summary["rotation_error_deg"])


class TestRuns:
    def test_other_data_are_refused(self, tmp_path):
        root = write_colmap(tmp_path / "model")
        run(root, tmp_path / "run", ONE)
        file = root / "points3D.txt"
        lines = file.read_text().split("\n")
        number, x, rest = lines[0].split(" ", 2)
        lines[0] = f"{number} {float(x) + 1e-6!r} {rest}"
        file.write_text("\n".join(lines))
        with pytest.raises(DataError, match="another configuration: correspondences is"):
            run(root, tmp_path / "run", ONE)


class TestReport:
    def test_failures_count_as_infinite(self):
        def median(*status: str) -> float:
            cells = {"scale_y_error": np.array([1.0, 2.0, 0, 0]), "status": np.array(status)}
            return _STATISTICS["scale_y_error"](Group(cells, cells))

        assert median("ok", "ok", "failed", "failed") == 2.0
        assert math.isnan(median("ok", "failed", "failed", "failed"))

    def test_summaries_agree_with_the_rows(self, finished):
        rows = read_table(finished.results).to_pylist()
        for summary in summarize_shares(Run.open(finished.path)):
            some = [
                row
                for row in rows
                if (row["outliers"], row["method"]) == (summary["outliers"], summary.method)
            ]
            assert (summary["instances"], summary["failed"]) == (4, 0)
            assert summary["success"] == np.mean([row["success"] for row in some])
            errors = sorted(row["scale_z_error"] for row in some)
            assert summary["scale_z_error"] == errors[1]
            assert summary["milliseconds"] > 0

    @pytest.mark.long
    def test_table_and_figures_are_written(self, finished, no_figures):
        SPEC.write(Run.open(finished.path))
        with finished.summary.open() as file:
            rows = list(csv.DictReader(file))
        assert [(row["outliers"], row["method"]) for row in rows] == [
            ("0.0", "epnp"),
            ("0.0", "ransac-optimal"),
            ("0.3", "epnp"),
            ("0.3", "ransac-optimal"),
        ]
        assert float(rows[1]["rotation_error_deg"]) < 0.5
        assert rows[1]["success"] == "1.0"
        metrics = (
            "rotation_error_deg",
            "translation_error",
            "scale_y_error",
            "scale_z_error",
            "success",
            "milliseconds",
        )
        for metric in metrics:
            for ending in ("png", "pdf"):
                assert (finished.figures / f"{metric}.{ending}").is_file()


class TestCommand:
    @pytest.mark.parametrize(
        ("options", "message"),
        [
            (["--outliers", "1"], "1 is not a share of outliers"),
            (["--outliers", "0", "nan"], "nan is not a share of outliers"),
            (["--methods", "ransac-optimum"], "did you mean 'ransac-optimal'?"),
            (["--methods", "limit"], "the Cramer-Rao bound needs the noise"),
            (["--draws", "0"], "--draws: 0 is less than 1"),
        ],
    )
    def test_a_bad_option_is_refused_before_anything_is_done(
        self, colmap, tmp_path, capsys, options, message
    ):
        out = tmp_path / "run"
        arguments = ["evaluate", "correspondences", str(colmap), "--out", str(out), *options]
        assert main(arguments) == 1
        assert message in capsys.readouterr().err
        assert not out.exists()
