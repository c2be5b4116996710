"""The report of a run: `facts` reads, `figures` computes, `plots` draws, `page` writes one offline HTML file."""

from edp.report.compression_facts import Compression, read_compression
from edp.report.compression_page import write_compression_page
from edp.report.coverage_page import build_coverage_page
from edp.report.facts import Facts, comparison_rows, headline, read_facts
from edp.report.page import build_report
from edp.report.pictures import write_pictures
from edp.report.screening_page import build_screening_page
from edp.report.study_facts import read_study
from edp.report.study_page import StudyReport, write_study_page
from edp.report.transfer_facts import Transfer, read_transfer
from edp.report.transfer_page import write_transfer_page

__all__ = [
    "Compression",
    "Facts",
    "StudyReport",
    "Transfer",
    "build_coverage_page",
    "build_report",
    "build_screening_page",
    "comparison_rows",
    "headline",
    "read_compression",
    "read_facts",
    "read_study",
    "read_transfer",
    "write_compression_page",
    "write_pictures",
    "write_study_page",
    "write_transfer_page",
]
