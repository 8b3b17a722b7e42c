"""ShapeNet's two layouts, recognised per model and listed on access."""

from __future__ import annotations

import pytest

from cadalign.datasets import SYNSETS, ShapeNet
from cadalign.datasets.shapenet import require_category
from cadalign.errors import DataError, InputError

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


@pytest.fixture
def root(tmp_path):
    """Two chairs, one in each layout, an empty folder, a mug, and an unknown synset."""
    for path in (
        "03001627/b/models/model_normalized.obj",
        "03001627/a/model.obj",
        "03797390/m/model.obj",
        "99999999/x/model.obj",
        "notes/y/model.obj",
    ):
        file = tmp_path / path
        file.parent.mkdir(parents=True)
        file.write_text(TRIANGLE)
    (tmp_path / "03001627" / "empty").mkdir()
    (tmp_path / "taxonomy.json").write_text("[]")
    return tmp_path


def test_both_layouts_are_found(root):
    shapenet = ShapeNet(root)
    assert shapenet.categories == ("99999999", "chair", "mug")
    assert shapenet["chair", "a"].mesh_path == root / "03001627/a/model.obj"
    version_2 = root / "03001627/b/models/model_normalized.obj"
    assert shapenet["03001627", "b"].mesh_path == version_2
    assert [model.model_id for model in shapenet["chair"]] == ["a", "b"]
    assert shapenet["chair", "b"] == shapenet["chair"][1]
    assert len(shapenet) == len(list(shapenet)) == 4


def test_version_2_comes_first_where_a_model_has_both(root):
    (root / "03001627/b/model.obj").write_text(TRIANGLE)
    assert ShapeNet(root)["chair", "b"].mesh_path.name == "model_normalized.obj"


def test_meshes_are_read_only_when_asked_for(root):
    (root / "03001627/a/model.obj").write_text("damaged")
    models = ShapeNet(root)["chair"]
    assert len(models[1].load_mesh().faces) == 1
    with pytest.raises(DataError, match=r"model\.obj"):
        models[0].load_mesh()


def test_missing_models_and_folders_are_named(root):
    shapenet = ShapeNet(root)
    with pytest.raises(InputError, match=r"unknown category 'chiar', did you mean 'chair'.*mug"):
        shapenet["chiar"]
    with pytest.raises(InputError, match="no model 'z' of 'chair'"):
        shapenet["chair", "z"]
    with pytest.raises(InputError, match="no model 'empty' of 'chair'"):
        shapenet["chair", "empty"]
    with pytest.raises(DataError, match="no such folder"):
        ShapeNet(root / "gone")


def test_synset_table_is_consistent():
    assert len(SYNSETS) == len(set(SYNSETS.values())) == 55
    assert all(synset.isdigit() and len(synset) == 8 for synset in SYNSETS.values())
    assert SYNSETS["vessel"] == "04530566"


def test_a_category_is_known_by_its_name_and_by_its_synset():
    for name in ("chair", "03001627"):
        assert require_category(name, ["chair", "mug"], where="root") == "chair"
    with pytest.raises(InputError, match="root: unknown category 'chiar', did you mean 'chair'"):
        require_category("chiar", ["chair"], where="root")
