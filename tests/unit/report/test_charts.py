"""Charts: one description, drawn on a page and into files."""

import numpy as np
import pytest

from edp.report.common.chart import (
    Bars,
    Cells,
    Chart,
    ChartAxis,
    Control,
    DataSeries,
    GuideLine,
    Mark,
    Panel,
    Range,
    Texts,
)
from edp.report.common.interactive import plot
from edp.report.common.picture import write_pictures

RAMP = np.arange(3.0)
MARKS = (
    DataSeries(x=["a", "b", "c"], y=RAMP, name="line", width=1, symbol="circle", filled=True),
    DataSeries(x=RAMP, y=["a", "b", "c"], low=[None, 0.5, 1.0], high=[None, 1.5, 3.0], symbol="square"),
    Range(x=RAMP, low=RAMP, high=RAMP + 1, name="interval"),
    Bars(positions=["a", "b", "c"], values=[1.0, None, 2.0], colours=["#0b57d0"] * 3, valued=True),
    Cells(x=["a", "b"], y=["a", "b"], values=np.array([[1.0, np.nan], [0.5, 0.0]]), written=True, gap=True),
    Texts(x=[0.0], y=[1.0], texts=["here"]),
    GuideLine(x=1.0),
    GuideLine(y=0.0, to=1.0),
)


def test_every_kind_of_mark_is_tried():
    assert {type(mark) for mark in MARKS} == set(Mark.__subclasses__())


@pytest.mark.long
@pytest.mark.parametrize("mark", MARKS, ids=lambda mark: type(mark).__name__)
def test_a_mark_is_drawn_on_a_page_and_into_a_file(mark, tmp_path):
    chart = Chart("one", (Panel((mark,), ChartAxis("x"), ChartAxis("y")),), file="one", inches=(2.0, 1.5))
    figure = plot(chart).figure
    assert figure.data or figure.layout.shapes
    svg, png = write_pictures(tmp_path, [chart])
    assert (svg.name, png.name) == ("one.svg", "one.png")


def test_a_picture_is_made_for_each_option_and_a_page_shows_the_first(tmp_path):
    ways = Control("way", "Way", (("a/b", "up"), ("c", "down")))
    parts = Control("part", "Part", (("one", "first"), ("two", "second")))
    marks = tuple(
        DataSeries(x=RAMP, y=RAMP, name="line", width=1, when={"way": way, "part": part})
        for way, _ in ways.options
        for part, _ in parts.options
    )
    chart = Chart(
        "c", (Panel(marks, ChartAxis("cost", titled_by="way")),), file="c_{way}", title="{way} only",
        choices=(ways, parts), across="part",
    )  # fmt: skip
    figure = plot(chart).figure
    assert [trace.visible for trace in figure.data] == [True, False, False, False]
    assert all(trace.showlegend for trace in figure.data)
    pictures = list(chart.pictures())
    assert [(picture.name, picture.title) for picture in pictures] == [("c_a/b", "up only"), ("c_c", "down only")]
    assert [panel.title for panel in pictures[0].panels] == ["first", "second"]
    assert {panel.x.title for panel in pictures[0].panels} == {"up"}
    assert all(len(panel.marks) == 1 for picture in pictures for panel in picture.panels)
    assert len(chart.first().panels[0].marks) == 1
    small = [Chart("c", chart.panels, file=chart.file, choices=chart.choices[:1], inches=(2.0, 1.5))]
    assert [path.name for path in write_pictures(tmp_path, small)][::2] == ["c_a_b.svg", "c_c.svg"]


def test_names_are_text_on_a_page():
    odd = "<b>x</b>\u202e{y}"
    series = DataSeries(
        x=[odd, "b"], y=[1.0, 2.0], name=odd, symbol="circle", labels=[odd, odd], hover="{label}: {y:.3g}"
    )
    figure = plot(Chart("c", (Panel((series,), ChartAxis(odd), title=odd),), height=300)).figure
    text = figure.to_json().replace("\\u003c", "<")
    assert "<b>" not in text
    assert "\u202e" not in text
    assert figure.data[0].hovertemplate == "%{customdata}: %{y:.3~g}"


def test_marks_of_one_name_have_one_entry_in_the_legend():
    marks = tuple(DataSeries(x=RAMP, y=RAMP + i, name="twice", width=1) for i in range(2))
    figure = plot(Chart("c", (Panel(marks), Panel(marks)), columns=2)).figure
    assert [trace.showlegend for trace in figure.data] == [True, False, False, False]
