"""BOP's VSD, MSSD and MSPD on truth, on synthetic errors, and against the literal definitions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import cadalign.datasets
from cadalign.errors import InputError
from cadalign.evaluation.metrics.bop import (
    TAUS,
    mspd,
    mspd_recall,
    mssd,
    mssd_recall,
    vsd,
    vsd_of_depths,
    vsd_recall,
)
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.symmetry import Symmetry, SymmetryAxis
from cadalign.render.scene import Scene

SQUARE = np.array([[50.0, 50, 0], [-50, 50, 0], [-50, -50, 0], [50, -50, 0]])
CAMERA = Camera(640, 480, 500, 500, 319.5, 239.5)
# So long a lens that distances from the centre are depths to 1e-6.
LONG = Camera(4, 4, 1e4, 1e4, 1.5, 1.5)


def pose(shift=(0, 0, 0), turn=0.0):
    rotation = Rotation.from_euler("z", turn, degrees=True).as_matrix()
    return Alignment(rotation, np.add([0, 0, 1000], shift), [1, 1, 1])


# --- MSSD and MSPD ---------------------------------------------------------------------------


def test_truth_is_perfect():
    none = Symmetry.none()
    assert mssd(est=pose(), gt=pose(), vertices=SQUARE, symmetry=none) == 0
    assert mspd(est=pose(), gt=pose(), vertices=SQUARE, symmetry=none, camera=CAMERA) == 0


def test_a_shift():
    """Every vertex moves by (30, 40, 0), 50 mm; at 1 m and f = 500 px by 15 and 20 px: 25 px."""
    arguments = {"vertices": SQUARE, "symmetry": Symmetry.none()}
    assert mssd(est=pose((30, 40, 0)), gt=pose(), **arguments) == pytest.approx(50)
    found = mspd(est=pose((30, 40, 0)), gt=pose(), **arguments, camera=CAMERA)
    assert found == pytest.approx(25)


def test_the_largest_distance_counts():
    """Half a turn takes each vertex to the opposite one: 100 sqrt(2) mm, 50 sqrt(2) px."""
    arguments = {"vertices": SQUARE, "symmetry": Symmetry.none()}
    assert mssd(est=pose(turn=180), gt=pose(), **arguments) == pytest.approx(100 * np.sqrt(2))
    found = mspd(est=pose(turn=180), gt=pose(), **arguments, camera=CAMERA)
    assert found == pytest.approx(50 * np.sqrt(2))


def test_symmetries_are_taken_off():
    """With a fourfold axis, 100 deg are 10: chord 2 * 70.71 * sin(5 deg) mm.

    With any rotation in steps of 2 pi / 315, at most half a step remains: 0.57 deg.
    """
    radius = 50 * np.sqrt(2)
    four = Symmetry.around((0, 0, 1), fold=4)
    found = mssd(est=pose(turn=100), gt=pose(), vertices=SQUARE, symmetry=four)
    assert found == pytest.approx(2 * radius * np.sin(np.radians(5)))
    found = mspd(est=pose(turn=100), gt=pose(), vertices=SQUARE, symmetry=four, camera=CAMERA)
    assert found == pytest.approx(radius * np.sin(np.radians(5)))
    every = Symmetry.around((0, 0, 1), fold=None)
    found = mssd(est=pose(turn=77), gt=pose(), vertices=SQUARE, symmetry=every)
    assert found <= 2 * radius * np.sin(np.pi / 315 / 2) + 1e-9


def test_projections_behind_the_camera_are_infinitely_far():
    arguments = {"vertices": SQUARE, "symmetry": Symmetry.none(), "camera": CAMERA}
    assert mspd(est=pose((0, 0, -2000)), gt=pose(), **arguments) == np.inf
    assert mspd(est=pose(), gt=pose((0, 0, -2000)), **arguments) == np.inf
    with pytest.raises(InputError, match="vertices"):
        mssd(est=pose(), gt=pose(), vertices=np.empty((0, 3)), symmetry=Symmetry.none())


def test_the_literal_definitions_agree():
    """R_gt S and t_gt of the definition, point by point, for discrete and continuous symmetries."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(7, 3)) * 50
    flip = np.diag([-1.0, -1, 1, 1])
    flip[:3, 3] = [3, 4, 0]
    symmetry = Symmetry(flip[None], (SymmetryAxis(np.array([0, 0, 1.0]), np.array([1.0, 2, 0])),))
    est = Alignment(Rotation.random(random_state=1).as_matrix(), [1, 2, 900], [1, 1, 1])
    gt = Alignment(Rotation.random(random_state=2).as_matrix(), [5, 2, 950], [1, 1, 1])
    k = CAMERA.matrix
    surface, pixels = [], []
    for motion in symmetry.poses(max_step=0.1):
        rotation = gt.rotation @ motion[:3, :3]
        shift = gt.rotation @ motion[:3, 3] + gt.translation
        first = [est.rotation @ point + est.translation for point in points]
        second = [rotation @ point + shift for point in points]
        surface.append(max(np.linalg.norm(a - b) for a, b in zip(first, second, strict=True)))
        flat = [[(k @ x)[:2] / (k @ x)[2] for x in side] for side in (first, second)]
        pixels.append(max(np.linalg.norm(a - b) for a, b in zip(*flat, strict=True)))
    arguments = {"est": est, "gt": gt, "vertices": points, "symmetry": symmetry, "max_step": 0.1}
    assert mssd(**arguments) == pytest.approx(min(surface))
    assert mspd(**arguments, camera=CAMERA) == pytest.approx(min(pixels))


