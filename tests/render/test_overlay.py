"""Overlays: places and colours of everything drawn, on several backgrounds."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from cadalign import Box, Camera, Mesh, ShapeModel, fit
from cadalign.errors import InputError
from cadalign.render import Geometry, Scene, cast_geometry, draw_overlay, look_at, overlay_model
from cadalign.render.canvas import linear_from_bytes
from cadalign.render.layers import (
    OBSERVED_COLOR,
    OUTLIER_COLOR,
    REGION_SHARE,
    REPROJECTED_COLOR,
    UNSEEN_COLOR,
    confidence_regions,
)
from cadalign.render.overlay import AXIS_COLORS, EST_COLOR, GT_COLOR, draw_result

CAMERA = Camera.from_fov(640, 480, fov_x=50)
LARGE = Camera.from_fov(1600, 1200, fov_x=50)
BENT = Camera(640, 480, 600.0, 600.0, 319.5, 239.5, (-0.25, 0.05, 0, 0))
LENS = Camera(64, 48, 60.0, 70.0, 31.5, 23.5, (-0.2, 0.05, 0.01, 0.002))
BACKGROUNDS = {"black": 0, "grey": 120, "white": 255}


def chair():
    """A seat, a back and a leg."""
    parts = [
        trimesh.creation.box((1, 0.2, 1)),
        trimesh.creation.box((1, 0.8, 0.1)).apply_translation((0, 0.5, -0.45)),
        trimesh.creation.cylinder(0.1, 0.8).apply_translation((0.1, -0.1, -0.3)),
    ]
    whole = trimesh.util.concatenate(parts)
    return Mesh(np.asarray(whole.vertices), np.asarray(whole.faces))


CHAIR = chair()
POSE = look_at(azimuth=35, elevation=30, distance=5, scale=(1, 1.8, 0.6))


def _box(azimuth=30, elevation=25, distance=4.0, size=1.0):
    pose = look_at(azimuth=azimuth, elevation=elevation, distance=distance)
    return Box.from_model(np.array([[-1, -1, -1], [1, 1, 1]]) * size / 2, pose)


def _blank(camera=CAMERA, value=0):
    return np.full((camera.height, camera.width, 3), value, dtype=np.uint8)


def _near_color(image, color, tolerance=40):
    return (np.abs(image.astype(int) - color) <= tolerance).all(axis=2)


def _has_color_near(image, pixel, color, *, within=2):
    column, row = np.rint(pixel).astype(int)
    part = image[max(row - within, 0) : row + within + 1, max(column - within, 0) :][
        :, : 2 * within + 1
    ]
    return bool(_near_color(part, color).any())


@pytest.mark.slow
@pytest.mark.parametrize("camera", [CAMERA, LARGE, BENT])
@pytest.mark.parametrize("background", BACKGROUNDS.values(), ids=BACKGROUNDS)
def test_boxes_are_drawn_along_their_near_edges(camera, background):
    box = _box()
    for name, color in (("gt_box", GT_COLOR), ("est_box", EST_COLOR)):
        image = draw_overlay(
            _blank(camera, background), camera, **{name: box}, axes=False, legend=False
        )
        # From this side, the edges at the nearest corner are visible.
        nearest = int(box.corners[:, 2].argmin())
        for bit in (1, 2, 4):
            ends = box.corners[[nearest, nearest ^ bit]]
            for share in (0.2, 0.4, 0.6, 0.8):
                pixel = camera.project(ends[:1] * (1 - share) + ends[1:] * share)[0]
                assert _has_color_near(image, pixel, color)


def test_hidden_edges_are_fainter_than_near_ones():
    box = _box()
    image = draw_overlay(_blank(), CAMERA, gt_box=box, axes=False, legend=False)
    farthest = int(box.corners[:, 2].argmax())
    share = np.linspace(0.1, 0.9, 60)[:, None]
    brightness = {}
    for name, corner in (("far", farthest), ("near", int(box.corners[:, 2].argmin()))):
        ends = box.corners[[corner, corner ^ 2]]
        columns, rows = (
            np.rint(CAMERA.project(ends[0] * (1 - share) + ends[1] * share)).astype(int).T
        )
        brightness[name] = image[rows, columns, 1].mean()
    assert 10 < brightness["far"] < 0.6 * brightness["near"]


def test_nearer_box_is_drawn_over_the_farther_one():
    near = Box([0, 0, 3.0], np.eye(3), [1, 1, 0])
    far = Box([0, 0, 6.0], np.eye(3), [0.5, 4, 0])
    # Where the far box's upright edge crosses the near box's upper one.
    crossing = CAMERA.project([[0.125, 0.5, 3.0]])[0]
    for color, boxes in (
        (GT_COLOR, {"gt_box": near, "est_box": far}),
        (EST_COLOR, {"est_box": near, "gt_box": far}),
    ):
        image = draw_overlay(_blank(), CAMERA, **boxes, axes=False, legend=False)
        assert _has_color_near(image, crossing, color, within=0)


def test_axes_reach_the_faces_of_the_stretched_box():
    pose = look_at(azimuth=35, elevation=30, distance=5, scale=(1, 1.8, 0.6))
    box = Box.from_model([[-0.5, -0.5, -0.5], [0.5, 0.5, 0.5]], pose)
    image = draw_overlay(_blank(), CAMERA, est_box=box, legend=False)
    for k in range(3):
        tip = box.center + box.rotation[:, k] * box.extents[k] / 2
        middle, end = CAMERA.project(np.array([box.center, tip]))
        along = (end - middle) / np.linalg.norm(end - middle)
        for pixel in ((middle + end) / 2, end - 2 * along):
            assert _has_color_near(image, pixel, AXIS_COLORS[k], within=1)
        # The letter starts 5 px beyond.
        assert not _has_color_near(image, end + 3 * along, AXIS_COLORS[k], within=0)
    without = draw_overlay(_blank(), CAMERA, est_box=box, legend=False, axes=False)
    assert not any(_near_color(without, color, 20).any() for color in AXIS_COLORS)


@pytest.mark.parametrize("background", BACKGROUNDS.values(), ids=BACKGROUNDS)
def test_keypoints_and_residuals_are_drawn(background):
    observed = np.array([[100.3, 200.7], [320.0, 100.5], [500.25, 333.75]])
    reprojected = observed + np.array([60.0, 0.0])
    image = draw_overlay(
        _blank(value=background), CAMERA, observed=observed, reprojected=reprojected, legend=False
    )
    for point, other in zip(observed, reprojected, strict=True):
        assert _has_color_near(image, other, REPROJECTED_COLOR)
        assert _has_color_near(image, (point + other) / 2, REPROJECTED_COLOR)
        assert _has_color_near(image, point + np.array([0, 5.0]), OBSERVED_COLOR)


def test_outliers_have_grey_rings():
    seen = np.array([[100.0, 100.0], [300.0, 200.0]])
    image = draw_overlay(_blank(), CAMERA, observed=seen, outliers=seen[1:], legend=False)
    kept, left_out = seen + np.array([0, 5.0])
    assert _has_color_near(image, kept, OBSERVED_COLOR)
    assert _has_color_near(image, left_out, OUTLIER_COLOR)
    assert not _has_color_near(image, left_out, OBSERVED_COLOR)


def test_reprojections_behind_the_camera_are_left_out():
    observed = np.array([[100.0, 100.0], [300.0, 200.0]])
    for missing in (np.inf, np.nan):
        reprojected = np.array([[missing, missing], [330.0, 200.0]])
        image = draw_overlay(_blank(), CAMERA, observed=observed, reprojected=reprojected)
        alone = draw_overlay(_blank(), CAMERA, observed=observed[1:], reprojected=reprojected[1:])
        changed = (image != alone).any(axis=2)
        assert changed[90:111, 90:111].any()  # the other ring
        changed[90:111, 90:111] = False
        assert not changed.any()


def test_white_rings_show_on_white_by_their_casing():
    image = draw_overlay(_blank(value=255), CAMERA, observed=[[100.0, 100.0]], legend=False)
    assert image[90:111, 90:111].min() < 60


def test_a_marker_is_drawn_about_its_point():
    point = np.array([[200.37, 150.81]])
    image = draw_overlay(_blank(), CAMERA, observed=point, legend=False).astype(float)
    # The casing is nearly as dark as the background, so brightness is the weight.
    weight = image.sum(axis=2)
    rows, columns = np.indices(weight.shape)
    center = np.array([(columns * weight).sum(), (rows * weight).sum()]) / weight.sum()
    np.testing.assert_allclose(center, point[0], atol=0.1)


def test_background_is_unchanged():
    photo = np.random.default_rng(0).integers(0, 256, (480, 640, 3), dtype=np.uint8)
    kept = photo.copy()
    image = draw_overlay(photo, CAMERA, gt_box=_box(), legend=False)
    np.testing.assert_array_equal(photo, kept)
    assert image.shape == (480, 640, 3)
    assert image.dtype == np.uint8
    # A few pixels about the box, none elsewhere.
    changed = (image != photo).any(axis=2)
    assert changed.mean() < 0.05
    assert not changed[:40].any()
    np.testing.assert_array_equal(draw_overlay(photo, CAMERA), photo)


def test_legend_names_what_is_drawn():
    heights = []
    for options in (
        {"gt_box": _box()},
        {"gt_box": _box(), "est_box": _box(), "observed": [[9, 9]]},
    ):
        plain = draw_overlay(_blank(), CAMERA, **options, legend=False)
        legend = (plain != draw_overlay(_blank(), CAMERA, **options)).any(axis=2)
        heights.append(np.ptp(np.nonzero(legend)[0]))
    assert heights[1] > heights[0] + 20


@pytest.mark.parametrize("camera", [CAMERA, BENT])
def test_edges_behind_the_camera_are_cut_off(camera):
    # The camera is inside the first box; the second box is entirely behind it.
    inside = Box([0.1, 0, 0.5], np.eye(3), [2, 2, 6])
    image = draw_overlay(_blank(camera), camera, gt_box=inside, legend=False)
    assert _near_color(image, GT_COLOR).any()
    behind = Box([0, 0, -5], np.eye(3), [1, 1, 1])
    image = draw_overlay(_blank(camera), camera, gt_box=behind, legend=False)
    assert not image.any()


def test_boxes_without_thickness_or_size_are_drawn():
    for extents in ([1, 1, 0], [1, 0, 0], [0, 0, 0]):
        draw_overlay(_blank(), CAMERA, gt_box=Box([0, 0, 4], np.eye(3), extents))


def test_points_far_outside_the_image_are_harmless():
    points = [[1e12, -1e12], [100.0, 100.0]]
    image = draw_overlay(_blank(), CAMERA, observed=points, reprojected=points[::-1])
    assert image.any()


def test_tiny_images_are_drawn_on_without_a_legend():
    camera = Camera.from_fov(24, 18, fov_x=50)
    image = draw_overlay(_blank(camera), camera, gt_box=_box(), est_box=_box())
    assert image.shape == (18, 24, 3)


def test_grey_and_rgba_images_are_accepted():
    grey = np.full((480, 640), 77, dtype=np.uint8)
    np.testing.assert_array_equal(draw_overlay(grey, CAMERA), _blank(value=77))
    np.testing.assert_array_equal(draw_overlay(grey[:, :, None], CAMERA), _blank(value=77))
    rgba = np.zeros((480, 640, 4), dtype=np.uint8)
    rgba[:, :320] = (10, 20, 30, 255)
    image = draw_overlay(rgba, CAMERA)
    assert image[0, 0].tolist() == [10, 20, 30]
    assert image[0, 639].min() > 200
    mirrored = np.arange(480 * 640 * 3, dtype=np.uint8).reshape(480, 640, 3)[:, ::-1, ::-1]
    np.testing.assert_array_equal(draw_overlay(mirrored, CAMERA), mirrored)


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((480, 640, 3)), "float64, not uint8"),
        (np.zeros((480, 640, 2), np.uint8), "not a grey, RGB or RGBA image"),
        (np.zeros((480,), np.uint8), "not a grey, RGB or RGBA image"),
        (np.zeros((640, 480, 3), np.uint8), "480 x 640 px, the camera's image 640 x 480"),
        ("photo.png", "not uint8"),
    ],
)
def test_other_images_are_refused(image, message):
    with pytest.raises(InputError, match=message):
        draw_overlay(image, CAMERA)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"observed": [[1, 1], [2, 2]], "reprojected": [[1, 1]]},
            "reprojected: 1 keypoints, but 2 observed",
        ),
        ({"observed": [[1, np.nan]]}, "observed"),
        ({"unseen": [[1.0, 2.0, 3.0]]}, r"unseen: shape \(1, 3\), expected \(n, 2\)"),
        ({"regions": [[1.0, 2.0]]}, r"regions: shape \(1, 2\), expected \(n, n, 2\)"),
    ],
)
def test_keypoints_that_do_not_match_are_refused(arguments, message):
    with pytest.raises(InputError, match=message):
        draw_overlay(_blank(), CAMERA, **arguments)


def test_the_predicted_model_lies_over_the_photo_as_a_red_veil():
    frame, photo = cast_geometry(Scene(CHAIR), CAMERA, POSE), _blank(value=120)
    drawn = draw_overlay(photo, CAMERA, est_frame=frame, legend=False)
    inner = cv2.erode(frame.mask.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    tint = drawn[inner].astype(int)
    assert np.median(tint[:, 0] - tint[:, 1]) > 10
    assert (tint[:, 0] > tint[:, 1]).all()
    outside = cv2.dilate(frame.mask.astype(np.uint8), np.ones((7, 7), np.uint8)) == 0
    np.testing.assert_array_equal(drawn[outside], photo[outside])


def test_frames_of_another_size_are_refused():
    frame = cast_geometry(Scene(CHAIR), CAMERA, POSE)
    small = Geometry(frame.depth[1:], frame.face_id[1:], frame.normal[1:])
    with pytest.raises(InputError, match="est_frame: it is 640 x 479 px, the image 640 x 480"):
        draw_overlay(_blank(), CAMERA, est_frame=small)


# The shaded model ---------------------------------------------------------------------------------


def cover_of(camera, mesh, pose):
    """Share of each pixel that the shaded model covers, from drawings on white and on black."""
    black, white = (
        linear_from_bytes(overlay_model(_blank(camera, value), camera, mesh, pose))
        for value in (0, 255)
    )
    return 1 - (white - black).mean(axis=2)


@pytest.mark.parametrize("camera", [CAMERA, BENT])
def test_the_shaded_silhouette_is_that_of_ray_casting(camera):
    mask = cast_geometry(Scene(CHAIR), camera, POSE).mask
    covered = cover_of(camera, CHAIR, POSE) > 0.3
    assert (covered & mask).sum() >= 0.99 * mask.sum()


def test_the_model_covers_its_share_and_box_and_axes_are_drawn():
    mask = cast_geometry(Scene(CHAIR), CAMERA, POSE).mask
    assert np.median(cover_of(CAMERA, CHAIR, POSE)[mask]) == pytest.approx(0.6, abs=0.01)
    picture = overlay_model(_blank(), CAMERA, CHAIR, POSE)
    for color in (EST_COLOR, *AXIS_COLORS):
        assert _near_color(picture, color, 60).any()


# Uncertain keypoints ------------------------------------------------------------------------------


@given(st.integers(0, 10_000))
def test_regions_contain_their_share(seed):
    rng = np.random.default_rng(seed)
    center, root = rng.normal(0, 100, 2), 10 * rng.normal(size=(2, 2))
    covariance = root @ root.T + 9 * np.eye(2)
    (region,) = confidence_regions(center[None], covariance[None])
    offsets = region - center
    squares = np.einsum("ni,ij,nj->n", offsets, np.linalg.inv(covariance), offsets)
    np.testing.assert_allclose(1 - np.exp(-squares / 2), REGION_SHARE)  # chi-square, 2 degrees
    # Regions that the markers would hide are omitted.
    assert len(confidence_regions(np.zeros((2, 2)), np.array([0.1 * np.eye(2), np.eye(2)]))) == 1


@pytest.mark.parametrize("camera", [Camera(64, 48, 60.0, 70.0, 31.5, 23.5), LENS])
@given(seed=st.integers(0, 10_000))
def test_projected_covariances_are_propagated(camera, seed):
    rng = np.random.default_rng(seed)
    point, covariance = rng.uniform([-1, -1, 4], [1, 1, 8]), np.diag(rng.uniform(0.1, 2, 3))
    steps = 1e-6 * np.eye(3)
    slopes = (camera.project(point + steps) - camera.project(point - steps)).T / 2e-6
    (found,) = camera.projected_covariances(point[None], covariance[None])
    np.testing.assert_allclose(found, slopes @ covariance @ slopes.T, rtol=1e-4, atol=1e-4)


def test_unobserved_keypoints_and_regions_are_drawn():
    regions = confidence_regions(np.array([[400.0, 200.0]]), 400 * np.eye(2)[None])
    drawn = draw_overlay(_blank(), CAMERA, unseen=[[100.0, 300.0]], regions=regions, legend=False)
    near = (np.abs(drawn.astype(int) - UNSEEN_COLOR).max(axis=2) < 60).nonzero()
    assert np.hypot(near[1] - 100, near[0] - 300).max() < 6
    on_curve = drawn[200, 400 + 48 : 400 + 51].max()
    assert on_curve > 80
    assert not drawn[200, 380:420].any()


def test_the_skeleton_of_a_learned_shape_is_drawn_unless_its_mesh_is():
    mug = ShapeModel.pretrained("mug")
    points = mug.mean[: len(mug.ids)]
    pixels = CAMERA.project(look_at(azimuth=35, elevation=30, distance=2).apply(points))
    found = replace(fit(points, pixels, CAMERA), model=mug)
    unlined = replace(found, model=replace(mug, lines=()))
    drawn, without = (draw_result(_blank(), each) for each in (found, unlined))
    for start, end in mug.lines:
        for share in (0.3, 0.5, 0.7):
            place = share * pixels[start] + (1 - share) * pixels[end]
            assert _has_color_near(drawn, place, EST_COLOR)
    lengths = [np.linalg.norm(pixels[start] - pixels[end]) for start, end in mug.lines]
    assert (without != drawn).any(axis=2).sum() > 0.5 * sum(lengths)
    meshes = [draw_result(_blank(), each, mesh=CHAIR) for each in (found, unlined)]
    np.testing.assert_array_equal(*meshes)
