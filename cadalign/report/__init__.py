"""Report of runs as an HTML page: headline table, plots and gallery."""

from cadalign.report.page import write_report

__all__ = ["write_report"]
