"""Imported by a process that others are forked from: modules and compiled code are loaded."""

from __future__ import annotations

import numpy as np

import cadalign.annotate.opening
import cadalign.annotate.server
import cadalign.batch.fits
import cadalign.cli.annotate
import cadalign.cli.evaluate
import cadalign.evaluation.experiments.keypointnet
import cadalign.evaluation.plots
import cadalign.evaluation.runs.engine  # noqa: F401
from cadalign.annotate.problem import warm_up
from cadalign.evaluation.simulation import simulate_problem

_problem = simulate_problem(np.random.default_rng(0), points=8, noise_px=1.0)
warm_up(_problem.points_3d, _problem.points_2d, _problem.camera, joint=True)
