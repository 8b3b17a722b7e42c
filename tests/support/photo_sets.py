"""Tiny data sets of photos of one box with ten keypoints, consistent in all that they say."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from cadalign import Alignment, Camera, Mesh
from cadalign.render import Scene, cast_geometry
from support.files import write_json
from support.photo_data import matrix_text, trs, write_photo, write_text

SIDES = np.array([0.5, 0.6, 0.4])
CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * SIDES / 2
POINTS = np.vstack([CORNERS, [[0.1, 0.3, 0.0], [-0.25, 0.0, 0.1]]])
NAMES = tuple(f"p{row}" for row in range(len(POINTS)))
_QUADS = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
FACES = np.array([[q[0], q[i], q[i + 1]] for q in _QUADS for i in (1, 2)])
CAMERA = Camera(320, 240, 300.0, 300.0, 159.5, 119.5)


def pose(number: int, *, distance: float = 2.0, scale: Any = (1.0, 1.0, 1.0)) -> Alignment:
    """A pose of the box before the camera, another for every number."""
    rng = np.random.default_rng(number)
    rotation = Rotation.from_euler("yx", [rng.uniform(20, 70), rng.uniform(10, 30)], degrees=True)
    upside_down = np.diag([1.0, -1.0, -1.0])
    shift = np.array([*rng.uniform(-0.1, 0.1, 2), distance])
    return Alignment(upside_down @ rotation.as_matrix(), shift, np.array(scale, dtype=float))


def pixels_of(alignment: Alignment, *, noise: float = 0.0, seed: int = 0) -> np.ndarray:
    """The keypoints in the photo."""
    drawn = np.random.default_rng(seed).normal(0, 1, (len(POINTS), 2))
    return CAMERA.project(alignment.apply(POINTS)) + noise * drawn


def drawn(alignment: Alignment, *, unit: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Mask and depth of the box."""
    geometry = cast_geometry(Scene(Mesh(CORNERS * unit, FACES)), CAMERA, alignment)
    return geometry.mask, np.nan_to_num(geometry.depth, posinf=0.0)


def obj_text(points: np.ndarray = CORNERS) -> str:
    """The box as OBJ."""
    vertices = "".join(f"v {x} {y} {z}\n" for x, y, z in points)
    return vertices + "".join(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in FACES)


def write_pix3d(root: Path, *, photos: int = 3, noise: float = 0.5) -> Path:
    """Photos of the box, its exact model, and masks."""
    entries = []
    for number in range(photos):
        alignment = pose(number)
        mask, _ = drawn(alignment)
        path = root / "mask" / f"{number}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray((255 * mask).astype(np.uint8)).save(path)
        write_photo(root / "img" / f"{number}.png", 320, 240)
        axes = np.array([-1.0, -1.0, 1.0])
        entries.append(
            {
                "img": f"img/{number}.png", "category": ("chair", "table")[number % 2],
                "img_size": [320, 240], "mask": f"mask/{number}.png", "model": "model/m.obj",
                "2d_keypoints": [(pixels_of(alignment, noise=noise, seed=number) + 0.5).tolist()],
                "3d_keypoints": "model/k.txt", "focal_length": 300 / 320 * 32,
                "rot_mat": (axes[:, None] * alignment.rotation).tolist(),
                "trans_mat": (axes * alignment.translation).tolist(),
                "bbox": [100, 60, 220, 180],
            }
        )  # fmt: skip
    write_json(root / "pix3d.json", entries)
    write_text(root / "model" / "m.obj", obj_text())
    write_text(root / "model" / "k.txt", matrix_text(POINTS))
    return root


def write_scan2cad(root: Path, *, frames: int = 2) -> Path:
    """A scan with the box stretched as no model is, seen from several places."""
    folder = root / "scans" / "scene0000_00"
    intrinsics = np.eye(4)
    intrinsics[:3, :3] = CAMERA.matrix
    write_text(folder / "intrinsic" / "intrinsic_color.txt", matrix_text(intrinsics))
    scale = (1.1, 1.3, 0.9)
    # The scan's z and the box's y point up.
    world_from_model = np.eye(4)
    world_from_model[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    for number in range(frames):
        alignment = pose(number, scale=scale)
        cam_from_model = np.eye(4)
        cam_from_model[:3, :3], cam_from_model[:3, 3] = alignment.rotation, alignment.translation
        scan_from_cam = world_from_model @ np.linalg.inv(cam_from_model)
        write_photo(folder / "color" / f"{number}.jpg", 320, 240)
        write_text(folder / "pose" / f"{number}.txt", matrix_text(scan_from_cam))
    placed = POINTS * scale @ world_from_model[:3, :3].T
    model = {
        "trs": trs(world_from_model, scale), "id_cad": "abc", "catid_cad": "03001627",
        "sym": "__SYM_NONE", "bbox": (SIDES / 2).tolist(), "center": [0.0, 0.0, 0.0],
        "keypoints_cad": {"position": placed.ravel().tolist()},
        "keypoints_scan": {"position": placed.ravel().tolist()},
    }  # fmt: skip
    scan = {"id_scan": "scene0000_00", "trs": trs(np.eye(4)), "aligned_models": [model]}
    write_json(root / "full_annotations.json", [scan])
    write_text(root / "ShapeNetCore.v2/03001627/abc/models/model_normalized.obj", obj_text())
    return root


def write_pascal3d(root: Path) -> Path:
    """One photo of PASCAL3D+ with the box as its model, z up."""
    points = POINTS[:, [0, 2, 1]]
    fields = dict(zip(NAMES, points, strict=True))
    cad = {"vertices": CORNERS[:, [0, 2, 1]], "faces": FACES + 1.0}
    cad |= {"pnames": np.array(NAMES, dtype=object), **fields}
    (root / "CAD").mkdir(parents=True)
    _write_mat(root / "CAD" / "chair.mat", {"chair": np.array([cad], dtype=object)})
    write_photo(root / "Images" / "chair_pascal" / "1.jpg", 320, 240)
    view = {"azimuth": 40.0, "elevation": 15.0, "distance": 15.0, "focal": 1.0, "px": 160.5,
            "py": 120.5, "theta": 5.0, "viewport": 3000.0}  # fmt: skip
    found = {"class": "chair", "bbox": np.array([90.0, 60.0, 230.0, 180.0]), "viewpoint": view,
             "cad_index": 1.0, "anchors": {}}  # fmt: skip
    path = root / "Annotations" / "chair_pascal" / "1.mat"
    path.parent.mkdir(parents=True)
    _write_record(path, found)
    import cadalign.datasets

    truth = cadalign.datasets.open(root)[0].objects[0].truth
    pixels = truth.camera.project(truth.cam_from_model.apply(points)) + 1
    found["anchors"] = {
        name: {"location": pixel, "status": 1.0} for name, pixel in zip(NAMES, pixels, strict=True)
    }
    _write_record(path, found)
    return root


def _write_record(path: Path, found: dict[str, Any]) -> None:
    objects = np.array([found], dtype=object)
    record = {"filename": "1.jpg", "objects": objects}
    _write_mat(path, {"record": record})


def _write_mat(path: Path, variables: dict[str, Any]) -> None:
    # As MATLAB does; damage to others can crash SciPy.
    savemat(path, variables, do_compression=True)


WRITERS = {
    "Pix3D": write_pix3d,
    "Scan2CAD": write_scan2cad,
    "PASCAL3D+": write_pascal3d,
}
"""What writes a data set of each kind."""
