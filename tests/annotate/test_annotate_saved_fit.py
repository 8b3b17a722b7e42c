"""The saved observation gives `cadalign fit` the page's numbers, deviations included."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from support.annotating import Case, agree_with_fit, place_all

from cadalign import Result
from cadalign.annotate.actions import perform
from cadalign.io.observation import Observation

pytestmark = pytest.mark.long


def with_exif(case: Case) -> None:
    """Give the photo a focal length near the camera's own in its EXIF data [mm]."""
    image = Image.open(case.photo)
    image.load()
    exif = Image.Exif()
    exif[0x8769] = {0xA405: 51}
    image.save(case.photo, exif=exif)


@pytest.mark.parametrize(("exif", "calibrated"), [(False, True), (False, False), (True, False)])
@pytest.mark.parametrize(("noise", "weighted"), [(0.2, True), (8.0, False)])
def test_fit_of_the_observation_gives_the_pages_numbers(
    case: Case,
    capsys: pytest.CaptureFixture[str],
    *,
    exif: bool,
    calibrated: bool,
    noise: float,
    weighted: bool,
) -> None:
    if exif:
        with_exif(case)
    rng = np.random.default_rng(0)
    instance = case.instance
    count = len(instance.points_3d)
    exact = instance.camera.project(instance.cam_from_model.apply(instance.points_3d))
    Observation(
        instance.points_3d,
        exact + noise * rng.normal(size=(count, 2)),
        instance.camera,
        sigma=rng.uniform(0.5, 2, count) if weighted else None,
    ).save(case.observation)
    session = case.open()
    if not calibrated:
        perform(session, 0, {"do": "focal", "known": False})
    perform(session, 0, {"do": "delete", "pair": 2})
    live, _ = session.live(session.photos[0])
    assert (live.sigma > 1) == (noise > 1)
    shown = agree_with_fit(session, case, capsys)
    saved = Result.load(case.folder / "photo_fit" / "fit.json")
    assert live.result is not None
    assert saved.alignment == live.result.alignment
    np.testing.assert_array_equal(saved.covariance, live.result.covariance)
    assert shown["alignment"] == saved.alignment.to_dict()


def test_stored_options_that_the_page_does_not_use_are_named(
    case: Case, caplog: pytest.LogCaptureFixture
) -> None:
    instance = case.instance
    for options in ({"sigma": None}, {"sigma": 3.0, "loss": "cauchy"}):
        Observation(
            instance.points_3d, instance.points_2d, instance.camera, fit_options=options
        ).save(case.observation)
        assert caplog.text == ""
        case.open()
    assert f"{case.observation}: the annotator fits without the stored loss, and" in caplog.text


def test_options_follow_the_pairs(case: Case) -> None:
    """What was estimated for other pairs is not left in the file."""
    instance = case.instance
    points_2d = instance.points_2d + 8 * np.random.default_rng(0).normal(
        size=instance.points_2d.shape
    )
    Observation(instance.points_3d, points_2d, instance.camera).save(case.observation)
    session = case.open()
    perform(session, 0, {"do": "move", "pair": 1, "uv": [50, 60]})
    assert Observation.load(case.observation).fit_options == {"sigma": None}
    while len(session.photos[0].document.pairs) > 4:
        perform(session, 0, {"do": "delete", "pair": session.photos[0].document.pairs[-1].number})
    assert Observation.load(case.observation).fit_options == {}


def test_a_stored_sigma_counts_and_is_kept(
    case: Case, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    instance = case.instance
    options = {"sigma": 3.0}
    Observation(instance.points_3d, instance.points_2d, instance.camera, fit_options=options).save(
        case.observation
    )
    session = case.open()
    assert caplog.text == ""
    perform(session, 0, {"do": "move", "pair": 1, "uv": [150, 160]})
    perform(session, 0, {"do": "undo"})
    assert Observation.load(case.observation).fit_options == options
    assert session.live(session.photos[0])[0].sigma == 3.0
    agree_with_fit(session, case, capsys)


def test_a_prior_that_is_switched_off_is_so_in_fit(
    case: Case, capsys: pytest.CaptureFixture[str]
) -> None:
    session = case.open(camera=None)
    place_all(session, case)
    perform(session, 0, {"do": "prior", "focal": False})
    agree_with_fit(session, case, capsys)


@pytest.mark.parametrize("evidence", ["mask", "photo"])
def test_fit_finds_what_the_page_does_of_a_similar_model_with_its_outline(
    case: Case, capsys: pytest.CaptureFixture[str], evidence: str
) -> None:
    """Every keypoint of the model warps its mesh: those that no pair shows are not in the file."""
    session = case.open(shape_sigma=0.02)
    place_all(session, case, count=5)
    if evidence == "mask":
        perform(session, 0, {"do": "mask_cut", "corners": [[90, 10], [470, 460]]})
    else:
        perform(session, 0, {"do": "use_photo", "on": True})
    agree_with_fit(session, case, capsys)


def test_an_estimated_focal_length_has_square_pixels_as_in_fit(
    case: Case, capsys: pytest.CaptureFixture[str]
) -> None:
    calibrated = case.instance.camera
    case.camera.write_text(json.dumps(replace(calibrated, fy=1.1 * calibrated.fx).to_dict()))
    session = case.open()
    place_all(session, case)
    perform(session, 0, {"do": "focal", "known": False})
    found = agree_with_fit(session, case, capsys)["intrinsics"]
    assert found["fy"] == found["fx"]
    perform(session, 0, {"do": "focal", "known": True})
    assert session.photos[0].camera.fy == pytest.approx(1.1 * calibrated.fx)
