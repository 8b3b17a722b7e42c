"""The result of runs as one page, and as tables for papers."""

from cadalign.report.page import Report, write_report
from cadalign.report.tables import FORMATS, headline_text

__all__ = ["FORMATS", "Report", "headline_text", "write_report"]
