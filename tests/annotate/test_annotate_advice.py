"""What to add next is ranked as `rank_evidence` ranks it, for the pairs that the page shows."""

from __future__ import annotations

import json
import urllib.request
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.annotating import Case, place_all, served

from cadalign import Camera, Model, View
from cadalign.annotate.actions import perform
from cadalign.annotate.estimate import LiveAlignment
from cadalign.annotate.guard import TOKEN_HEADER
from cadalign.annotate.page_state import page_state
from cadalign.annotate.problem import LIKELY_STRETCH
from cadalign.annotate.ranking import advice_state
from cadalign.annotate.session import Session
from cadalign.annotate.suggestion import evidence_text, left_text, rank
from cadalign.estimation.uncertainty.next_best import Advice, rank_evidence
from cadalign.render import cast_geometry

pytestmark = pytest.mark.long


def asked(session: Session) -> dict[str, Any]:
    """The answer over the network."""
    with served(session) as access:
        request = urllib.request.Request(
            f"http://127.0.0.1:{access.port}/advice/0", headers={TOKEN_HEADER: access.token}
        )
        with urllib.request.urlopen(request, timeout=60) as response:
            return dict(json.loads(response.read()))


def test_ranking_is_that_of_the_evidence(case: Case) -> None:
    session = case.open()
    state = place_all(session, case, count=6)
    answer = asked(session)
    assert answer["revision"] == state["revision"]
    keypoints, uv = zip(*case.clicks[:6], strict=True)
    live, suggestion = session.live(session.photos[0])
    assert suggestion is not None
    assert live.result is not None
    alignment, camera = live.result.alignment, case.instance.camera
    # The pairs' deviations as the page shows them, calibrated for few pairs.
    stated, raw = live.result.covariance.diagonal(), live.result.fisher_covariance.diagonal()
    sigma = live.sigma * np.sqrt((stated[raw > 0] / raw[raw > 0]).mean())
    wanted = rank_evidence(
        Model(
            points_3d=np.vstack([session.models[0].registry.xyz(keypoints), suggestion.point.xyz]),
            ids=[*keypoints, "next"],
            mesh=session.models[0].cad.scene.mesh,
            stretch_sigma=LIKELY_STRETCH,
        ),
        View(camera, uv, ids=keypoints, sigma=sigma),
        alignment,
        candidates=["next"],
        mask=cast_geometry(session.models[0].cad.scene, camera, alignment).mask,
    )
    found = [(each["kind"], each["worst"]) for each in answer["pieces"]]
    assert sorted(kind for kind, _ in found) == ["keypoint", "lengths", "mask", "view"]
    assert [kind for kind, _ in found] == [each.kind for each in wanted]
    assert [worst for _, worst in found] == pytest.approx([each.worst for each in wanted])
    # What is left is less than what there is.
    shown = live.result.std
    assert answer["now"] == f"rotation to ± {shown.rotation_deg:.2g}°"
    assert wanted[-1].worst <= 1.01 * np.radians(shown.rotation_deg)
    names = {each["kind"]: each["what"] for each in answer["pieces"]}
    assert names["keypoint"] == suggestion.point.name


def test_photo_of_any_size_gives_the_same_ranking(case: Case) -> None:
    """Clicks are as precise in shares of the photo; so is the mask, of a photo of 1280 px."""
    session = case.open()
    place_all(session, case, count=6)
    live, suggestion = session.live(session.photos[0])
    assert isinstance(live, LiveAlignment)
    assert live.result is not None
    points_3d = session.models[0].registry.xyz(keypoint for keypoint, _ in case.clicks[:6])
    found = []
    for times in (2, 6):
        camera = case.instance.camera
        large = Camera(
            camera.width * times,
            camera.height * times,
            camera.fx * times,
            camera.fy * times,
            camera.cx * times + (times - 1) / 2,
            camera.cy * times + (times - 1) / 2,
        )
        points_2d = large.project(live.result.alignment.apply(points_3d))
        marked = (points_3d, points_2d, np.full(6, float(times)))
        (view,) = live.result.views
        result = replace(live.result, views=(replace(view, camera=large),))
        found.append(rank(session.models[0].cad, marked, result, suggestion))
    assert [each.kind for each in found[0]] == [each.kind for each in found[1]]
    worst = [[each.worst for each in one] for one in found]
    assert worst[0] == pytest.approx(worst[1], rel=1e-6)


def test_revision_grows_with_every_change(case: Case) -> None:
    session = case.open()
    found = [place_all(session, case, count=4)["revision"]]
    for name in ("undo", "redo"):
        perform(session, 0, {"do": name})
        found.append(page_state(session, 0)["revision"])
    assert found == sorted(set(found))


def test_nothing_is_ranked_without_an_estimate(case: Case) -> None:
    session = case.open()
    place_all(session, case, count=3)
    assert advice_state(session, 0)["pieces"] == []
    assert advice_state(session, 0)["note"] == ""


def test_unknown_focal_length_is_told(case: Case) -> None:
    session = case.open(camera=None)
    place_all(session, case, count=6)
    answer = advice_state(session, 0)
    assert answer["pieces"] == []
    assert "known focal length" in answer["note"]


def test_nothing_is_ranked_for_an_own_shape(case: Case) -> None:
    session = case.open(shape_sigma=0.01)
    place_all(session, case, count=6)
    assert advice_state(session, 0)["pieces"] == []


def test_a_click_does_not_wait_for_it(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    session = case.open()
    place_all(session, case, count=6)

    def meanwhile(*given: object) -> tuple[Advice, ...]:
        # Another thread gets the lock, which is held by none.
        with ThreadPoolExecutor(1) as pool:
            pool.submit(perform, session, 0, {"do": "undo"}).result(timeout=20)
        return ()

    monkeypatch.setattr("cadalign.annotate.ranking.rank", meanwhile)
    before = page_state(session, 0)["revision"]
    assert advice_state(session, 0)["revision"] == before
    assert page_state(session, 0)["revision"] == before + 1


@pytest.mark.parametrize(
    ("advice", "text"),
    [
        (Advice("view", "", 1.0, 0.01, (0, 0.01, 0.01)), "rotation to ± 1°"),
        (Advice("view", "", 0.1, 0.012, (0, 0.01, 0.01)), "position to ± 1.2 %"),
        (Advice("view", "", 0.1, 0.01, (0, 0.012, 0.2)), "stretch along z to ± 20 %"),
        (Advice("view", "", 0.1, 0.01, (0, 0.012, 2)), "something stays undetermined"),
    ],
)
def test_the_largest_deviation_is_named(advice: Advice, text: str) -> None:
    assert left_text(advice) == text


def test_lengths_are_named() -> None:
    advice = Advice("lengths", "width and height", 1.0, 0.01, (0, 0.01, 0.01))
    assert evidence_text(advice, "") == "Width and height, measured to 1 %"
