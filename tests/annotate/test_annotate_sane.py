"""Scripted annotations, natural points first: never absurd, and soon right."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from support.annotating import aligned_once, place

from cadalign import Box, Camera
from cadalign.annotate.live import LiveAlignment
from cadalign.annotate.options import SessionOptions
from cadalign.annotate.session import Session, open_session
from cadalign.arrays import FloatArray
from cadalign.datasets import KeypointNet, ModelKeypoint, ModelKeypoints
from cadalign.errors import CadalignError
from cadalign.evaluation.instances.instance import load_scene, make_instance
from cadalign.io.images import write_image
from cadalign.io.observation import Observation
from cadalign.metrics import box_iou

MOUSE = 2.0  # standard deviation of a click [px]
RENDERED = 17
FACTOR = 2.0


@dataclass(frozen=True)
class Scripted:
    """What a person would click, and the truth."""

    name: str
    photo: Path
    model: Path
    camera: Camera
    points_3d: FloatArray
    points_2d: FloatArray
    scale: FloatArray
    box: Box


def natural_order(points: FloatArray) -> list[int]:
    """Tips and corners first: each the farthest from those before."""
    gaps = np.linalg.norm(points - points.mean(axis=0), axis=1)
    order: list[int] = []
    while len(order) < len(points):
        farthest = int(np.argmax(gaps))
        own = np.linalg.norm(points - points[farthest], axis=1)
        gaps = own if not order else np.minimum(gaps, own)
        order.append(farthest)
        gaps[order] = -1
    return order


def rendered(root: Path, folder: Path) -> Iterator[Scripted]:
    """ShapeNet models in random views, given stretched by 0.5 to 2, with photos that are grey."""
    number = 0
    for model in KeypointNet(root):
        if model.mesh_path is None or model.mesh_path.suffix != ".obj":
            continue
        scene = load_scene(model)
        for view in range(2):
            try:
                instance = make_instance(
                    model, noise_px=0.0, min_visible=7, seed=1, view_index=view, scene=scene
                )
            except CadalignError:  # so few of its keypoints are ever seen together
                continue
            if number == RENDERED:
                return
            own = folder / f"{number}"
            own.mkdir()
            size = instance.camera.height, instance.camera.width, 3
            write_image(own / "photo.png", np.full(size, 200, np.uint8))
            stretch = 1 / instance.gt.scale
            write_mesh(own / "model.ply", scene.mesh.vertices * stretch, scene.mesh.faces)
            rng = np.random.default_rng([view, number])
            order = natural_order(instance.points_3d)
            clicks = instance.points_2d + rng.normal(scale=MOUSE, size=instance.points_2d.shape)
            yield Scripted(
                f"{model.category} {number}",
                own / "photo.png",
                own / "model.ply",
                instance.camera,
                instance.points_3d[order],
                clicks[order],
                instance.gt.scale,
                instance.gt_box,
            )
            number += 1


def photographed(cars: Path, folder: Path) -> Iterator[Scripted]:
    """Cars of three street photos, whose model is the average car."""
    for truth in json.loads((cars / "truth.json").read_text()):
        path = cars / "observations" / f"{truth['name']}.json"
        text = path.read_text().replace('"confidence"', '"score"')
        observed = Observation.from_dict(json.loads(text), folder=path.parent)
        assert observed.scores is not None
        assert observed.image is not None
        seen = observed.scores > 0.1
        points, uv = observed.points_3d[seen], observed.points_2d[seen]
        own = folder / truth["name"]
        own.mkdir()
        (own / "photo.png").symlink_to(observed.image.resolve())
        import trimesh

        hull = trimesh.PointCloud(observed.points_3d).convex_hull
        write_mesh(own / "model.ply", np.asarray(hull.vertices), np.asarray(hull.faces))
        height, width, length = truth["dims_hwl"]
        lengths = np.array([width, length, height])
        scale = lengths / np.ptp(hull.vertices, axis=0)
        scale /= scale[0]
        bottom = np.array(truth["location_bottom_centre"]) * 1.0
        turn = truth["rotation_y"]
        # The box in units of the model, whose width is taken as known.
        unit = np.ptp(hull.vertices, axis=0)[0] / width
        axes = np.array(
            [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
        )
        center = (bottom - [0, height / 2, 0]) * unit
        box = Box(center, axes, np.array([length, height, width]) * unit)
        order = natural_order(points)
        yield Scripted(
            truth["name"],
            own / "photo.png",
            own / "model.ply",
            observed.camera,
            points[order],
            uv[order],
            scale,
            box,
        )


def write_mesh(path: Path, vertices: FloatArray, faces: np.ndarray) -> None:
    import trimesh

    trimesh.Trimesh(vertices, faces, process=False).export(path)


def opened(case: Scripted) -> Session:
    folder = case.photo.parent / "annotated"
    folder.mkdir()
    points = tuple(
        ModelKeypoint(name=f"point {row}", xyz=tuple(xyz), semantic_id=row)
        for row, xyz in enumerate(case.points_3d.tolist())
    )
    ModelKeypoints(points, case.model).save(folder / "given.keypoints.json")
    (folder / "camera.json").write_text(json.dumps(case.camera.to_dict()))
    session = open_session(
        SessionOptions(
            image=case.photo,
            model=case.model,
            camera=folder / "camera.json",
            keypoints=folder / "given.keypoints.json",
            out=folder,
        )
    )
    session.ready = True  # the first fit compiles what is not
    return session


@pytest.fixture(scope="module")
def scripted(tmp_path_factory: pytest.TempPathFactory, real_data: Path) -> list[Scripted]:
    folder = tmp_path_factory.mktemp("scripted")
    cases = list(rendered(real_data / "keypointnet", folder))
    return cases + list(photographed(real_data / "real" / "kitti_cars", folder))


@pytest.mark.long
def test_twenty_annotations_are_sane_from_the_fourth_pair(
    scripted: list[Scripted],
) -> None:
    assert len(scripted) == 20
    errors: dict[int, list[float]] = {4: [], 6: [], 8: []}
    overlapping, beyond = 0, []
    for case in scripted:
        session = opened(case)
        state = session.photos[0]
        for count in sorted({*range(4, min(len(case.points_2d), 8) + 1), len(case.points_2d)}):
            with aligned_once(session):
                for row in range(len(state.marks.pairs), count):
                    place(session, row, case.points_2d[row].tolist())
            live = session.live(state)
            assert isinstance(live, LiveAlignment)
            assert live.result is not None, (case.name, count, live.message)
            scale = live.result.alignment.scale
            ratio = np.abs(np.log(scale / case.scale))
            if np.exp(ratio.max()) > FACTOR:
                beyond.append((case.name, count, scale.round(2), case.scale.round(2)))
            if count in errors:
                errors[count].extend(np.abs(scale / case.scale - 1)[1:].tolist())
            if count == 6:
                own = session.model.cad.scene.bounds
                estimate = Box.from_model(own, live.result.alignment)
                overlapping += box_iou(est=estimate, gt=case.box) > 0
    medians = {count: 100 * float(np.median(each)) for count, each in errors.items()}
    found = f"medians {medians}, {overlapping} boxes overlap"
    assert beyond == [], found
    assert medians[4] <= 25, found
    assert medians[6] <= 15, found
    assert medians[8] <= 10, found
    assert overlapping >= 18, found