# --- VSD -------------------------------------------------------------------------------------


def columns(*depths):
    """A depth image of 4 rows with one depth for each column."""
    return np.tile(np.array(depths, dtype=float), (4, 1))


def test_vsd_of_truth_is_zero():
    image = columns(1000, 1000, 0, 0)
    for test in (image, columns(0, 0, 0, 0), columns(1000, 1000, 1500, 1500)):
        errors = vsd_of_depths(est=image, gt=image, test=test, camera=LONG, diameter=100)
        assert errors.tolist() == [0] * len(TAUS)


def test_vsd_of_a_shift_by_one_column():
    """Truth in columns 0 and 1, estimate in 1 and 2: of 12 pixels 4 agree, 8 / 12 do not."""
    errors = vsd_of_depths(
        est=columns(0, 1000, 1000, 0), gt=columns(1000, 1000, 0, 0), test=columns(0, 0, 0, 0),
        camera=LONG, diameter=100,
    )  # fmt: skip
    np.testing.assert_allclose(errors, 2 / 3)


def test_vsd_of_depths_that_differ():
    """22 mm of a diameter of 100: over the tolerances 0.05, ..., 0.2, below 0.25, ..., 0.5."""
    errors = vsd_of_depths(
        est=columns(1022, 1022, 0, 0), gt=columns(1000, 1000, 0, 0), test=columns(0, 0, 0, 0),
        camera=LONG, diameter=100,
    )  # fmt: skip
    assert errors.tolist() == [1] * 4 + [0] * 6


def test_vsd_sees_only_what_is_not_hidden():
    """A surface at 500 mm hides column 0. The truth is seen in column 1, the estimate in column 2,
    and in column 1 too, where it lies 20 mm behind the measured surface but the truth is seen.

    Of the pixels of columns 1 and 2 (8), those of column 1 agree within 0.25: 4 / 8.
    """
    errors = vsd_of_depths(
        est=columns(1000, 1020, 1000, 0), gt=columns(1000, 1000, 0, 0),
        test=columns(500, 1000, 0, 0), camera=LONG, diameter=100, taus=[0.1, 0.25],
    )  # fmt: skip
    np.testing.assert_allclose(errors, [1.0, 0.5])


def test_vsd_where_nothing_is_seen_is_one():
    image = columns(1000, 0, 0, 0)
    errors = vsd_of_depths(est=image, gt=image, test=image / 2, camera=LONG, diameter=100)
    assert errors.tolist() == [1] * len(TAUS)
    with pytest.raises(InputError, match="diameter"):
        vsd_of_depths(est=image, gt=image, test=image, camera=LONG, diameter=0)
    with pytest.raises(InputError, match="shape"):
        vsd_of_depths(est=image[:2], gt=image, test=image, camera=LONG, diameter=1)


def test_distances_are_from_the_cameras_centre():
    """At 45 degrees, 15 mm of depth are 15 sqrt(2) = 21.2 mm of distance."""
    wide = Camera(3, 1, 1.0, 1.0, 1.0, 0.0)
    first, second = np.array([[100.0, 0, 0]]), np.array([[115.0, 0, 0]])
    errors = vsd_of_depths(
        est=second, gt=first, test=0 * first, camera=wide, diameter=100, taus=[0.2, 0.22]
    )
    assert errors.tolist() == [1, 0]


# --- recalls ---------------------------------------------------------------------------------


def test_recalls():
    """Thresholds 0.05, ..., 0.5: an error of 0.12 is below 8 of 10.

    12 px at the width 1280 are 6 at 640: below 9 of 10.
    """
    assert vsd_recall(np.zeros((2, 10))) == 1.0
    assert vsd_recall([[0.12] * 10, [0.0] * 10]) == pytest.approx(0.9)
    assert mssd_recall([0.0, 12.0], [100.0, 100.0]) == pytest.approx(0.9)
    assert mssd_recall([np.inf], [100.0]) == 0
    assert mspd_recall([12.0], width=1280) == pytest.approx(0.9)
    assert mspd_recall([0.0, np.inf], width=640) == 0.5
    assert np.isnan(mspd_recall([], width=640))


@pytest.mark.slow
def test_the_sample_against_itself_and_a_millimetre_off(real_data):
    photo = cadalign.datasets.open(real_data / "real" / "lmo_multiview")[0]
    shown = photo.objects[0]
    truth, mesh = shown.truth.cam_from_model, shown.model.load_mesh()
    arguments = {"vertices": mesh.vertices, "symmetry": shown.symmetry}
    assert mssd(est=truth, gt=truth, **arguments) == 0
    assert mspd(est=truth, gt=truth, **arguments, camera=photo.camera) == 0
    off = Alignment(truth.rotation, truth.translation + [1, 0, 0], [1, 1, 1])
    assert mssd(est=off, gt=truth, **arguments) == pytest.approx(1)
    depth = np.zeros((photo.camera.height, photo.camera.width))
    scene = Scene(mesh)
    both = {"scene": scene, "camera": photo.camera, "depth": depth, "diameter": 100.0}
    assert vsd(est=truth, gt=truth, **both).max() == 0
    assert 0 < vsd(est=off, gt=truth, **both).max() < 0.1
