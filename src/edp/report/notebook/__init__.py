"""Notebook display of recordings, predictions, scores and studies: HTML tables and figures without scripts."""

from edp.report.notebook.figures import BandLine, prediction_figure, recordings_figure, score_figure, study_figure
from edp.report.notebook.tables import html_of, score_tables, study_html, text_of

__all__ = [
    "BandLine",
    "html_of",
    "prediction_figure",
    "recordings_figure",
    "score_figure",
    "score_tables",
    "study_figure",
    "study_html",
    "text_of",
]
