"""What the page is told of a photo: quick checks of one session."""

from __future__ import annotations

import numpy as np
import pytest
from support.annotating import Case, place_all
from support.refusals import refusal_text

from cadalign import Alignment
from cadalign.annotate.page_state import page_state


def test_the_page_places_the_displayed_model_where_the_alignment_has_it(case: Case) -> None:
    """And photos that are not there are refused, while the first is shown."""
    session = case.open()
    shown = page_state(session, 0)
    assert shown["alignment"]["status"] == "none"
    assert refusal_text(lambda: page_state(session, 1)) == "image: there is no photo 2"
    assert refusal_text(lambda: page_state(session, -1)) == "image: there is no photo 0"
    told = place_all(session, case)["alignment"]
    alignment = Alignment.from_dict(told["alignment"])
    assert np.ptp(alignment.scale) > 1e-4
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    placed = np.array(told["camera_from_page"]).reshape(4, 4)
    displayed = session.model.cad.to_display(points)
    in_camera = displayed @ placed[:3, :3].T + placed[:3, 3]
    assert in_camera == pytest.approx(alignment.apply(points), abs=1e-6)
    eye = placed[:3, :3] @ told["eye"] + placed[:3, 3]  # the camera's own place
    assert eye == pytest.approx(np.zeros(3), abs=1e-6)
