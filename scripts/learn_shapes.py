"""Learn the shapes that come with the package from KeypointNet's annotations.

    python scripts/learn_shapes.py path/to/keypointnet

The same annotations give the same files on the same platform. `keypoint_names.toml` has the names.
"""

from __future__ import annotations

import tomllib
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from cadalign import Example, ShapeModel
from cadalign.datasets import KeypointNet
from cadalign.io.pretrained import CATEGORIES, pretrained_path
from cadalign.shapes.examples import examples_of, find_other_axes, stack_keypoints

_LEAST_SHARE = 0.01  # of the models that have a keypoint; fewer are slips of annotators
NAMES = Path(__file__).with_name("keypoint_names.toml")
SHAPES = pretrained_path("chair").parent


def learn(
    examples: Sequence[Example], category: str, table: dict[str, list[str]], **options: Any
) -> ShapeModel:
    """Learn a category's shape; models with other axes and rare keypoints are left out."""
    kept = list(examples)
    while turned := find_other_axes(stack_keypoints(kept)[1]):
        kept = [each for row, each in enumerate(kept) if row not in turned]
    count = Counter(label for each in kept for label in each.ids)
    known = {label for label, n in count.items() if n >= _LEAST_SHARE * len(kept)}
    model = ShapeModel.learn(
        [_select(each, known) for each in kept],
        category=category,
        up_axis="y",
        unit="diagonal",
        **options,
    )
    chains = [model.rows([int(each) for each in chain.split("-")]) for chain in table["lines"]]
    names = table["names"]
    if {row for row, name in enumerate(names) if name} != set(model.ids):
        raise SystemExit(f"{category}: the names are not those of the keypoints {model.ids}")
    return replace(
        model,
        names=tuple(names[int(label)] for label in model.ids),
        lines=tuple(pair for chain in chains for pair in pairwise(chain)),
        training=None,
        components=tuple(
            replace(each, mean=_single(each.mean), modes=_single(each.modes))
            for each in model.components
        ),
    )


def main(root: Annotated[Path, tyro.conf.Positional], out: Path = SHAPES) -> None:
    """Learn and write all shapes."""
    dataset, tables = KeypointNet(root), tomllib.loads(NAMES.read_text(encoding="utf-8"))
    for category in CATEGORIES:
        examples = examples_of(dataset[category], meshes=False)
        model = learn(examples, category, tables[category])
        path = out / f"{category}.shape"
        model.save(path)
        print(f"{model}: {path.stat().st_size / 1000:.0f} kB")


def _select(example: Example, known: set[Any]) -> Example:
    rows = [row for row, label in enumerate(example.ids) if label in known]
    ids = [example.ids[row] for row in rows]
    return replace(example, ids=ids, points_3d=example.points_3d[rows])


def _single(values: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Round to single precision, which halves the files."""
    return values.astype(np.float32).astype(np.float64)


if __name__ == "__main__":
    tyro.cli(main)
