"""Files that people open: spreadsheets, documents, pictures and pages hold names as text, whatever the names are."""

import csv
import io
import json
import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edp.report.common.picture import NOT_XML, write_drawings
from edp.report.common.templates import json_text, template
from edp.table import Column, Table
from edp.wording import escape_csv, escape_markdown, printable

HOSTILE = [
    '=HYPERLINK("http://a.b")',
    "+1+cmd|' /C calc'!A0",
    "-2+3",
    "@SUM(A1)",
    "\t=1",
    "＝1",
    "<script>alert(1)</script>",
    "</script><img src=x onerror=alert(1)>",
    "[x](javascript:alert(1))",
    "![x](http://a.b/c.png)",
    "a|b\n| c |",
    "a\x00b\x1b[2J\x0c",
    "\ufffe\uffff",
    "\udcff",
    "\u202ecba",
    "$\\frac{1}{0}$ $x_",
    "{{ 7 * 7 }} {% raw %}",
]


def sheet(name):
    columns = (Column(name), Column("value", "mm/s"))
    return Table(name, columns, ((name, 1.5), (name, -2.5), (None, None)), frozenset({0}), name="table")


@pytest.mark.parametrize("name", HOSTILE)
def test_tables_for_spreadsheets_hold_no_formulas(name):
    rows = list(csv.reader(io.StringIO(sheet(name).csv())))
    for cell in (rows[0][0], rows[1][0], rows[2][0]):
        assert not cell.startswith(("=", "+", "-", "@", "\t", "\r", "＝"))
        assert cell.removeprefix("'") == name
    assert [row[1] for row in rows[1:]] == ["1.5", "-2.5", ""]  # numbers stay numbers


def test_text_that_is_a_number_stays_one():
    assert [escape_csv(text) for text in ("-1.5", "+2", "1e-3", "-", "-a", "a=b")] == [
        "-1.5", "+2", "1e-3", "'-", "'-a", "a=b",
    ]  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE)
def test_documents_hold_neither_elements_nor_links(name):
    for text in (sheet(name).markdown(), escape_markdown(f"The network of {name} is better.")):
        assert "<" not in text
        assert "](" not in text
        assert not [c for c in text if c != "\n" and not c.isprintable()]
        text.encode("utf-8")
    assert len(sheet(name).markdown().splitlines()) == 7


@given(st.text(st.characters(codec=None)))
def test_any_text_is_one_line_of_a_document(text):
    shown = escape_markdown(text)
    assert "\n" not in shown
    assert "<" not in shown
    assert printable(printable(text)) == printable(text)


def test_sentences_without_names_are_as_they_were():
    text = "MAE 7.9 mm/s, interval [0.1, 0.2] (k = 10), squeeze_excitation at 5 > 4"
    assert escape_markdown(text) == text


@pytest.mark.filterwarnings("ignore:Glyph")
@pytest.mark.parametrize("name", HOSTILE)
def test_pictures_of_hostile_names_are_well_formed(name, tmp_path):
    def draw(figure):
        axes = figure.subplots()
        axes.plot([0, 1], [0, 1], label=f"x{name}")
        axes.set(title=name, xlabel=name)
        axes.legend()

    svg, png = write_drawings(tmp_path, {"picture": draw})
    text = svg.read_text(encoding="utf-8")
    assert not NOT_XML.search(text)
    root = ElementTree.fromstring(text)
    assert not [e for e in root.iter() if e.tag.endswith(("script", "img", "foreignObject"))]
    assert png.stat().st_size > 1000


@pytest.mark.parametrize("name", HOSTILE)
def test_pages_hold_names_as_text(name):
    held = str(json_text({"name": name}))
    assert "<" not in held
    assert json.loads(held)["name"] == name
    environment = template("page.html.jinja").environment
    assert environment.autoescape is True
    shown = environment.from_string("<p>{{ name }}</p>").render(name=name)
    assert shown.count("<") == 2


def test_marked_rows_are_bold_and_escaped():
    text = replace(sheet("a*b_c"), caption="x").markdown()
    assert "**a\\*b\\_c**" in text
