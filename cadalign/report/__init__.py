"""The result of runs as one page, and as tables for papers."""

from cadalign.report.headline import FORMATS, headline_text
from cadalign.report.page import write_report

__all__ = ["FORMATS", "headline_text", "write_report"]
