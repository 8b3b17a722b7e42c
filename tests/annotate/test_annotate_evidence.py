"""Evidence besides keypoints in an observation file: kept, used as by `cadalign fit`, named."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.annotating import Case, agree_with_fit, place_all

from cadalign import Size
from cadalign.annotate.actions import perform
from cadalign.annotate.page_state import page_state
from cadalign.errors import CadalignError
from cadalign.io.evidence import ImageEvidence
from cadalign.io.images import write_image
from cadalign.io.observation import Observation
from cadalign.render import cast_geometry

pytestmark = pytest.mark.long

PIECES = ("mask", "keypoint depths", "up", "camera_height", "size")


def observed(case: Case, *pieces: str) -> Observation:
    """The photo's keypoints with some pieces of further evidence."""
    instance = case.instance
    camera, truth = instance.camera, instance.cam_from_model
    in_camera = truth.apply(instance.points_3d)
    given: dict[str, Any] = {}
    fields: dict[str, Any] = {}
    if "mask" in pieces:
        assert instance.scene is not None
        mask = cast_geometry(instance.scene, camera, truth).mask
        write_image(case.folder / "m.mask.png", np.where(mask, 255, 0).astype(np.uint8))
        given["mask"] = case.folder / "m.mask.png"
    if "keypoint depths" in pieces:
        depths = in_camera[:, 2].copy()
        depths[1] = np.nan
        fields["depths"] = depths
        given["depth_sigma"] = 0.005
    if "up" in pieces:
        given |= {"up": truth.rotation @ [0.0, 1.0, 0.0], "up_sigma_deg": 2.0}
    if "camera_height" in pieces:
        up = truth.rotation @ [0.0, 1.0, 0.0]
        lowest = (in_camera @ up).min()
        given |= {"camera_height": float(max(-lowest, 0.1)), "up": up}
    if "size" in pieces:
        lengths = np.ptp(np.asarray(instance.scene.bounds), axis=0) * truth.scale  # type: ignore[union-attr]
        fields["size"] = Size(width=float(lengths[0]), height=float(lengths[1]), sigma=0.01)
    first = Observation(
        instance.points_3d,
        instance.points_2d,
        camera,
        ids=instance.ids,
        names=tuple(f"point {number}" for number in instance.ids),
        image=case.photo,
        evidence=ImageEvidence(**given),
        **fields,
    )
    if "views" not in pieces:
        return first
    return replace(first, others=(replace(first, image=None, evidence=ImageEvidence()),))


def stored(case: Case) -> dict[str, Any]:
    return dict(json.loads(case.observation.read_text()))


@pytest.mark.parametrize("pieces", [*[(piece,) for piece in PIECES], ("mask", "up", "size")])
def test_evidence_is_kept_used_as_by_fit_and_named(
    case: Case, capsys: pytest.CaptureFixture[str], pieces: tuple[str, ...]
) -> None:
    if "camera_height" in pieces:
        pytest.importorskip("embreex")
    observed(case, *pieces).save(case.observation)
    before = stored(case)
    session = case.open(keypoints=None)
    perform(session, 0, {"do": "move", "pair": 1, "uv": [200, 200]})
    perform(session, 0, {"do": "undo"})
    after = stored(case)
    for data in (before, after):  # what the annotator adds to any file it saves
        data.pop("model", None)
        data.pop("fit", None)
    assert after == before

    shown = agree_with_fit(session, case, capsys)
    words = {"up": "gravity", "size": "known width and height"}
    words |= {"keypoint depths": "depth", "camera_height": "camera height"}
    for piece in pieces:
        assert words.get(piece, piece) in shown["also_used"]
    assert shown["facts"]
    assert shown["box"]


def test_evidence_outlives_the_last_pair(case: Case) -> None:
    observed(case, "up", "size").save(case.observation)
    session = case.open()
    for pair in session.photos[0].marks.pairs:
        perform(session, 0, {"do": "delete", "pair": pair.number})
    again = case.open()
    assert stored(case)["up_sigma_deg"] == 2.0
    place_all(again, case, count=5)
    assert stored(case)["size"]["sigma"] == 0.01
    assert page_state(again, 0)["alignment"]["also_used"] == "gravity, known width and height"


def test_several_views_are_refused(case: Case) -> None:
    observed(case, "views").save(case.observation)
    before = case.observation.read_bytes()
    with pytest.raises(CadalignError, match="has 2 views, the annotator only opens files of one"):
        case.open()
    assert case.observation.read_bytes() == before
