"""The kernels that most tests need, compiled before several processes would each compile them."""

from __future__ import annotations

import numpy as np

from cadalign import Model, RansacOptions, View, align
from cadalign.fitting.options import METHODS
from cadalign.shapes.model import ShapeModel
from support.problems import fit_problem, problem_of


def compile_usual_kernels() -> None:
    """Call what most tests call; Numba keeps the results on disk."""
    problem = problem_of(0, points=12)
    for method in METHODS:
        fit_problem(problem, method=method)
    fit_problem(problem, ransac=RansacOptions(max_iterations=10), sigma=1.0)
    fit_problem(problem, focal="estimate")
    view = View(problem.camera, problem.points_2d, sigma=1.0)
    align(Model(points_3d=problem.points_3d), view)
    directions = np.random.default_rng(0).normal(size=(2, 12, 3))
    align(ShapeModel.from_basis(problem.points_3d, directions, [0.1, 0.1]), view)
