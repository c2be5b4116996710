"""The report of a run: `facts` reads, `figures` computes, `plots` draws, `page` writes one offline HTML file."""

from edp.report.coverage_page import build_coverage_page
from edp.report.facts import Facts, comparison_rows, headline, read_facts
from edp.report.page import build_report
from edp.report.pictures import write_pictures
from edp.report.screening_page import build_screening_page

__all__ = [
    "Facts",
    "build_coverage_page",
    "build_report",
    "build_screening_page",
    "comparison_rows",
    "headline",
    "read_facts",
    "write_pictures",
]
