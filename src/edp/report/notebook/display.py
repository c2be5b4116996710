"""Plotly figures that are still shown where a saved notebook is read: as HTML, on a site, without a network."""

from __future__ import annotations

import base64
import json
from dataclasses import replace
from typing import Any

import plotly.graph_objects as go

from edp.report.common.chart import Chart
from edp.report.common.interactive import plot
from edp.report.common.picture import draw_png

DPI = 100
"""Resolution of notebook figures in dots per inch, which keeps a figure below about 100 kB."""
PLOTLY = "application/vnd.plotly.v1+json"


class NotebookFigure(go.Figure):  # type: ignore[misc]  # plotly has no types
    """Plotly figure that stores a picture in a notebook, next to its interactive form.

    Plotly itself stores a form that only its notebook extension draws, or a script that is loaded from the network.
    Converters to HTML show the first not at all, and the second only online.
    """

    _chart: Chart | None = None
    _unchanged = ""
    # Plotly's own display would write its renderer's output; without it IPython asks for `_repr_mimebundle_`.
    _ipython_display_: Any = None

    def _repr_html_(self) -> None:
        """Return None, since converters prefer HTML to the picture, and plotly's HTML loads a script."""

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None, **options: Any) -> dict[str, object]:
        """Return the figure for plotly's extension, and a form that every other reader of the notebook shows.

        Figures of EDP have a picture. One that was changed since has HTML with plotly's script within.
        """
        content = self.to_json()
        bundle: dict[str, object] = {PLOTLY: json.loads(content), "text/plain": type(self).__name__}
        if self._chart is not None and content == self._unchanged:
            bundle["image/png"] = base64.b64encode(draw_png(self._chart, DPI)).decode("ascii")
        else:
            bundle["text/html"] = self.to_html(full_html=False, include_plotlyjs=True)
        return bundle


def show_chart(chart: Chart, title: str = "") -> NotebookFigure:
    """Return a chart without choices as a figure for a notebook."""
    figure = NotebookFigure(plot(chart, title).figure)
    figure._chart, figure._unchanged = replace(chart, title=title or chart.title), figure.to_json()
    return figure
