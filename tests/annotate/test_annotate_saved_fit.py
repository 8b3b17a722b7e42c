"""The saved observation gives `cadalign fit` the page's numbers, deviations included."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image
from support.annotating import Case, agree_with_fit, place_all

from cadalign import Camera
from cadalign.annotate.actions import perform
from cadalign.annotate.observations import LIKELY_STRETCH
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
        perform(session, 0, {"do": "focal", "pixels": None})
    perform(session, 0, {"do": "delete", "pair": 2})
    agree_with_fit(session, case, capsys)


def test_stored_options_that_the_page_does_not_use_are_named(
    case: Case, caplog: pytest.LogCaptureFixture
) -> None:
    instance = case.instance
    options = {"sigma": 3.0, "loss": "cauchy"}
    Observation(instance.points_3d, instance.points_2d, instance.camera, fit_options=options).save(
        case.observation
    )
    case.open()
    words = f"{case.observation}: the annotator fits without the stored sigma, loss, and"
    assert words in caplog.text


def test_options_follow_the_pairs(case: Case) -> None:
    """Estimates for earlier pairs do not stay in the file."""
    session = case.open()
    place_all(session, case)
    before = Observation.load(case.observation).fit_options
    perform(session, 0, {"do": "move", "pair": 1, "uv": [50, 60]})
    after = Observation.load(case.observation).fit_options
    assert after["sigma"] > before["sigma"]
    assert after["stretch_sigma"] == before["stretch_sigma"] == LIKELY_STRETCH
    while len(session.photos[0].marks.pairs) > 3:
        perform(session, 0, {"do": "delete", "pair": session.photos[0].marks.pairs[-1].number})
    assert Observation.load(case.observation).fit_options == {"stretch_sigma": LIKELY_STRETCH}


def test_priors_of_a_file_count_and_are_kept(
    case: Case, capsys: pytest.CaptureFixture[str]
) -> None:
    instance, options = case.instance, {"stretch_sigma": 0.1, "focal_prior": None}
    camera = Camera.from_size(instance.camera.width, instance.camera.height)
    Observation(instance.points_3d, instance.points_2d, camera, fit_options=options).save(
        case.observation
    )
    session = case.open()
    perform(session, 0, {"do": "delete", "pair": 1})
    assert Observation.load(case.observation).fit_options.items() >= options.items()
    agree_with_fit(session, case, capsys)
