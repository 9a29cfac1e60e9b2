"""The report of one job: figures as JSON, and one self-contained page."""

from service.reports.report import render_report, write_report

__all__ = ["render_report", "write_report"]
