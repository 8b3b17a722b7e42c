"""Imported by a process that annotators are forked from: all modules and compiled code loaded."""

from __future__ import annotations

import numpy as np

import cadalign.annotate.opening
import cadalign.annotate.server
import cadalign.cli.annotate  # noqa: F401
from cadalign.annotate.alignment import LIKELY_STRETCH, align
from cadalign.annotate.document import FocalChoice, Priors
from cadalign.annotate.photos import Intrinsics
from cadalign.annotate.shape_alignment import warm_up_joint
from cadalign.evaluation.simulation.problems import simulate_problem

_problem = simulate_problem(np.random.default_rng(0), points=8, noise_px=1.0)
_intrinsics = Intrinsics(_problem.camera, calibrated=True)
align(
    _problem.points_3d,
    _problem.points_2d,
    None,
    _intrinsics,
    FocalChoice(known=True),
    Priors(LIKELY_STRETCH, _intrinsics.likely_focal),
)
warm_up_joint(_problem.points_3d, _problem.points_2d, _problem.camera)
