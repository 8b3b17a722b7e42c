"""`align` with a photo as evidence: accuracy, calibration, statistics of lines."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest

from cadalign import Alignment, Camera, Mesh, Model, View, align
from cadalign.estimation.contours.contour import Sight
from cadalign.estimation.contours.outline import RigidSurface
from cadalign.estimation.contours.photo_lines import (
    add_neighbours,
    changes_of,
    crossings_of,
    silhouette_of,
)
from cadalign.estimation.result import Result
from cadalign.geometry.rotations import rotation_from_vector
from cadalign.io.images import write_image
from cadalign.metrics import rotation_error
from cadalign.render import Scene, cast_geometry

CAMERA = Camera(400, 300, 480, 480, 199.5, 149.5)
CLICK_PX = 3.0


class PhotoScene(NamedTuple):
    mesh: Mesh
    truth: Alignment
    pixels: np.ndarray
    clicks: np.ndarray
    mask: np.ndarray

    def model(self, **options: Any) -> Model:
        return Model(points_3d=self.mesh.vertices, mesh=self.mesh, **options)

    def aligned(self, model: Model | None = None, **options: Any) -> Result:
        view = View(CAMERA, self.clicks, sigma=CLICK_PX, **options)
        return align(self.model(stretch="none") if model is None else model, view)

    def error(self, result: Result) -> float:
        return self.turned(result.alignment)

    def turned(self, est: Alignment) -> float:
        return rotation_error(est=est, gt=self.truth)


def wedge() -> Mesh:
    """A body without symmetry."""
    low = [[-0.5, -0.3, -0.2], [0.5, -0.3, -0.2], [0.5, -0.3, 0.3], [-0.5, -0.3, 0.3]]
    high = [[-0.5, 0.35, -0.2], [0.1, 0.2, -0.1], [0.15, 0.1, 0.3], [-0.45, 0.5, 0.2]]
    faces = [[0, 1, 2], [0, 2, 3], [4, 6, 5], [4, 7, 6]]
    for k in range(4):
        after = (k + 1) % 4
        faces += [[k, 4 + after, after], [k, 4 + k, 4 + after]]
    return Mesh(np.array(low + high), np.array(faces))


@cache
def scene(seed: int, scale: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> PhotoScene:
    """A body from anywhere in front."""
    rng = np.random.default_rng(seed)
    return drawn(rng, rotation_from_vector(rng.normal(0, 0.7, 3)), [0.1, -0.05, 3.0], scale)


def drawn(
    rng: np.random.Generator,
    turn: np.ndarray,
    place: list[float],
    scale: tuple[float, float, float],
) -> PhotoScene:
    """A red body on a patterned background, blurred and noisy, with inaccurate keypoints."""
    mesh, shape = wedge(), (CAMERA.height, CAMERA.width)
    truth = Alignment(turn, place, np.array(scale))
    mask = cast_geometry(Scene(mesh), CAMERA, truth).mask
    inside = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), 0.8)[:, :, None]
    pattern = cv2.GaussianBlur(rng.uniform(0, 255, (*shape, 3)), (0, 0), 6)
    pattern = 128 + 6 * (pattern - pattern.mean())
    pattern[:, :, 0] *= 0.6
    mixed = inside * [190, 60, 50] + (1 - inside) * pattern + rng.normal(0, 6, (*shape, 3))
    pixels = np.clip(mixed, 0, 255).astype(np.uint8)
    clicks = CAMERA.project(truth.apply(mesh.vertices))
    noisy = clicks + rng.normal(0, CLICK_PX, clicks.shape)
    return PhotoScene(mesh, truth, pixels, noisy, mask)


class TestPhoto:
    @pytest.mark.parametrize("seed", [12, 16])
    def test_settles_a_pose_that_four_rough_clicks_leave_open(self, seed: int) -> None:
        shown, rng = scene(seed), np.random.default_rng(seed)
        rows = np.sort(rng.permutation(8)[:4]).tolist()
        clicks = shown.clicks[rows] + rng.normal(0, 22, (4, 2))
        view = View(CAMERA, clicks, ids=rows, sigma=22.0, image=shown.pixels)
        assert shown.error(align(shown.model(stretch="none"), view)) < 1.0

    def test_stretch_is_estimated(self) -> None:
        shown = scene(2, (1.0, 1.2, 0.85))
        joint = shown.aligned(shown.model(), image=shown.pixels)
        assert np.abs(joint.alignment.scale / shown.truth.scale - 1).max() < 0.03
        assert shown.error(joint) < shown.error(shown.aligned(shown.model()))

    def test_summary_tells_the_share_of_the_outline(self) -> None:
        shown = scene(0)
        joint = shown.aligned(image=shown.pixels)
        assert not any(each.kind == "photo" for each in joint.warnings)
        (summary,) = [each for each in joint.evidence if each.kind == "photo"]
        assert summary.name == "views[0].image"
        assert summary.share > 0.9
        assert summary.rms < 1.0
        names = [each.name for each in joint.evidence]
        assert names == ["views[0].points_2d", "views[0].image"]
        again = Result.from_dict(joint.to_dict())
        assert again.evidence == joint.evidence

    def test_is_read_from_a_file(self, tmp_path: Path) -> None:
        shown = scene(1)
        write_image(tmp_path / "photo.png", shown.pixels)
        joint = shown.aligned(image=tmp_path / "photo.png")
        expected = shown.aligned(image=shown.pixels)
        assert joint.alignment.rotation == pytest.approx(expected.alignment.rotation)

    def test_from_a_start_without_keypoints(self) -> None:
        shown = scene(0)
        turn = rotation_from_vector(np.radians([3.0, -3.0, 3.0]))
        start = Alignment(turn @ shown.truth.rotation, shown.truth.translation, np.ones(3))
        found = align(shown.model(stretch="none"), View(CAMERA, image=shown.pixels), init=start)
        assert shown.error(found) < 0.6

    def test_with_gravity_and_an_unknown_focal_length(self) -> None:
        shown = scene(3)
        camera = Camera.from_size(CAMERA.width, CAMERA.height)
        up = shown.truth.rotation[:, 1]
        view = View(camera, shown.clicks, sigma=CLICK_PX, image=shown.pixels, up=up)
        found = align(shown.model(stretch="none"), view, focal="estimate")
        assert shown.error(found) < 3.0

    def test_of_two_views_counts_in_both(self) -> None:
        pair = scene(0), scene(1)
        views = [View(CAMERA, each.clicks, sigma=CLICK_PX, image=each.pixels) for each in pair]
        found = align(pair[0].model(stretch="none"), views)
        assert [each.view for each in found.evidence if each.kind == "photo"] == [0, 1]
        assert max(map(PhotoScene.turned, pair, found.poses)) < 0.6

    def test_counts_beside_the_mask_of_another_view(self) -> None:
        shown = scene(1)
        clicked = View(CAMERA, shown.clicks, sigma=CLICK_PX)
        views = [replace(clicked, mask=shown.mask), replace(clicked, image=shown.pixels)]
        found = align(shown.model(), views)
        assert {"mask", "photo"} <= {each.kind for each in found.evidence}
        assert shown.error(found) < 0.6

    def test_of_a_similar_model(self) -> None:
        shown = scene(2)
        wide = Mesh(shown.mesh.vertices * [1.0, 1.06, 0.95], shown.mesh.faces)
        model = Model(points_3d=wide.vertices, mesh=wide, shape_sigma=0.04)
        joint = shown.aligned(model, image=shown.pixels)
        assert shown.error(joint) < shown.error(shown.aligned(model)) + 1.0


class TestHonesty:
    def test_a_photo_of_something_else_is_left_out(self) -> None:
        shown = scene(0)
        rng = np.random.default_rng(5)
        noise = rng.uniform(0, 255, shown.pixels.shape).astype(np.uint8)
        alone, joint = shown.aligned(), shown.aligned(image=noise)
        assert joint.alignment.rotation == pytest.approx(alone.alignment.rotation, abs=1e-3)
        assert any("has the colours of what is around it" in str(each) for each in joint.warnings)
        (warning,) = [text for text in map(str, joint.warnings) if "views[0].image" in text]
        assert "left out" in warning
        (summary,) = [each for each in joint.evidence if each.kind == "photo"]
        assert (summary.share, summary.count) == (0.0, 0)

    def test_a_uniform_photo_is_left_out(self) -> None:
        shown = scene(0)
        joint = shown.aligned(image=np.full_like(shown.pixels, 90))
        assert any("left out" in text for text in map(str, joint.warnings))

    def test_a_mask_takes_the_place_of_the_photo(self) -> None:
        shown = scene(1)
        mask = cast_geometry(Scene(shown.mesh), CAMERA, shown.truth).mask
        found = shown.aligned(image=shown.pixels, mask=mask)
        expected = shown.aligned(mask=mask)
        assert [each.kind for each in found.evidence] == [each.kind for each in expected.evidence]


class TestSilhouette:
    """Cells of a predicted silhouette."""

    def test_its_cells_are_those_that_rays_meet(self) -> None:
        mesh, truth = wedge(), scene(1).truth
        sight = Sight(RigidSurface(mesh).caster, CAMERA, truth)
        found = silhouette_of(sight, 150)
        rows, columns = np.indices(found.inside.shape)
        pixels = found.corner + found.cell * np.stack([columns, rows], axis=-1)
        met = sight.covers(pixels)
        assert 0.2 < met.mean() < 0.9
        # The wedge is nowhere thinner than two cells.
        assert (found.inside == met).all()

    def test_a_lens_bends_rays_as_it_bends_pixels(self) -> None:
        mesh, truth = wedge(), scene(0).truth
        surface, bent = RigidSurface(mesh), replace(CAMERA, distortion=(-0.2, 0.05, 0.0, 0.0))
        rows, columns = np.indices((CAMERA.height, CAMERA.width)).reshape(2, -1)
        pixels = np.column_stack([columns, rows]).astype(float)
        straight = CAMERA.project(np.column_stack([bent.normalize(pixels), np.ones(len(pixels))]))
        covered = Sight(surface.caster, bent, truth).covers(pixels)
        assert covered.any()
        assert (covered == Sight(surface.caster, CAMERA, truth).covers(straight)).all()


class TestLines:
    def test_several_crossings_count_less(self) -> None:
        stripes = np.where(np.arange(21)[None] // 4 % 2 == 0, 0.9, -0.9)
        single = np.where(np.arange(21)[None] < 10, 0.9, -0.9)
        valid = np.ones((1, 21), dtype=bool)
        _, several = crossings_of(changes_of(stripes, valid))
        _, once = crossings_of(changes_of(single, valid))
        assert several[0] > 4 * once[0]

    def test_neighbours_choose_between_crossings(self) -> None:
        single = np.where(np.arange(21) < 12, 0.9, -0.9)
        several = np.where((np.arange(21) >= 15) & (np.arange(21) < 18), 0.9, single)
        logs = changes_of(np.stack([single, several, single]), np.ones((3, 21), dtype=bool))
        alone, _ = crossings_of(logs)
        beside, _ = crossings_of(add_neighbours(logs, np.array([True, True])))
        others, _ = crossings_of(add_neighbours(logs, np.array([False, False])))
        assert abs(beside[1] - beside[0]) < 0.3 * abs(alone[1] - alone[0])
        assert others == pytest.approx(alone, abs=0.1)
