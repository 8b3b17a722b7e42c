"""
An object that is not the model
===============================

Most objects are no stretched copy of any model. With some annotated models of the category,
`cadalign.ShapeModel` learns how its objects differ, and `cadalign.align` estimates pose and shape
together.
"""

# %%
# Learn a category
# ----------------
#
# Sixty sample chairs, each of its own proportions, with a split for training. With KeypointNet on
# your disk, its root takes the place of ``folder``.

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import cadalign
from cadalign import Box
from cadalign.datasets import KeypointNet, write_sample_dataset
from cadalign.render import Angles, Scene, draw_overlay, pose_in_view, visible_keypoints

folder = Path(tempfile.mkdtemp())
dataset = KeypointNet(write_sample_dataset(folder, per_category=60, categories=("chair",)))
shape = cadalign.ShapeModel.from_dataset(dataset, "chair", split="train")
print(shape)

# %%
# A chair that it has not seen
# ----------------------------
#
# Of a chair of the test split, the keypoints that a camera sees, with 1 px of noise.

chair = dataset.subset(categories=["chair"], split="test")["chair"][0]
camera = cadalign.Camera.from_fov(640, 480, fov_x=35.0)
scene = Scene(chair.load_mesh())
true_pose = pose_in_view(scene, camera, Angles(azimuth=35.0, elevation=15.0))
xyz, ids = chair.keypoints.xyz, chair.keypoints.ids
visible = visible_keypoints(scene, xyz, camera, true_pose)
rng = np.random.default_rng(1)
points_2d = camera.project(true_pose.apply(xyz))[visible] + rng.normal(0, 1, (visible.sum(), 2))
view = cadalign.View(camera, points_2d, ids=ids[visible], sigma=1.0)
print(f"{visible.sum()} of {len(ids)} keypoints are visible")

# %%
# Pose and shape
# --------------

result = cadalign.align(shape, view)
print(result)

# %%
# ``result.points_3d`` holds *all* keypoints of the category as they are on this chair, the hidden
# ones too, and ``result.points_covariance`` how well they are known. One image leaves the object's
# size open, so errors are measured after scaling about the camera centre.

rotation_error = cadalign.metrics.rotation_error(est=result.alignment, gt=true_pose)
true_box = Box.from_model(scene.bounds, true_pose)
overlap = cadalign.metrics.box_iou_up_to_scale(est=result.box, gt=true_box)
print(f"rotation {rotation_error:.2f} deg off, box IoU {overlap:.2f}")

# %%
# The same with another chair as the model, stretched: what the shape model is worth here.

other = dataset.subset(categories=["chair"], split="train")["chair"][0]
shared, rows, other_rows = np.intersect1d(ids[visible], other.keypoints.ids, return_indices=True)
stretched = cadalign.fit(other.keypoints.xyz[other_rows], points_2d[rows], camera, sigma=None)
stretched_box = Box.from_model(other.load_mesh().bounds, stretched.alignment)
rotation_error = cadalign.metrics.rotation_error(est=stretched.alignment, gt=true_pose)
overlap = cadalign.metrics.box_iou_up_to_scale(est=stretched_box, gt=true_box)
print(f"rotation {rotation_error:.2f} deg off, box IoU {overlap:.2f}")

# %%
# See it
# ------
#
# Left the stretched other chair, right the learned shape. Green is the truth, red the estimate.

photo = np.full((camera.height, camera.width, 3), 230, np.uint8)
figure, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
for ax, box, title in zip(
    axes, (stretched_box, result.box), ("another chair", "learned shape"), strict=True
):
    ax.imshow(draw_overlay(photo, camera, est_box=box, gt_box=true_box, observed=points_2d))
    ax.set_title(title)
    ax.set_axis_off()
