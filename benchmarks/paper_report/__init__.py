"""`sprung bench paper-report [FOLDER] [DOCUMENT]`: measured rows and pictures into docs/paper.md.

Reads the rows that `sprung bench paper` made, or those that are kept in docs/, and writes tables, comparisons and
targets into marked places of the document, so that figures there are never typed by hand.
"""

from sprung.benchmarks.paper_report.command import run
from sprung.benchmarks.paper_report.comparisons import comparisons
from sprung.benchmarks.paper_report.document import read_rows, refresh
from sprung.benchmarks.paper_report.tables import table
from sprung.benchmarks.paper_report.targets import targets

__all__ = ["comparisons", "read_rows", "refresh", "run", "table", "targets"]
