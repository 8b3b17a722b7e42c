"""A mask alone and the photo itself on the page: aligned, saved, undone, reopened."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from support.annotating import (
    Case,
    agree_with_fit,
    draw_mask,
    masks_searched_once,
    place,
    place_all,
)

from cadalign import ShapeModel
from cadalign.annotate.actions import perform
from cadalign.annotate.page_state import page_state
from cadalign.annotate.session import Session
from cadalign.datasets import KeypointNet
from cadalign.metrics import rotation_error
from cadalign.render import cast_geometry
from cadalign.shapes.examples import Example

pytestmark = pytest.mark.long


@pytest.fixture(scope="module", autouse=True)
def _searched_once() -> Iterator[None]:
    with masks_searched_once():
        yield


def draw_true_mask(session: Session, case: Case) -> None:
    instance = case.instance
    assert instance.scene is not None
    mask = cast_geometry(instance.scene, instance.camera, instance.cam_from_model).mask
    draw_mask(session, mask)


def test_a_mask_alone_is_aligned(case: Case, capsys: pytest.CaptureFixture[str]) -> None:
    session = case.open()
    draw_true_mask(session, case)
    page, truth = page_state(session, 0), case.instance.cam_from_model
    assert page["alignment"]["status"] == "done", page["alignment"]
    live = session.live(session.photos[0])
    assert rotation_error(est=live.result.alignment, gt=truth) < 0.5
    agree_with_fit(session, case, capsys, rtol=1e-6)


@pytest.mark.parametrize("own", ["shape", "shape_sigma"])
def test_a_mask_alone_does_not_align_an_own_shape(case: Case, sample_root: Path, own: str) -> None:
    if own == "shape":
        model, rng = KeypointNet(sample_root)["chair", "sample_chair_000"], np.random.default_rng(0)
        ids, points = model.keypoints.ids.tolist(), model.keypoints.xyz
        bounds, noises = model.load_mesh().bounds, rng.normal(0, 1e-3, (4, *points.shape))
        examples = [
            Example(str(k), ids, points + each, bounds, model.mesh_path)
            for k, each in enumerate(noises)
        ]
        path = case.folder / "chair.shape"
        ShapeModel.learn(examples, category="chair", up_axis="y").save(path)
        session = case.open(shape=path)
    else:
        session = case.open(shape_sigma=0.06)
    draw_true_mask(session, case)
    alignment = page_state(session, 0)["alignment"]
    assert alignment["status"] == "none"
    assert alignment["message"].startswith("3 more pairs to the first alignment")


def test_few_pairs_beside_a_mask_wait(case: Case, capsys: pytest.CaptureFixture[str]) -> None:
    session = case.open()
    draw_true_mask(session, case)
    state = place_all(session, case, count=2)
    assert (
        "2 pairs do not count: the mask alone aligns until there are 3."
        in (state["alignment"]["notes"])
    )
    agree_with_fit(session, case, capsys, rtol=1e-6)
    live = session.live(session.photos[0])
    assert np.abs(live.residuals).max() < 5
    place(session, *case.clicks[2])
    third = page_state(session, 0)["alignment"]
    assert third["notes"] == [] or "do not count" not in third["notes"][0]
    assert session.live(session.photos[0]).counts.all()


def test_the_photo_counts_when_it_is_chosen(case: Case, capsys: pytest.CaptureFixture[str]) -> None:
    session = case.open()
    place_all(session, case, count=5)
    before = session.live(session.photos[0])
    perform(session, 0, {"do": "use_photo", "on": True})
    page = page_state(session, 0)
    assert page["evidence"]["photo"]
    assert page["alignment"]["also_used"] == "photo"
    live = session.live(session.photos[0])
    assert [each.kind for each in live.result.evidence] == ["keypoints", "photo"]
    truth = case.instance.cam_from_model
    assert rotation_error(est=live.result.alignment, gt=truth) < rotation_error(
        est=before.result.alignment, gt=truth
    )
    assert json.loads(case.observation.read_text())["fit"]["image"] is True
    agree_with_fit(session, case, capsys, rtol=1e-6)
    assert page_state(case.open(), 0)["evidence"]["photo"]
    perform(session, 0, {"do": "undo"})
    assert not page_state(session, 0)["evidence"]["photo"]
    assert "image" not in json.loads(case.observation.read_text())["fit"]
