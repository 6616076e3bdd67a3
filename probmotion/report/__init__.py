"""One page that shows a comparison: its tables, its plots, and draws that move."""

from __future__ import annotations

from probmotion.report.page import write_report

__all__ = ["write_report"]
