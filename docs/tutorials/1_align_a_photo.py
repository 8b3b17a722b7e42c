"""
Align a model to a photo
========================

A photo shows a chair; there is a CAD model of another one. Ten keypoints seen in the photo are
known on the model, too. How is the chair posed, and how much lower and shallower is it than the
model?
"""

# %%
# The photo and the model
# -----------------------
#
# The sample data set has models whose keypoints carry semantic ids: 'back, top left' has the same
# id on every chair. The photo is a rendering of chair 006, which stands for a photo that you
# took; the model is chair 000.

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import cadalign
from cadalign.datasets import KeypointNet, write_sample_dataset
from cadalign.render import (
    Angles,
    RaycastRenderer,
    Scene,
    pose_in_view,
    visible_keypoints,
)

folder = Path(tempfile.mkdtemp())
chairs = KeypointNet(write_sample_dataset(folder, categories=("chair",)))
seen = chairs["chair", "sample_chair_006"]
model = chairs["chair", "sample_chair_000"]

camera = cadalign.Camera.from_fov(640, 720, fov_x=33.0)
scene = Scene(seen.load_mesh())
true_pose = pose_in_view(scene, camera, Angles(azimuth=143.0, elevation=24.0))
frame = RaycastRenderer().render(scene, camera, true_pose, samples=4)
photo = frame.composite((206, 208, 212))

# %%
# Keypoints on both
# -----------------
#
# A person or a detector marks the visible keypoints in the photo, to about a pixel. Rows of both
# arrays belong together.

rng = np.random.default_rng(0)
visible = visible_keypoints(scene, seen.keypoints.xyz, camera, true_pose)
pixels = camera.project(true_pose.apply(seen.keypoints.xyz)) + rng.normal(0, 1, (len(visible), 2))
ids, in_photo, on_model = np.intersect1d(
    seen.keypoints.ids[visible], model.keypoints.ids, return_indices=True
)
points_2d = pixels[visible][in_photo]
points_3d = model.keypoints.xyz[on_model]
print(f"{len(ids)} keypoints, ids {ids.tolist()}")

# %%
# Pose and stretch
# ----------------
#
# ``sigma=None`` estimates the keypoints' noise from the residuals: two chairs do not agree to
# the pixel, so 1 px would promise too much.

result = cadalign.fit(points_3d, points_2d, camera, sigma=None)
print(result)

# %%
# The chair in the photo has the model's width, is about 0.76 times as high, and 0.78 times as deep.
# The standard deviations say how well the keypoints determine it: look at them before you believe
# a number.
# ``result.warnings`` has a sentence for what the keypoints leave open; here it is empty.

print(result.alignment.scale, result.std.scale, result.warnings)

# %%
# See it
# ------
#
# The model, stretched and posed, over the photo, with its box and the residuals of the keypoints.

result.plot(photo, model.load_mesh())
plt.gcf().set_size_inches(6, 6.5)

# %%
# What next
# ---------
#
# The residuals of some pixels say that the object is no stretched copy of the model. If you have
# several models of the kind, :doc:`learn how they differ <2_another_object>`; if you have a mask
# or a second photo, :doc:`use them <3_masks_and_views>`.
