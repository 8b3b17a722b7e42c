"""BOP's pose errors VSD, MSSD and MSPD, and the average recalls made of them.

Hodan et al., "BOP Challenge 2020 on 6D Object Localization", ECCV Workshops 2020, section 2.4; the
definitions of bop_toolkit's ``pose_error.py`` with the visibility of BOP 2019 and later.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray, as_floats, as_points
from cadalign.datasets.photos.bop import MILLIMETRES
from cadalign.errors import InputError
from cadalign.evaluation.metrics import table as metrics
from cadalign.evaluation.metrics.photos import MetricSet
from cadalign.evaluation.metrics.table import Metric
from cadalign.evaluation.runs.work import Row
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.box import Box
from cadalign.geometry.camera import Camera
from cadalign.geometry.symmetry import Symmetry

if TYPE_CHECKING:
    from cadalign.evaluation.photos.target import PhotoTarget
    from cadalign.render.scene import Scene

MAX_STEP = 0.01
"""How far turns about an axis of symmetry move the model's points at most, over its diameter."""
VSD_DELTA = 15.0
"""Tolerance of the visibility test [mm]."""
TAUS = tuple(np.arange(0.05, 0.51, 0.05).round(2).tolist())
"""Misalignment tolerances of VSD, as fractions of the diameter."""
THRESHOLDS = TAUS
"""Thresholds of VSD, and of MSSD as fractions of the diameter."""
MSPD_THRESHOLDS = tuple(np.arange(5.0, 51.0, 5.0).tolist())
"""Thresholds of MSPD [px] in images of the width 640."""
_WIDTH = 640.0


def mssd(
    *,
    est: Alignment,
    gt: Alignment,
    vertices: npt.ArrayLike,
    symmetry: Symmetry,
    max_step: float = MAX_STEP,
) -> float:
    """Maximum symmetry-aware surface distance, in units of the camera frame.

    The smallest, over the model's symmetries S, of the largest distance |est(x) - gt(S x)| of its
    ``vertices`` x (n, 3); ``max_step`` is the step of rotations about axes, see `Symmetry.poses`.
    Raises InputError if there are no vertices.
    """
    points = _vertices(vertices)
    at_est = est.apply(points)
    return min(
        float(np.linalg.norm(at_est - gt.apply(moved), axis=1).max())
        for moved in _symmetric(points, symmetry, max_step)
    )


def mspd(
    *,
    est: Alignment,
    gt: Alignment,
    vertices: npt.ArrayLike,
    symmetry: Symmetry,
    camera: Camera,
    max_step: float = MAX_STEP,
) -> float:
    """Maximum symmetry-aware projection distance [px].

    As `mssd`, of the vertices' projections; infinite where a vertex lies behind the camera.
    """
    points = _vertices(vertices)
    at_est = camera.project_where_ahead(est.apply(points))
    if not np.isfinite(at_est).all():
        return float("inf")
    return min(
        float(np.linalg.norm(at_est - camera.project_where_ahead(gt.apply(moved)), axis=1).max())
        for moved in _symmetric(points, symmetry, max_step)
    )


def vsd(
    *,
    est: Alignment,
    gt: Alignment,
    scene: Scene,
    camera: Camera,
    depth: npt.ArrayLike,
    diameter: float,
    delta: float = VSD_DELTA,
    taus: Sequence[float] = TAUS,
) -> FloatArray:
    """Visible surface discrepancy for each tolerance tau, (t,) float, 0 to 1.

    The model, ``scene``, is drawn in both poses and compared with the photo's ``depth`` (h, w), 0
    where nothing was measured; see `vsd_of_depths`. ``delta`` is the tolerance of the visibility
    test in units of the camera frame; ``taus`` are fractions of the model's ``diameter``.
    """
    from cadalign.render.raycast.renderer import cast_geometry

    drawn = [cast_geometry(scene, camera, pose).depth for pose in (est, gt)]
    return vsd_of_depths(
        est=drawn[0], gt=drawn[1], test=depth, camera=camera, diameter=diameter, delta=delta,
        taus=taus,
    )  # fmt: skip


def vsd_of_depths(
    *,
    est: npt.ArrayLike,
    gt: npt.ArrayLike,
    test: npt.ArrayLike,
    camera: Camera,
    diameter: float,
    delta: float = VSD_DELTA,
    taus: Sequence[float] = TAUS,
) -> FloatArray:
    """Visible surface discrepancy of depth images (h, w), 0 where nothing is; (t,) float.

    Depths are taken as distances from the camera's centre. The true model is visible where it lies
    at most ``delta`` behind the measured surface, or nothing was measured; the estimated one there
    too, and where the true one is. The result is the share, among the pixels where either is
    visible, of those where only one is, or where the two differ by ``tau`` diameters or more; 1
    where neither is visible.

    Raises InputError if sizes don't match the camera, or the diameter is not positive.
    """
    if not diameter > 0:
        raise InputError(f"{diameter} is not positive", where="diameter")
    shape = (camera.height, camera.width)
    lengths = _ray_lengths(camera)
    at_est, at_gt, measured = (
        as_floats(image, name=name, shape=shape) * lengths
        for name, image in (("est", est), ("gt", gt), ("test", test))
    )
    gt_visible = _visible(at_gt, measured, delta)
    est_visible = _visible(at_est, measured, delta) | (gt_visible & (at_est > 0))
    both, either = gt_visible & est_visible, gt_visible | est_visible
    count = int(either.sum())
    if not count:
        return np.ones(len(taus))
    gaps = np.abs(at_gt[both] - at_est[both]) / diameter
    alone = count - int(both.sum())
    return np.array([(int((gaps >= tau).sum()) + alone) / count for tau in taus])


