"""Documents and the site: their commands, links and examples; `make docs` builds the site."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cadalign import Result
from cadalign.cli import main
from cadalign.datasets import ModelKeypoints

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
sys.path.insert(0, str(DOCS))
PAGES = [*sorted(ROOT.glob("*.md")), *sorted(DOCS.rglob("*.md"))]
MADE = ("_build",)


def pages() -> list[Path]:
    return [page for page in PAGES if not set(page.relative_to(ROOT).parts) & set(MADE)]


def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(
        rf"```{language}\n(.*?)```", page.read_text(encoding="utf-8"), flags=re.DOTALL
    )


def named(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


@pytest.mark.parametrize("page", pages(), ids=named)
def test_named_commands_exist(page: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = "\n".join(blocks(page, "sh"))
    for command in sorted(set(re.findall(r"^cadalign ([a-z]+)", lines, flags=re.MULTILINE))):
        with pytest.raises(SystemExit) as stop:
            main([command, "--help"])
        assert stop.value.code == 0, command
        assert command in capsys.readouterr().out


@pytest.mark.parametrize("page", pages(), ids=named)
def test_links_and_anchors_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\((?!https?:)([^)\s]*)\)", text_of(page)):
        path, _, anchor = target.partition("#")
        if path.startswith("../schemas/"):
            continue  # written when the site is built
        linked = page if not path else (page.parent / path)
        assert linked.exists() or linked.with_suffix(".md").exists(), target
        if anchor:
            titles = re.findall(r"^#+ (.+)$", text_of(linked), flags=re.MULTILINE)
            assert anchor in {re.sub(r"[^\w\- ]", "", t.lower()).replace(" ", "-") for t in titles}


def example(name: str) -> Any:
    page = "files" if name == "model_keypoints" else name
    return json.loads(blocks(DOCS / "formats" / f"{page}.md", "json")[0])


def test_example_of_an_observation_is_fitted(tmp_path: Path) -> None:
    """Without its files: an object 1.3 times as high and 0.8 times as deep as its model."""
    source, fields = tmp_path / "chair.json", example("observation")
    for name in ("image", "model"):
        del fields[name]
    source.write_text(json.dumps(fields), encoding="utf-8")
    assert main(["fit", str(source)]) == 0
    result = Result.load(tmp_path / "chair_fit" / "fit.json")
    assert [each.kind for each in result.evidence] == ["keypoints", "gravity", "size"]
    assert max(each.rms_sigmas for each in result.evidence) < 2
    assert result.rms < 2
    ratios = result.stretch[1:] / result.stretch[0]
    np.testing.assert_allclose(ratios, [1.3, 0.8], rtol=0.06)
    assert result.warnings == ()
    assert result.uncertain == ()


def test_example_of_model_keypoints_is_read(tmp_path: Path) -> None:
    path = tmp_path / "chair.keypoints.json"
    model = example("model_keypoints")
    model["keypoints"] = model["keypoints"][:1]  # the other one needs the mesh
    path.write_text(json.dumps(model), encoding="utf-8")
    assert ModelKeypoints.load(path).names == ("seat, front left",)


@pytest.mark.parametrize("name", ["observation", "model_keypoints"])
def test_examples_of_formats_are_those_of_their_schemas(name: str) -> None:
    jsonschema, directives = (pytest.importorskip(each) for each in ("jsonschema", "directives"))
    jsonschema.validate(example(name), json.loads(directives.schema(name)))


def test_scores_of_a_detector_become_standard_deviations() -> None:
    """The recipe of the how-to on detectors."""
    (recipe,) = [b for b in blocks(DOCS / "how_to" / "detectors.md", "python") if "def cal" in b]
    names: dict[str, Any] = {"np": np}
    exec(compile(recipe, "detectors.md", "exec"), names)
    rng = np.random.default_rng(1)
    true = [rng.uniform(0, size, (10, 2)) for size in rng.uniform(50, 500, 400)]
    scores = rng.uniform(0, 1, (400, 10))
    for outliers, tolerance in ((0.0, 0.06), (0.1, 0.2)):  # outliers enlarge the box
        found = []
        for points, score in zip(true, scores, strict=True):
            size = np.ptp(points, axis=0).max()
            errors = rng.normal(size=(10, 2)) * (size * 0.06 * 0.25**score)[:, None]
            is_outlier = rng.uniform(size=10) < outliers
            errors[is_outlier] = rng.uniform(-0.8 * size, 0.8 * size, (is_outlier.sum(), 2))
            found.append(points + errors)
        line, share = names["calibrate"](found, true, scores)
        assert share == pytest.approx(outliers, abs=0.03)
        size = np.ptp(found[0], axis=0).max()
        expected = size * 0.06 * 0.25 ** scores[0]
        assert names["sigma_of"](found[0], scores[0], line) == pytest.approx(
            expected, rel=tolerance
        )
