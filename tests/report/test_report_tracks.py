"""Pages of tracks."""

from __future__ import annotations

from pathlib import Path

from support.pages import embedded_payload

from cadalign.report.track_page import write_track_page


def test_what_a_track_was_over_time_is_drawn_on_plain_axes(tmp_path: Path) -> None:
    file, failures = tmp_path / "index.html", {"3": "4 keypoints are too few"}
    write_track_page(file, [], title="cars", summary="", settings={}, failures=failures)
    payload = embedded_payload(file)
    assert not any(plot[axis]["log"] for plot in payload["plots"] for axis in ("x", "y"))
    assert {"place_ahead", "rotation_std_deg"} <= {plot["id"] for plot in payload["plots"]}
    (failure,) = payload["headline"]["failures"]
    assert failure["reason"] == "4 keypoints are too few"
