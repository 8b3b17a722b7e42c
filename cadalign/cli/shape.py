"""`cadalign shape`: learn and inspect shape models."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from cadalign.cli.common import answer, create_parent, group_of, say, show_status
from cadalign.cli.options import name_flags
from cadalign.datasets import KeypointNet
from cadalign.io.files import protect_inputs, refuse_input
from cadalign.io.pretrained import CATEGORIES

if TYPE_CHECKING:
    from cadalign.shapes.model import ShapeModel

_MODES = 5  # that `show` describes by their share of the variance


@dataclass(frozen=True)
class ShapeLearn:
    """Learn the shape model of a category from a data set's annotated models."""

    root: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="ROOT")]
    """Folder of a data set in KeypointNet's layout."""
    category: str
    """Category to learn, such as chair."""
    out: Path | None = None
    """Shape file to write; by default <category>.shape."""
    split: str | None = None
    """Split of the data set to learn from, such as train; all models by default."""
    shapenet: Path | None = None
    """ShapeNetCore folder with the meshes, if they are not inside ROOT."""
    components: int | None = None
    """Number of Gaussian components; by default chosen by the likelihood of held-out models."""

    def run(self) -> int:
        """Learn the model; returns the exit code."""
        dataset = KeypointNet(self.root, shapenet_root=self.shapenet)
        with protect_inputs(dataset.files), name_flags(self):
            if self.out is not None:
                refuse_input(self.out)
                create_parent(self.out)
            return self._learn(dataset)

    def _learn(self, dataset: KeypointNet) -> int:
        from cadalign.shapes.model import ShapeModel  # takes time to import

        with show_status(f"learning {self.category}"):
            model = ShapeModel.from_dataset(
                dataset, self.category, split=self.split, components=self.components
            )
        out = Path(f"{model.category}.shape") if self.out is None else self.out
        model.save(out)
        say(f"{_text(model)}\nWritten: {out} ({out.stat().st_size / 1e6:.1f} MB)")
        return 0


@dataclass(frozen=True)
class ShapeShow:
    """Describe the shape model of a file."""

    shape: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SHAPE")]
    """Category of a shape that comes with cadalign, such as chair, or shape file."""

    def run(self) -> int:
        """Open the model and describe it; returns the exit code."""
        from cadalign.shapes.model import ShapeModel

        answer(_text(ShapeModel.open(self.shape)))
        return 0


def _text(model: ShapeModel) -> str:
    training = model.training
    models = "" if training is None else f", learned from {len(training)} models"
    lines = [
        f"{model.category}: {len(model.ids)} keypoints{models}; lengths in {model.unit}",
        f"  up axis      {model.up_axis or 'unknown'}",
    ]
    for number, each in enumerate(model.components, start=1):
        held = 100 * each.variance[:_MODES].sum() / max(np.trace(each.covariance), 1e-300)
        sigma = np.sqrt(np.diag(each.covariance).mean())
        lines.append(
            f"  component {number}  {100 * each.weight:.0f} %, {len(each.modes)} modes, of which "
            f"the first {_MODES} hold {held:.0f} % of the variance; standard deviation of a "
            f"coordinate {sigma:.3g}, {each.residual_sigma:.2g} beyond the modes"
        )
    pairs = zip(model.ids, model.names, strict=False)
    return "\n".join([*lines, *(f"  keypoint {label!s:>3}  {name}" for label, name in pairs)])


@dataclass(frozen=True)
class ShapeList:
    """List the categories whose shapes come with cadalign."""

    def run(self) -> int:
        """Print a line for each category; returns the exit code."""
        from cadalign.shapes.model import ShapeModel

        for name in CATEGORIES:
            answer(f"{name:<12}{len(ShapeModel.pretrained(name).ids):>3} keypoints")
        return 0


ShapeCommand = group_of(
    "Learn, list and inspect shape models of categories.",
    {"learn": ShapeLearn, "list": ShapeList, "show": ShapeShow},
)
