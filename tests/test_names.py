"""Earlier names of arguments, attributes and fields of files."""

import json
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.problems import problem_of

import cadalign
from cadalign.cli import main
from cadalign.datasets import ImageKeypoints
from cadalign.errors import DataError, InputError
from cadalign.io.observation import Observation
from cadalign.names import renamed

PROBLEM = problem_of(1, points=10)
SCORES = np.linspace(0.1, 0.9, 10)
GIVEN: dict[str, Any] = {
    "ransac": cadalign.RansacOptions(max_reproj_error=5.0),
    "sigma": 1.0,
}


def test_an_argument_of_an_earlier_name_counts_with_a_note() -> None:
    points = PROBLEM.points_3d, PROBLEM.points_2d, PROBLEM.camera
    with pytest.warns(
        DeprecationWarning, match=r"^fit\(confidences=\) is now called scores="
    ) as notes:
        earlier = cadalign.fit(*points, confidences=SCORES, **GIVEN)  # type: ignore[call-arg]
    assert notes[0].filename == __file__
    present = cadalign.fit(*points, scores=SCORES, **GIVEN)
    np.testing.assert_array_equal(earlier.covariance, present.covariance)


def test_an_attribute_of_an_earlier_name_is_read_with_a_note() -> None:
    with pytest.warns(DeprecationWarning, match=r"^ImageKeypoints\(semantic_ids=\) is now"):
        seen: Any = ImageKeypoints(PROBLEM.points_2d, semantic_ids=tuple(range(10)))  # type: ignore[call-arg]
    with pytest.warns(DeprecationWarning, match=r"^ImageKeypoints\.semantic_ids is now called ids"):
        assert seen.semantic_ids == seen.ids == tuple(range(10))
    assert replace(seen, ids=None).ids is None
    assert pickle.loads(pickle.dumps(seen)).ids == seen.ids


def test_a_present_name_beside_its_earlier_one_is_refused() -> None:
    @renamed(confidences="scores")
    def best(*, scores: list[float]) -> float:
        return max(scores)

    with pytest.raises(InputError, match=r"^confidences: given beside scores, its present name$"):
        best(scores=[1.0], confidences=[1.0])  # type: ignore[call-arg]
    assert best(scores=[1.0, 2.0]) == 2.0


def test_a_file_of_an_earlier_field_is_read(tmp_path: Path) -> None:
    path = tmp_path / "seen.json"
    rows = zip(PROBLEM.points_3d.tolist(), PROBLEM.points_2d.tolist(), SCORES, strict=True)
    keypoints = [{"xyz": xyz, "uv": uv, "confidence": score} for xyz, uv, score in rows]
    data = {"camera": PROBLEM.camera.to_dict(), "keypoints": keypoints}
    path.write_text(json.dumps(data))
    read = Observation.load(path)
    np.testing.assert_array_equal(read.scores, SCORES)
    read.save(path)
    assert [each["score"] for each in json.loads(path.read_text())["keypoints"]] == list(SCORES)
    keypoints[0]["score"] = 0.5
    path.write_text(json.dumps(data))
    with pytest.raises(DataError, match="confidence: given beside score"):
        Observation.load(path)


def test_a_stored_option_and_a_flag_of_earlier_names_count(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "seen.json"
    rows = zip(PROBLEM.points_3d.tolist(), PROBLEM.points_2d.tolist(), strict=True)
    data = {
        "camera": PROBLEM.camera.to_dict(),
        "keypoints": [{"xyz": xyz, "uv": uv} for xyz, uv in rows],
        "fit": {"scale_prior_sigma": 0.3},
    }
    path.write_text(json.dumps(data))
    assert Observation.load(path).fit_options == {"stretch_sigma": 0.3}
    command = ["fit", str(path), "--json", "--no-picture", "--out", str(tmp_path / "out")]
    assert main([*command, "--scale-prior-sigma", "0.2"]) == 0
    given = capsys.readouterr()
    assert json.loads(given.out)["options"]["stretch_sigma"] == 0.2
    assert given.err.startswith("cadalign: --scale-prior-sigma is now called --stretch-sigma\n")
    data["fit"] = {"scale_prior_sigma": 0.3, "stretch_sigma": 0.3}
    path.write_text(json.dumps(data))
    with pytest.raises(DataError, match=r"scale_prior_sigma: given beside stretch_sigma"):
        Observation.load(path)


def test_a_result_of_an_earlier_version_is_read() -> None:
    result = cadalign.fit(PROBLEM.points_3d, PROBLEM.points_2d, PROBLEM.camera, stretch_sigma=0.3)
    data = result.to_dict()
    data["options"]["scale_prior_sigma"] = data["options"].pop("stretch_sigma")
    again = cadalign.Result.from_dict(data)
    assert again.options is not None
    assert again.options.stretch_sigma == 0.3
