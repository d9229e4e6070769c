"""What a demo leaves to read: a self-contained HTML page and a table on the terminal."""

from rfedge.report.page import write_report
from rfedge.report.table import print_table

__all__ = ["print_table", "write_report"]
