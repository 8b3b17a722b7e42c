"""
Reproduce the paper's simulation
================================

The problem and its linear solver come from *AEPnP: A Less-constrained EPnP Solver for Pose
Estimation with Anisotropic Scaling* (Wei, Leutenegger, Kneip). Its simulation is one of the
experiments.
"""

# %%
# Error against the number of points
# ----------------------------------
#
# Random points, random poses, stretches from 0.5 to 2, a camera of 640 x 480 px with f = 150 px
# and 2 px of noise: a small version of one of the paper's figures. ``make paper`` makes all of
# them at its size.

import matplotlib.pyplot as plt

import cadalign

rows = cadalign.simulate(
    "points", values=[8, 16, 32, 64, 128], runs=40, methods=["aepnp", "optimal"], workers=0
)
medians = rows.groupby(["points", "method"])["rotation_error_deg"].median().unstack()
print(medians.round(2).to_string())

# %%
# ``aepnp`` is the linear solver, ``optimal`` what `cadalign.fit` does by default: it starts from
# the linear solution and others, and reaches the Cramer-Rao bound, the error of an ideal
# estimator.

figure, ax = plt.subplots(figsize=(6, 3.5), layout="constrained")
medians.plot(ax=ax, marker="o", logx=True, logy=True)
ax.set(xlabel="points", ylabel="median rotation error [deg]")
