"""Make the README's picture: overlays of four sample models, side by side."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import tyro
from common import write_row

from cadalign import Box, fit
from cadalign.datasets import KeypointNet, write_sample_dataset
from cadalign.evaluation.instances.instance import load_scene, make_instance
from cadalign.render import RaycastRenderer, draw_overlay

MODELS = (("chair", "000"), ("car", "002"), ("bottle", "002"), ("vessel", "003"))


def main(*, out: Path = Path("docs/overview.png"), width: int = 1600) -> None:
    """Make the README's picture.

    Parameters
    ----------
    out : Path
        Where to write the picture.
    width : int
        Width in pixels.
    """
    with tempfile.TemporaryDirectory() as folder:
        dataset = KeypointNet(write_sample_dataset(Path(folder) / "sample"))
        pictures = [_overlay(dataset, *model) for model in MODELS]
    write_row(out, pictures, width=width)


def _overlay(dataset: KeypointNet, category: str, number: str) -> np.ndarray:
    model = dataset[category, f"sample_{category}_{number}"]
    instance = make_instance(
        model, noise_px=1.0, min_visible=6, seed=0, view_index=0, scene=load_scene(model)
    )
    result = fit(instance.points_3d, instance.points_2d, instance.camera)
    frame = RaycastRenderer().render(instance.scene, instance.camera, instance.cam_from_model)
    return draw_overlay(
        frame.composite(),
        instance.camera,
        gt_box=Box.from_model(instance.bounds, instance.gt),
        est_box=Box.from_model(instance.bounds, result.alignment),
        observed=instance.points_2d,
        reprojected=instance.camera.project(result.alignment.apply(instance.points_3d)),
        legend=category == "chair",
    )


if __name__ == "__main__":
    tyro.cli(main)
