"""Imported by a process that annotators are forked from: all modules and compiled code loaded."""

from __future__ import annotations

import numpy as np

import cadalign.annotate.opening
import cadalign.annotate.server
import cadalign.cli.annotate  # noqa: F401
from cadalign.annotate.estimate import warm_up
from cadalign.evaluation.simulation.problems import simulate_problem

_problem = simulate_problem(np.random.default_rng(0), points=8, noise_px=1.0)
warm_up(_problem.points_3d, _problem.points_2d, _problem.camera, joint=True)
