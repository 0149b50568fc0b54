"""Self-contained HTML reports."""

from btfref.report.cell import Cell
from btfref.report.document import report_data, write_report

__all__ = ["Cell", "report_data", "write_report"]
