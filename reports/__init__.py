"""The report of one job: figures as JSON, and one self-contained page."""

from stillpath.reports.report import headline_figures, render_report, write_report
from stillpath.reports.schema import report_schema

__all__ = ["headline_figures", "render_report", "report_schema", "write_report"]
