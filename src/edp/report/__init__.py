"""Report of a run: `facts` reads, `figures` computes, `charts` describes, `page` writes one offline HTML file."""

from edp.report.compare.page import build_compare_page
from edp.report.compare.paired import Comparison, compare_runs
from edp.report.compression.page import write_compression_page
from edp.report.control.facts import ControlFacts
from edp.report.control.page import build_control_page
from edp.report.coverage.page import build_coverage_page
from edp.report.run.facts import Facts, comparison_rows, headline, read_facts
from edp.report.run.page import build_report
from edp.report.screening.page import build_screening_page, write_screening_pictures
from edp.report.search.page import StudyReport, write_study_page
from edp.report.transfer.facts import Transfer, read_transfer
from edp.report.transfer.page import write_transfer_page
from edp.report.twin.charts import write_rollout_plots
from edp.report.twin.facts import FreeRunFacts, holds_free_runs
from edp.report.twin.page import build_twin_page, build_twin_report

__all__ = [
    "Comparison",
    "ControlFacts",
    "Facts",
    "FreeRunFacts",
    "StudyReport",
    "Transfer",
    "build_compare_page",
    "build_control_page",
    "build_coverage_page",
    "build_report",
    "build_screening_page",
    "build_twin_page",
    "build_twin_report",
    "compare_runs",
    "comparison_rows",
    "headline",
    "holds_free_runs",
    "read_facts",
    "read_transfer",
    "write_compression_page",
    "write_rollout_plots",
    "write_screening_pictures",
    "write_study_page",
    "write_transfer_page",
]
