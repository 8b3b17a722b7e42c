"""Train a keypoint network on rendered views, fine-tune it through the alignment, and compare.

    python scripts/train_detector.py                    # the whole table
    python scripts/train_detector.py --steps 100 --tuning 30 --views 200

One network is trained by heat maps alone, then goes on in five ways: by heat maps; through a fit of
the mean shape, rigid, with stretch, and through the alignment of the learned shape; and by the
Monte-Carlo loss over the posterior. All are judged on renders of models that they have not seen, by
`cadalign.align` with the learned shape and sigmas from the spread of the heat maps. Writes
detector/table.json, the keypoints of some images in the folder seen and car.shape, which
`cadalign fit` takes, network.pt, and confusion.png: which keypoints the last network takes
for others.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from rich.console import Console
from rich.table import Table

import cadalign
from cadalign.arrays import FloatArray, IntArray
from cadalign.datasets import sample_models
from cadalign.geometry.rotations import angle_between
from cadalign.io.files import write_json
from cadalign.metrics import box_iou_up_to_scale
from cadalign.torch import PoseBatch, align, fit, posterior_loss, rotation_loss
from cadalign.torch.detector import (
    KeypointDetector,
    LossOfKeypoints,
    RenderedViews,
    learned_shape,
    render_views,
    train,
)

_RATE = 5e-4  # of fine-tuning
_REPROJECTION = 0.02  # weight of a pixel beside a unit of the rotation's loss
_POSTERIOR = 0.02  # weight of the Monte-Carlo loss beside the heat maps' loss
_POSE = 0.5  # weight of the other losses of poses
_MOST = 4.0  # beyond which the loss of one view does not pull any more
_FLIPPED = 90.0  # [degrees]


@dataclass
class TrainOptions:
    """Size and effort of the training."""

    category: str = "car"
    """Category of the sample data."""
    models: int = 80
    """Models; a quarter of them is held out."""
    views: int = 1200
    """Rendered views of the models to train with."""
    held_out: int = 200
    """Rendered views of the held-out models."""
    size: int = 64
    """Width and height of the images [px]."""
    steps: int = 500
    """Steps of the first training, by heat maps."""
    tuning: int = 120
    """Steps of each fine-tuning."""
    batch: int = 24
    """Views of a step."""
    seed: int = 0
    """Seed of views, network and batches."""
    threads: int = 2
    """Threads of PyTorch."""
    out: Path = Path("detector")
    """Folder for the table and what `cadalign fit` takes."""


def pose_losses(
    views: RenderedViews, shape: cadalign.ShapeModel
) -> dict[str, LossOfKeypoints | None]:
    """Losses of keypoints and sigmas by the way of fine-tuning."""
    mean = torch.as_tensor(np.array(shape.components[0].mean[: len(views.ids)]))
    points = torch.as_tensor(views.points_3d)
    truth = PoseBatch(
        torch.as_tensor(views.rotation),
        torch.as_tensor(views.translation),
        torch.ones(len(views), 3, dtype=torch.float64),
    )
    stretched = stretched_mean(truth.apply(points), truth.rotation, mean)

    def rows_of(poses: PoseBatch, rows: Any) -> PoseBatch:
        return PoseBatch(poses.rotation[rows], poses.translation[rows], poses.scale[rows])

    def through(estimate: Callable[..., PoseBatch], model: Any, **options: Any) -> LossOfKeypoints:
        def loss(pixels: Any, sigma: Any, rows: Any) -> Any:
            given = model, pixels.double(), views.camera
            found = estimate(*given, sigma=sigma.double(), **options)
            true = rows_of(truth, rows)
            shown = mean if found.points_3d is None else found.points_3d
            apart = found.project(shown, views.camera) - true.project(points[rows], views.camera)
            error = rotation_loss(found, true) + _REPROJECTION * torch.where(
                found.valid, apart.abs().mean(dim=(1, 2)), 0.0
            )
            return (_MOST * torch.tanh(error / _MOST)).float()

        return loss

    def posterior(pixels: Any, sigma: Any, rows: Any) -> Any:
        pixels, sigma = pixels.double(), sigma.double()
        found = fit(mean, pixels.detach(), views.camera, sigma=sigma.detach())
        given = found, rows_of(stretched, rows), mean, pixels, views.camera
        value = posterior_loss(*given, sigma=sigma, loss="huber", loss_scale=3.0)
        return torch.clamp(value, max=200.0).float()

    return {
        "heat maps": None,
        "PnP, rigid mean": through(fit, mean, stretch="none"),
        "PnP, stretched mean": through(fit, mean),
        "learned shape": through(align, shape),
        "Monte-Carlo": posterior,
    }


def stretched_mean(in_camera: Any, rotation: Any, mean: Any) -> PoseBatch:
    """Alignments of the mean's keypoints nearest to objects, of which x is the mean's."""
    center = mean.mean(dim=0)
    own = in_camera - in_camera.mean(dim=1, keepdim=True)
    turned = own @ rotation  # in the model's frame
    scale = (turned * (mean - center)).sum(dim=1) / ((mean - center) ** 2).sum(dim=0)
    shift = in_camera.mean(dim=1) - (rotation @ (scale * center)[..., None])[..., 0]
    size = scale[:, :1]
    return PoseBatch(rotation, shift / size, scale / size)


def judged(
    detector: KeypointDetector,
    views: RenderedViews,
    shape: cadalign.ShapeModel,
    mirrored: IntArray,
) -> dict[str, float]:
    """Errors on views: keypoints, rotation, box, flips of the object, coverage of the sigmas."""
    pixels, sigma = detector.predict(views)
    nearest = nearest_keypoints(pixels, views.points_2d)
    lengths = np.linalg.norm(pixels - views.points_2d, axis=2)
    turns, ious = [], []
    for b in range(len(views)):
        view = cadalign.View(views.camera, pixels[b], ids=views.ids, sigma=sigma[b])
        result = cadalign.align(shape, view)
        turns.append(angle_between(result.alignment.rotation, views.rotation[b]))
        ious.append(box_iou_up_to_scale(est=result.box, gt=views.box(b)))
    return {
        "keypoints, px": float(np.median(lengths)),
        "within 2.45 sigma, %": 100 * float((lengths < 2.4477 * sigma).mean()),
        "left as right, %": 100 * float((nearest == mirrored).mean()),
        "rotation, deg": float(np.median(turns)),
        "90 %": float(np.percentile(turns, 90)),
        "flipped, %": 100 * float(np.mean(np.array(turns) > _FLIPPED)),
        "box IoU": float(np.median(ious)),
    }


def mirror_images(mean: FloatArray) -> IntArray:
    """Numbers (k,) of keypoints (k, 3) on the other side; -1 of those amid the object."""
    gaps = np.linalg.norm(mean[:, None] * [-1, 1, 1] - mean, axis=2)
    partner = gaps.argmin(axis=1)
    return np.where(partner == np.arange(len(mean)), -1, partner)


def nearest_keypoints(pixels: FloatArray, true: FloatArray) -> IntArray:
    """Numbers (V, k) of the true keypoints (V, k, 2) that are nearest to the found ones."""
    gaps = np.linalg.norm(pixels[:, :, None] - true[:, None], axis=3)
    return np.asarray(gaps.argmin(axis=2))


def draw_confusion(
    path: Path, detector: KeypointDetector, views: RenderedViews, mirrored: IntArray
) -> None:
    """Draw which true keypoints the found ones lie at, and the views with most exchanged sides."""
    from matplotlib.figure import Figure

    pixels, _ = detector.predict(views)
    nearest = nearest_keypoints(pixels, views.points_2d)
    count = len(mirrored)
    shares = np.stack([(nearest == k).mean(axis=0) for k in range(count)], axis=1)
    figure = Figure(figsize=(13, 6), layout="constrained")
    left, right = figure.subfigures(1, 2, width_ratios=[1, 1.1])
    axes = left.subplots()
    shown = axes.imshow(100 * shares, cmap="Blues", vmin=0, vmax=100)
    known = np.flatnonzero(mirrored >= 0)
    axes.plot(mirrored[known], known, "s", mfc="none", mec="tab:red", ms=10, label="other side")
    axes.set(xlabel="nearest true keypoint", ylabel="found keypoint", xticks=range(count))
    axes.set(yticks=range(count), xticklabels=views.ids, yticklabels=views.ids)
    axes.set_title("Share of views [%]")
    axes.legend(loc="upper right", fontsize=8)
    left.colorbar(shown, ax=axes, shrink=0.8)
    worst = np.argsort(-(nearest == mirrored).sum(axis=1), kind="stable")[:6]
    for axes, view in zip(right.subplots(2, 3).ravel(), worst, strict=True):
        axes.imshow(views.images[view])
        for found, true in zip(pixels[view], views.points_2d[view], strict=True):
            axes.plot(*np.transpose([true, found]), color="white", lw=0.8)
        axes.plot(*views.points_2d[view].T, "o", color="tab:green", ms=4, label="true")
        axes.plot(*pixels[view].T, "x", color="tab:red", ms=4, label="found")
        axes.set_title(f"{(nearest[view] == mirrored).sum()} exchanged sides", fontsize=9)
        axes.set_axis_off()
    right.axes[0].legend(loc="lower left", fontsize=7)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)


def main(options: TrainOptions) -> None:
    """Train, fine-tune in all ways, and write the table."""
    torch.set_num_threads(options.threads)
    begun, spent = time.perf_counter(), time.process_time()
    models = list(sample_models(per_category=options.models, categories=[options.category]))
    common = set.intersection(*({k.semantic_id for k in each.keypoints} for each in models))
    ids = tuple(sorted(common))
    known, unseen = models[: 3 * len(models) // 4], models[3 * len(models) // 4 :]
    shape = learned_shape(known, ids, options.category)
    views, held_out, spare = (
        render_views(some, ids=ids, size=options.size, count=count, seed=options.seed + number)
        for number, (some, count) in enumerate(
            [(known, options.views), (unseen, options.held_out), (known, options.held_out)]
        )
    )
    print(f"{len(ids)} keypoints, views rendered: {time.perf_counter() - begun:.0f} s", flush=True)
    first = KeypointDetector.untrained(len(ids), seed=options.seed)
    mirrored = mirror_images(np.array(shape.components[0].mean[: len(ids)]))
    rows = {"untrained": judged(first, held_out, shape, mirrored)}
    train(first, views, steps=options.steps, batch=options.batch, seed=options.seed)
    rows["trained"] = judged(first.calibrated(spare), held_out, shape, mirrored)
    print(f"trained: {time.perf_counter() - begun:.0f} s", flush=True)
    last = first
    for name, pose_loss in pose_losses(views, shape).items():
        last = first.calibrated(spare).copy()
        train(
            last,
            views,
            steps=options.tuning,
            batch=options.batch,
            rate=_RATE,
            pose_loss=pose_loss,
            pose_weight=_POSTERIOR if name == "Monte-Carlo" else _POSE,
            seed=options.seed + 1,
        )
        last = last.calibrated(spare)
        rows[f"+ {name}"] = judged(last, held_out, shape, mirrored)
        print(f"{name}: {time.perf_counter() - begun:.0f} s", flush=True)
    print(f"{time.process_time() - spent:.0f} s of processor time", flush=True)
    show(rows)
    draw_confusion(options.out / "confusion.png", last, held_out, mirrored)
    write(options.out, rows, last, held_out, shape)


def show(rows: dict[str, dict[str, float]]) -> None:
    """Print the table."""
    table = Table(title="Held-out renders")
    for column in ("trained by", *next(iter(rows.values()))):
        table.add_column(column, justify="right")
    for name, row in rows.items():
        table.add_row(name, *(f"{value:.3g}" for value in row.values()))
    Console(width=140).print(table)


def write(
    folder: Path,
    rows: dict[str, dict[str, float]],
    detector: KeypointDetector,
    views: RenderedViews,
    shape: cadalign.ShapeModel,
) -> None:
    """Write the table, and keypoints with their shape for `cadalign fit`."""
    (folder / "seen").mkdir(parents=True, exist_ok=True)
    write_json(folder / "table.json", rows)
    torch.save(detector.network.state_dict(), folder / "network.pt")
    shape.save(folder / f"{shape.category}.shape")
    pixels, sigma = detector.predict(views)
    lines = [
        {
            "camera": views.camera.to_dict(),
            "shape": f"../{shape.category}.shape",
            "keypoints": [
                {"semantic_id": name, "uv": uv, "score": 1 / s}
                for name, uv, s in zip(views.ids, p.tolist(), sigmas.tolist(), strict=True)
            ],
        }
        for p, sigmas in zip(pixels, sigma, strict=True)
    ]
    for number, line in enumerate(lines[:20]):
        write_json(folder / "seen" / f"{number}.json", line)


if __name__ == "__main__":
    main(tyro.cli(TrainOptions, description=__doc__))
