"""`cadalign retrieve` of many observations: a run whose table holds the best matches."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from support.pages import embedded_payload

import cadalign
from cadalign import Camera, Library, Observation, Result, Results
from cadalign.batch.retrievals import RetrieveRunOptions
from cadalign.cli import main
from cadalign.datasets import KeypointNet, write_sample_dataset
from cadalign.render import look_at

CAMERA = Camera(640, 480, 935.0, 935.0, 319.5, 239.5)


@dataclass(frozen=True)
class Case:
    """A library of three chairs and three bottles, and JSON lines of stretched ones."""

    folder: Path
    library: Library
    keys: list[tuple[str, str]]

    @property
    def queries(self) -> Path:
        return self.folder / "queries.jsonl"

    @property
    def arguments(self) -> list[str]:
        return [str(self.queries), "--library", str(self.folder / "lib.cadalign")]


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Case:
    folder = tmp_path_factory.mktemp("queries")
    root = write_sample_dataset(folder / "sample", per_category=3, categories=["chair", "bottle"])
    library = Library.from_models(KeypointNet(root))
    library.save(folder / "lib.cadalign")
    rng, texts, keys = np.random.default_rng(0), [], []
    for model in (list(library) * 4)[:20]:
        stretch = (1.0, *np.exp(rng.uniform(-0.2, 0.2, 2)).tolist())
        pose = look_at(azimuth=rng.uniform(0, 360), elevation=20.0, distance=2.6, scale=stretch)
        seen = CAMERA.project(pose.apply(model.xyz)) + rng.normal(0, 0.5, (len(model.xyz), 2))
        query = Observation(np.zeros_like(model.xyz), seen, CAMERA, None, model.ids)
        texts.append(json.dumps(query.to_dict()))
        keys.append(model.key)
    (folder / "queries.jsonl").write_text("\n".join(texts) + "\n")
    return Case(folder, library, keys)


def rows_of(run: Path) -> list[dict[str, Any]]:
    return pq.read_table(run / "results.parquet").to_pylist()


def test_the_table_holds_the_best_match_of_each(
    case: Case, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    assert main(["retrieve", *case.arguments, "--top", "4", "--out", str(run)]) == 0
    said = capsys.readouterr().err
    assert f"20 of 20 retrieved, 0 failed: {run / 'results.csv'}" in said
    rows = rows_of(run)
    found = [(row["match_category"], row["match_id"]) for row in rows]
    assert sum(a == b for a, b in zip(found, case.keys, strict=True)) >= 18
    with (run / "results.csv").open() as file:
        texts = list(csv.DictReader(file))
    assert [row["match_id"] for row in texts] == [model_id for _, model_id in found]
    texts_of = case.queries.read_text().splitlines()
    for line, row, single in zip(texts_of, rows, Results.open(run), strict=True):
        seen = json.loads(line)["keypoints"]
        expected = case.library.retrieve(
            [each["uv"] for each in seen], [each["semantic_id"] for each in seen], CAMERA, top=4
        )
        listed = [each.split() for each in row["matches"].split("; ")]
        assert [tuple(each[:2]) for each in listed] == [
            (match.category, match.model_id) for match in expected
        ]
        scores = [float(each[2]) for each in listed]
        np.testing.assert_allclose(scores, [match.score for match in expected], rtol=1e-3)
        assert isinstance(single, Result)
        np.testing.assert_allclose(
            single.alignment.vector, expected[0].alignment.vector, rtol=1e-12
        )
    page = embedded_payload(run / "report.html")
    assert page["title"] == "Retrieved models"
    (line,) = page["headline"]["rows"]  # no section for each category or model
    assert (line["category"], line["cells"]["instances"]) == ("all", 20)
    assert "none_probability" in line["cells"]


def test_a_query_that_fails_is_a_row(
    case: Case, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good = case.queries.read_text().splitlines()[0]
    data = json.loads(good)
    bare = [{"uv": each["uv"]} for each in data["keypoints"]]
    strange = [{**each, "semantic_id": 900 + k} for k, each in enumerate(data["keypoints"])]
    lines = [
        good,
        json.dumps({**data, "keypoints": bare}),
        json.dumps({**data, "keypoints": strange}),
        json.dumps({**data, "camera": {"width": 640, "height": 480}}),
        "{",
    ]
    path = tmp_path / "q.jsonl"
    path.write_text("\n".join(lines) + "\n")
    run = tmp_path / "run"
    assert main(["retrieve", str(path), *case.arguments[1:], "--out", str(run)]) == 3
    rows = rows_of(run)
    assert [row["status"] for row in rows] == ["ok", *["failed"] * 4]
    for row, text in zip(
        rows[1:],
        ("no semantic_id", "semantic id 900", "the focal length is unknown", "not valid JSON"),
        strict=True,
    ):
        assert text in row["reason"]
    assert "1 of 5 retrieved, 4 failed" in capsys.readouterr().err


def test_a_match_is_a_result(case: Case, tmp_path: Path) -> None:
    model = case.library["chair", "sample_chair_001"]
    pose = look_at(azimuth=40.0, elevation=20.0, distance=2.6, scale=(1.0, 1.2, 0.9))
    ids = model.ids[::-1]
    seen = Observation(
        np.zeros_like(model.xyz),
        CAMERA.project(pose.apply(model.xyz))[::-1],
        CAMERA,
        ids=ids,
        names=tuple(f"k{each}" for each in ids),
    )
    match = case.library.retrieve(seen.points_2d, ids, CAMERA)[0]
    result = match.result
    assert (result.method, result.rms) == ("retrieve", pytest.approx(match.rms))
    np.testing.assert_array_equal(result.box.corners, match.box.corners)
    again = Result.from_dict(result.to_dict())
    np.testing.assert_array_equal(again.alignment.vector, match.alignment.vector)
    paired = match.observation(seen)
    assert paired.model == match.mesh_path
    assert paired.names == seen.names
    fitted = cadalign.fit(paired.points_3d, paired.points_2d, CAMERA)
    np.testing.assert_allclose(fitted.alignment.scale, pose.scale, atol=1e-3)
    written = result.export(tmp_path / "chair.glb", mesh=match.mesh())
    assert written.stat().st_size > 1000
    assert result.plot(mesh=match.mesh()).get_ylim() == (479.5, -0.5)


def test_the_columns_are_documented() -> None:
    page = Path(__file__).parents[2] / "docs" / "how_to" / "many_photos.md"
    text = page.read_text(encoding="utf-8")
    assert [name for name, _ in RetrieveRunOptions.columns if f"`{name}`" not in text] == []
