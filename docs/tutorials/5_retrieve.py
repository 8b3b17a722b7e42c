"""
Find the model
==============

Which of many CAD models is in the photo? A library ranks its models by the fit of each, posed and
stretched, to the image's keypoints.
"""

# %%
# A library
# ---------

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

root = write_sample_dataset(Path(tempfile.mkdtemp()), per_category=20, categories=("chair", "car"))
dataset = KeypointNet(root)
library = cadalign.Library.from_models(dataset)
print(library)

# %%
# ``library.save("chairs.lib")`` writes one file, and `Library.open` maps it into memory: opening
# fifty thousand models takes no time.
#
# A query
# -------
#
# The keypoints of one of the chairs in a photo, stretched by factors that the library does not
# know.

wanted = dataset["chair"][17]
camera = cadalign.Camera.from_fov(640, 480, fov_x=35.0)
scene = Scene(wanted.load_mesh())
posed = pose_in_view(scene, camera, Angles(azimuth=-40.0, elevation=25.0))
truth = cadalign.Alignment(posed.rotation, 1.5 * posed.translation, (1.0, 1.4, 0.7))
visible = visible_keypoints(scene, wanted.keypoints.xyz, camera, truth)
rng = np.random.default_rng(0)
pixels = camera.project(truth.apply(wanted.keypoints.xyz))[visible]
pixels += rng.normal(0, 1, pixels.shape)

matches = library.retrieve(pixels, wanted.keypoints.ids[visible], camera)
print(f"wanted: {wanted.model_id}")
for match in matches[:3]:
    print(match)
print(f"none of these: {matches[0].none_probability:.3f}")

# %%
# The object, and the likeliest models as they were posed and stretched.

shown = [("the object", scene, truth)]
for match in matches[:3]:
    found = Scene(dataset[match.category, match.model_id].load_mesh())
    shown.append((f"score {match.score:.2f}", found, match.alignment))
figure, axes = plt.subplots(1, 4, figsize=(12, 2.8), layout="constrained")
for ax, (title, drawn, pose) in zip(axes, shown, strict=True):
    still = RaycastRenderer().render(drawn, camera, pose, samples=4)
    ax.imshow(still.composite((206, 208, 212)))
    ax.set_title(title)
    ax.set_axis_off()

# %%
# ``match.score`` is the probability that the object is this model, provided that it is one of the
# library's; ``match.none_probability``, that it is none of them. ``match.alignment`` poses and
# stretches it. For objects that are in no library, pass a learned shape:
# ``library.retrieve(..., shape=shape)`` ranks by the shape that the keypoints leave probable.
