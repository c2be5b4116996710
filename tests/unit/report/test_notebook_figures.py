"""Figures in notebooks: what is stored in the file can be shown without plotly, a script or a network."""

import base64
import copy
import inspect

import nbformat
import numpy as np
import pytest

import edp
from edp.report import notebook
from edp.report.common.chart import Chart, ChartAxis, DataSeries, Panel
from edp.report.notebook.display import PLOTLY, NotebookFigure, show_chart

PNG_START = b"\x89PNG\r\n\x1a\n"


@pytest.fixture
def figure():
    series = DataSeries(x=np.arange(5.0), y=np.arange(5.0), name="speed")
    return show_chart(Chart("speeds", (Panel((series,), ChartAxis("Time [s]")),), height=300), "A title")


def test_a_figure_stores_its_picture_and_its_interactive_form(figure):
    bundle = figure._repr_mimebundle_()
    assert set(bundle) == {PLOTLY, "image/png", "text/plain"}
    assert base64.b64decode(bundle["image/png"]).startswith(PNG_START)
    assert len(bundle["image/png"]) < 100_000
    cell = nbformat.v4.new_code_cell(outputs=[nbformat.v4.new_output("execute_result", data=bundle)])
    nbformat.validate(nbformat.v4.new_notebook(cells=[cell]))


def test_nothing_else_is_displayed_in_place_of_the_picture(figure):
    # IPython prefers the first and converters to HTML the second to a picture.
    assert not callable(figure._ipython_display_)
    assert figure._repr_html_() is None


@pytest.mark.parametrize("change", [lambda f: f.update_layout(title="other"), lambda f: copy.deepcopy(f)])
def test_a_changed_figure_is_html_that_loads_nothing(figure, change):
    changed = change(figure)
    assert isinstance(changed, NotebookFigure)
    bundle = changed._repr_mimebundle_()
    assert "image/png" not in bundle
    assert '<script src="http' not in bundle["text/html"]
    assert "Plotly.newPlot" in bundle["text/html"]


def test_every_figure_of_a_notebook_is_made_in_one_place():
    makers = [name for name in notebook.__all__ if name.endswith("_figure")]
    assert makers
    for name in makers:
        assert "_figure(" in inspect.getsource(getattr(notebook, name)).split("\n", 1)[1], name


def test_every_plot_of_the_api_draws_a_figure_of_a_notebook():
    for name in edp.__all__:
        part = getattr(edp, name)
        if inspect.isclass(part) and callable(getattr(part, "plot", None)):
            assert "_figure(" in inspect.getsource(part.plot) or ".plot(" in inspect.getsource(part.plot), name


def test_recordings_draw_such_a_figure():
    data = edp.Recordings.from_arrays(np.zeros((50, 1)), rate_hz=100, names=["speed"], units=["mm/s"])
    assert "image/png" in data.plot()._repr_mimebundle_()
