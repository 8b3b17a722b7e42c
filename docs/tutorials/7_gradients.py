"""
Keypoints that move a result most
=================================

A result is the optimum of a cost. How it moves with every keypoint follows from the cost's
curvature there, without another fit.
"""

# %%
# A chair with one click that matters
# -----------------------------------

import numpy as np

import cadalign

camera = cadalign.Camera(640, 480, 935, 935, 319.5, 239.5)
chair = np.array([
    [-.2, 0, .2], [.2, 0, .2], [.2, .1, -.2], [-.2, .1, -.2], [.18, .5, -.25], [-.18, .55, -.25],
    [0, .3, .1],
])  # fmt: skip
photo = np.array([
    [233.8, 340.5], [346.7, 387.1], [407.7, 298.2], [294.3, 262.7], [416.0, 123.9], [308.3, 76.3],
    [302.1, 227.2],
])  # fmt: skip
result = cadalign.fit(chair, photo, camera)
sensitivity = result.sensitivity()
print(sensitivity)

# %%
# The first column is the change of the whole result, in its own standard deviations, when a
# keypoint moves by one of its standard deviations. Click the strongest one with care, or twice.

print("strongest keypoint:", sensitivity.strongest)

# %%
# Derivatives
# -----------
#
# ``by_points_2d`` holds the derivatives of rotation vector [rad], translation and logarithms of the
# lengths by the pixels. A second fit agrees with what they predict.

row = sensitivity.strongest
moved = photo.copy()
moved[row] += [0.2, -0.1]
again = cadalign.fit(chair, moved, camera)
predicted = sensitivity.by_points_2d[3:6, row] @ [0.2, -0.1]
print("predicted ", np.round(predicted, 5))
print("fitted    ", np.round(again.alignment.translation - result.alignment.translation, 5))

# %%
# ``by_log_sigma`` is the effect of trusting a keypoint more or less, ``by_points_3d`` what an
# error of the model does: a millimetre at each keypoint of a model in metres.

by_model = np.linalg.norm(sensitivity.by_points_3d[:3], axis=(0, 2)) * 0.001
print("rotation per millimetre [deg]:", np.degrees(by_model).round(3))

# %%
# Where errors come from
# ----------------------
#
# To first order, the covariance of the result is that of its keypoints, carried through the
# derivatives; each keypoint has its share of it.

shares = (sensitivity.by_points_2d[:3] ** 2).sum(axis=(0, 2))
shares /= shares.sum()
axes = result.plot()
axes.scatter(*photo.T, s=10_000 * shares, color="tab:orange", alpha=0.4)
for place, share in zip(photo, shares, strict=True):
    axes.annotate(f"{share:.0%}", place, xytext=(8, -12), textcoords="offset points")
axes.set_title("Shares of the rotation's variance")

# %%
# In a training loop, `cadalign.torch.fit` has the same derivatives as gradients of tensors.
