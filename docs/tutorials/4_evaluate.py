"""
Evaluate on a data set, and the paper's simulation
==================================================

How accurate is it on models like yours, in views like yours, with keypoints as noisy as your
detector's? `cadalign.evaluate` runs methods on a whole data set and returns a DataFrame.
"""

# %%
# A run
# -----
#
# The root is a folder in KeypointNet's layout. Each model is stretched by unknown factors, seen
# in a random view, and its visible keypoints get 2 px of noise. On the command line the same is
# ``cadalign evaluate keypointnet ROOT --noise-px 2``, which ends with a page.

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

import cadalign
from cadalign.datasets import write_sample_dataset

root = write_sample_dataset(Path(tempfile.mkdtemp()) / "sample", per_category=12)
rows = cadalign.evaluate(root, noise_px=2.0, methods=("optimal", "aepnp"), workers=0)
print(rows.columns.tolist())

# %%
# By category
# -----------
#
# A row for each instance and method. Instances that could not be aligned keep a row with the
# reason.

print(rows["status"].value_counts().to_string())
errors = rows.groupby(["category", "method"])[["rotation_error_deg", "box_iou"]]
print(errors.median().round(2).to_string())

# %%
# As a curve
# ----------

figure, ax = plt.subplots(figsize=(6, 3.5), layout="constrained")
for method, group in rows.groupby("method"):
    errors = group["rotation_error_deg"].dropna().sort_values()
    ax.plot(errors, [k / len(errors) for k in range(1, len(errors) + 1)], label=method)
ax.set(xscale="log", xlabel="rotation error [deg]", ylabel="share of instances")
ax.legend()

# %%
# Thousands of models
# -------------------
#
# ``out="runs/mine"`` keeps the run's folder: a killed run goes on from there. ``workers=-1``
# takes all cores; ``dask="tcp://host:8786"`` :doc:`takes a cluster </how_to/many_machines>`.

# %%
# The paper's simulation
# ----------------------
#
# The problem and its linear solver come from *AEPnP: A Less-constrained EPnP Solver for Pose
# Estimation with Anisotropic Scaling* (Wei, Leutenegger, Kneip). Its simulation is one of the
# experiments: random points, random poses, stretches from 0.5 to 2, a camera of 640 x 480 px with
# f = 150 px and 2 px of noise. ``make paper`` makes all of its figures at their size.

sweep = {"sweep": "points", "values": [8, 16, 32, 64, 128], "runs": 40}
rows = cadalign.evaluate(experiment="simulate", **sweep, methods=["aepnp", "optimal"], workers=0)
medians = rows.groupby(["points", "method"])["rotation_error_deg"].median().unstack()
print(medians.round(2).to_string())

# %%
# ``aepnp`` is the linear solver, ``optimal`` what `cadalign.fit` does by default: it starts from
# the linear solution and others, and reaches the Cramer-Rao bound, the error of an ideal
# estimator.

figure, ax = plt.subplots(figsize=(6, 3.5), layout="constrained")
medians.plot(ax=ax, marker="o", logx=True, logy=True)
ax.set(xlabel="points", ylabel="median rotation error [deg]")
