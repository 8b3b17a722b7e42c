"""Imported by a process that others are forked from: modules and compiled code are loaded."""

from __future__ import annotations

import cadalign.annotate.server
import cadalign.annotate.session
import cadalign.batch.runs
import cadalign.cli.annotate
import cadalign.cli.evaluate
import cadalign.evaluation.experiments.keypointnet
import cadalign.evaluation.plots
import cadalign.evaluation.runs.engine  # noqa: F401
from cadalign.annotate.problem import warm_up

warm_up(joint=True)
