"""
Masks and several views
=======================

Few keypoints in one image leave much open: a box can lie on the photo to the pixel and miss the
object in space. A mask of the object, or a second photo, closes that.
"""

# %%
# The keypoints of a bottle
# -------------------------
#
# The true bottle is the model, 1.3 times as high and 0.8 times as deep.

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import cadalign
from cadalign.datasets import KeypointNet, write_sample_dataset
from cadalign.render import (
    Angles,
    Scene,
    cast_geometry,
    draw_overlay,
    pose_in_view,
    visible_keypoints,
)

root = write_sample_dataset(Path(tempfile.mkdtemp()), categories=("bottle",))
bottle = KeypointNet(root)["bottle"][0]
mesh = bottle.load_mesh()
scene = Scene(mesh)
camera = cadalign.Camera.from_fov(640, 480, fov_x=40.0)
rng = np.random.default_rng(0)


def photographed(azimuth: float) -> tuple[cadalign.Alignment, np.ndarray, np.ndarray]:
    """The true alignment in a view, the pixels of the keypoints, and which are visible."""
    posed = pose_in_view(scene, camera, Angles(azimuth=azimuth, elevation=20.0))
    truth = cadalign.Alignment(posed.rotation, 1.2 * posed.translation, (1.0, 1.3, 0.8))
    visible = visible_keypoints(scene, bottle.keypoints.xyz, camera, truth)
    pixels = camera.project(truth.apply(bottle.keypoints.xyz))
    return truth, pixels + rng.normal(0, 1, pixels.shape), visible


truth, pixels, visible = photographed(30.0)
true_box = cadalign.Box.from_model(scene.bounds, truth)
ids = bottle.keypoints.ids
model = cadalign.Model(points_3d=bottle.keypoints.xyz, ids=ids, mesh=mesh)


def report(name: str, result: cadalign.Result) -> None:
    """One line of errors and standard deviations."""
    iou = cadalign.metrics.box_iou(est=result.box, gt=true_box)
    turn = cadalign.metrics.rotation_error(est=result.alignment, gt=truth)
    stretch = ", ".join(
        f"{value:.3f} +- {std:.3f}"
        for value, std in zip(result.alignment.scale[1:], result.std.scale[1:], strict=True)
    )
    print(f"{name:18} rotation {turn:5.2f} deg off, stretch {stretch}, box IoU {iou:.2f}")


keypoints_alone = cadalign.align(model, cadalign.View(camera, pixels[visible], ids=ids[visible]))
report("keypoints", keypoints_alone)

# %%
# With a mask
# -----------
#
# `View(mask=)` takes a boolean or probability image, or the path of a PNG, as segmentation tools
# write it. The outline of the model's mesh is fitted to the mask's, together with the keypoints.

mask = cast_geometry(scene, camera, truth).mask
seen = cadalign.View(camera, pixels[visible], ids=ids[visible], mask=mask)
with_mask = cadalign.align(model, seen)
report("keypoints, mask", with_mask)

# %%
# ``result.evidence`` states how well each piece fits, in its own unit and in standard deviations:

for piece in with_mask.evidence:
    print(piece)

# %%
# With a second photo
# -------------------
#
# The camera's motion need not be known: stretch and shape are shared by the views. Where it is
# known, give it as ``cam_from_rig=`` of each view, and the object's size follows as well.

_, other_pixels, other_visible = photographed(75.0)
second = cadalign.View(camera, other_pixels[other_visible], ids=ids[other_visible])
first = cadalign.View(camera, pixels[visible], ids=ids[visible])
report("two views", cadalign.align(model, [first, second]))

# %%
# See it
# ------
#
# Both boxes lie on the mask; in space only the second one lies on the bottle.

figure, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
backdrop = np.where(mask[..., None], 205, 245).astype(np.uint8).repeat(3, axis=2)
titles = ("keypoints", "keypoints, mask")
for ax, result, title in zip(axes, (keypoints_alone, with_mask), titles, strict=True):
    seen = pixels[visible]
    ax.imshow(draw_overlay(backdrop, camera, est_box=result.box, gt_box=true_box, observed=seen))
    ax.set_title(title)
    ax.set_axis_off()
