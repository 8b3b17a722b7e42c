"""
In a pipeline with a detector
=============================

A keypoint detector gives pixels and scores for each photo, some of them wrong. From its JSON file
to poses.
"""

# %%
# What the detector wrote
# -----------------------
#
# COCO's form, as MMPose, Detectron2 and ultralytics write it; `read_image_keypoints` reads their
# own forms and CSV, too. Here four photos of a car are made up, each with 1 px of noise and two
# wrong keypoints.

import json
import tempfile
from pathlib import Path

import numpy as np

import cadalign
from cadalign.datasets import (
    KeypointNet,
    ModelKeypoints,
    join_keypoints,
    read_image_keypoints,
    write_sample_dataset,
)
from cadalign.render import Angles, Scene, pose_in_view, visible_keypoints

folder = Path(tempfile.mkdtemp())
car = KeypointNet(write_sample_dataset(folder / "sample", categories=("car",)))["car"][0]
points = ModelKeypoints.of_model(car)
names = list(points.names)
camera = cadalign.Camera.from_fov(1280, 720, fov_x=60.0)
scene = Scene(car.load_mesh())
rng = np.random.default_rng(0)

images, annotations, truths = [], [], []
for number, azimuth in enumerate((20.0, 65.0, 110.0, 200.0)):
    posed = pose_in_view(scene, camera, Angles(azimuth=azimuth, elevation=15.0))
    truth = cadalign.Alignment(posed.rotation, posed.translation, (1.0, 1.15, 0.9))
    visible = visible_keypoints(scene, car.keypoints.xyz, camera, truth)
    pixels = camera.project(truth.apply(car.keypoints.xyz)) + rng.normal(0, 1, (len(names), 2))
    scores = np.where(visible, rng.uniform(0.6, 1.0, len(names)), 0.0)
    wrong = rng.choice(np.flatnonzero(visible), 2, replace=False)
    pixels[wrong] += rng.uniform(20, 60, (2, 2))
    scores[wrong] = 0.4
    images.append({"id": number, "file_name": f"{number}.jpg", "width": 1280, "height": 720})
    rows = np.column_stack([pixels, scores]).ravel().tolist()
    annotations.append({"image_id": number, "category_id": 1, "keypoints": rows, "score": 0.9})
    truths.append(truth)
found = {
    "images": images,
    "annotations": annotations,
    "categories": [{"id": 1, "name": "car", "keypoints": names}],
}
(folder / "found.json").write_text(json.dumps(found))

# %%
# Pair them with the model's
# --------------------------
#
# `ModelKeypoints` names the model's points; keypoints are paired by name. Scores become
# scores, which the robust estimator draws its samples by. On the command line: ``cadalign
# observe found.json car.keypoints.json --image 0.jpg``.

observations = [
    join_keypoints(detected, points, camera)
    for detected in read_image_keypoints(folder / "found.json")
]
print([len(observation.points_2d) for observation in observations])

# %%
# Robust fits
# -----------

for observation, truth in zip(observations, truths, strict=True):
    result = cadalign.fit(
        observation.points_3d,
        observation.points_2d,
        camera,
        scores=observation.scores,
        ransac=cadalign.RansacOptions(),
    )
    turn = cadalign.metrics.rotation_error(est=result.alignment, gt=truth)
    print(
        f"{result.inliers.sum()} of {len(result.inliers)} keypoints agree, "
        f"rotation {turn:.2f} deg off, stretch {np.round(result.alignment.scale, 3)}"
    )

# %%
# The last one: keypoints that agree, and those that RANSAC left out.

axes = result.plot()
axes.set_title(f"{(~result.inliers).sum()} keypoints left out")

# %%
# Thousands of photos
# -------------------
#
# `cadalign.fit_batch` and `cadalign.align_batch` take all problems in one call and share them
# among the cores; a problem without solution has its error in the result and does not stop the
# others.
