"""The page of runs: headline table, plots and gallery; several runs side by side."""

from cadalign.report.page import write_report

__all__ = ["write_report"]
