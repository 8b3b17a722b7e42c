"""Metrics: their formulas, and the table of labels and units that all outputs read.

The formulas for alignments and boxes are `cadalign.metrics`; here are those of data sets, a module
for each, as their papers define them. Names of the table are found here, too.
"""

from typing import Any

from cadalign.evaluation.metrics import table


def __getattr__(name: str) -> Any:
    return getattr(table, name)
