"""`cadalign.evaluate`: all experiments of the command line, with the same options."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support.photo_sets import write_pix3d

import cadalign
from cadalign import Mesh
from cadalign.datasets import KeypointNet
from cadalign.errors import DataError, InputError
from cadalign.evaluation.api import prepare
from cadalign.evaluation.instances.instance import make_instance
from cadalign.evaluation.metrics.errors import alignment_errors
from cadalign.evaluation.options import as_tuples
from cadalign.evaluation.registry import known_options, spec_named
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.render import Scene


def evaluate(*arguments: Any, **options: Any) -> Any:
    return cadalign.evaluate(*arguments, workers=0, **options)


def test_every_experiment_has_a_specification_with_its_name() -> None:
    names = [options.experiment for options in known_options()]
    assert names == [
        "keypointnet",
        "demo",
        "simulate",
        "correspondences",
        "retrieval",
        "unseen",
        "photos",
    ]
    for options in known_options():
        spec = spec_named(options.experiment)
        assert spec.options is options
        assert len({column.key for column in spec.columns}) == len(spec.columns)


@pytest.mark.long
@pytest.mark.parametrize(
    ("experiment", "options"),
    [
        ("keypointnet", {"methods": ("optimal",)}),
        ("unseen", {"methods": ("shape",)}),
        ("photos", {"methods": ("rigid",)}),
    ],
)
def test_workers_of_a_cluster_may_have_been_started_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, experiment: str, options: dict[str, Any]
) -> None:
    if experiment == "photos":
        write_pix3d(tmp_path / "data", photos=2)
    else:
        cadalign.datasets.write_sample_dataset(tmp_path / "data", per_category=12)
        options |= {"categories": ("car",), "max_models": 1}
    monkeypatch.chdir(tmp_path)
    chosen = spec_named(experiment).options(Path("data"), **options)
    plan, _ = prepare(chosen, RunFolder(Path("run")), workers=None, dask="tcp://nowhere:8786")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    rows = plan.experiment.evaluate(plan.tasks[:1])
    assert [row["status"] for row in rows] == ["ok"]
    assert plan.config["root"] == str(tmp_path / "data")


def test_what_is_wrong_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="unknown experiment 'brewing'; known are keypointnet"):
        evaluate(tmp_path, "brewing")
    with pytest.raises(DataError, match="no such folder"):
        evaluate(tmp_path / "none", "correspondences")
    with pytest.raises(InputError, match="unknown option of keypointnet 'nois_px', did you mean"):
        evaluate(tmp_path, nois_px=1.0)
    with pytest.raises(InputError, match="root: is missing; keypointnet needs it"):
        evaluate(None)
    with pytest.raises(InputError, match="sweep: is missing"):
        evaluate(experiment="simulate")


def test_lists_of_options_become_tuples() -> None:
    given = {"a": [1, 2], "b": range(2), "c": "ab", "d": Path("x"), "e": None, "f": 1.5, "g": len}
    kept = {name: given[name] for name in "cdefg"}
    assert as_tuples(given) == {"a": (1, 2), "b": (0, 1), **kept}


def test_translation_errors_are_in_diagonals_of_the_model(sample_root: Path) -> None:
    dataset = KeypointNet(sample_root)
    model = dataset[dataset.ids("chair")[0]]
    mesh = model.load_mesh()
    large = replace(model, keypoints=replace(model.keypoints, xyz=3 * model.keypoints.xyz))
    found = []
    for size, some in ((1.0, model), (3.0, large)):
        scene = Scene(Mesh(size * mesh.vertices, mesh.faces))
        instance = make_instance(
            some, scene=scene, noise_px=0.5, min_visible=6, seed=0, view_index=0
        )
        # The diagonal of the original model, not of the stretched one.
        assert instance.diagonal == pytest.approx(size, rel=1e-6)
        fitted = cadalign.fit(instance.points_3d, instance.points_2d, instance.camera)
        errors = alignment_errors(est=fitted.alignment, gt=instance.gt, length=instance.diagonal)
        found.append(errors["translation_error"])
    assert found[0] == pytest.approx(found[1], rel=1e-4)
