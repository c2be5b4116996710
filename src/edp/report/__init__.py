"""The report of a run: `facts` reads, `figures` computes, `plots` draws, `page` writes one offline HTML file."""

from edp.report.coverage_page import build_coverage_page
from edp.report.facts import Facts, comparison_rows, headline, read_facts
from edp.report.page import build_report

__all__ = ["Facts", "build_coverage_page", "build_report", "comparison_rows", "headline", "read_facts"]