def vsd_recall(errors: npt.ArrayLike) -> float:
    """Average recall of VSD ``errors`` (n, t): over tolerances and thresholds, the share below."""
    table = as_floats(errors, name="errors", shape=(None, None))
    return _recall([table < limit for limit in THRESHOLDS])


def mssd_recall(errors: npt.ArrayLike, diameters: npt.ArrayLike) -> float:
    """Average recall of MSSD ``errors`` (n,): over thresholds of 5 % to 50 % of the diameters."""
    values = as_floats(errors, name="errors", shape=(None,), finite=False)
    sizes = as_floats(diameters, name="diameters", shape=(len(values),))
    return _recall([values < limit * sizes for limit in THRESHOLDS])


def mspd_recall(errors: npt.ArrayLike, *, width: int) -> float:
    """Average recall of MSPD ``errors`` (n,) [px]: over thresholds of 5 to 50 px at a width of 640.

    ``width`` is the images' [px].
    """
    values = as_floats(errors, name="errors", shape=(None,), finite=False)
    return _recall([values < limit * width / _WIDTH for limit in MSPD_THRESHOLDS])


def _recall(found: list[BoolArray]) -> float:
    table = np.array(found)
    return float(table.mean()) if table.size else float("nan")


def _visible(model: FloatArray, measured: FloatArray, delta: float) -> BoolArray:
    return np.asarray((model > 0) & ((model - measured <= delta) | (measured == 0)))


def _ray_lengths(camera: Camera) -> FloatArray:
    """Distance from the camera's centre per unit of depth at each pixel, (h, w) float."""
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    pixels = np.column_stack([columns.ravel(), rows.ravel()]).astype(float)
    normalized, _ = camera.normalize_where_valid(pixels)
    lengths = np.sqrt(1 + (normalized**2).sum(axis=1))
    return np.asarray(lengths.reshape(camera.height, camera.width))


def _vertices(vertices: npt.ArrayLike) -> FloatArray:
    points = as_points(vertices, name="vertices", dimension=3)
    if not len(points):
        raise InputError("there are none", where="vertices")
    return points


def _symmetric(points: FloatArray, symmetry: Symmetry, max_step: float) -> list[FloatArray]:
    poses = symmetry.poses(max_step=max_step)
    return [points @ motion[:3, :3].T + motion[:3, 3] for motion in poses]


MSSD = Metric("mssd", "MSSD", "diameters", 4)
MSPD = Metric("mspd_px", "MSPD", "px", symbol="MSPD px")
RECALLS = tuple(
    metrics.rate(f"{name}_recall", f"average recall of {name.upper()}", name.upper())
    for name in ("vsd", "mssd", "mspd")
)
AVERAGE_RECALL = metrics.rate("average_recall", "average recall", "AR")


def _measure(target: PhotoTarget, est: Alignment, gt: Alignment, box: Box) -> Row:
    cad, camera, metres = target.cad, target.photo.camera, target.found.truth.metres
    if cad is None or not cad.has_mesh or camera is None:
        return {}
    given: dict[str, Any] = {"est": est, "gt": gt, "symmetry": target.found.symmetry}
    diameter = cad.diameter
    # The distance is a convex function of the vertex: largest on the hull.
    surface = mssd(vertices=cad.hull_vertices, **given)
    pixels = mspd(vertices=cad.scene.used_vertices, camera=camera, **given)
    values = {
        MSSD.key: surface / diameter,
        MSPD.key: pixels if np.isfinite(pixels) else None,
        "mssd_recall": mssd_recall([surface], [diameter]),
        "mspd_recall": mspd_recall([pixels], width=camera.width),
    }
    if target.photo.depth is None or metres is None:
        return values
    discrepancies = vsd(
        est=est,
        gt=gt,
        scene=cad.scene,
        camera=camera,
        depth=target.photo.depth.read(),
        diameter=diameter,
        delta=VSD_DELTA * MILLIMETRES / metres,
    )
    return values | {"vsd_recall": vsd_recall([discrepancies])}


BOP = MetricSet(
    _measure,
    columns=(MSSD.key, MSPD.key, "mssd_recall", "mspd_recall", "vsd_recall"),
    medians=(MSSD, MSPD),
    shares=RECALLS,
    means=((AVERAGE_RECALL, RECALLS),),
    headline=(AVERAGE_RECALL, *RECALLS, MSSD, MSPD),
    console=(*RECALLS, AVERAGE_RECALL),
)
