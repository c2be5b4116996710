"""Texts of pages and terminal tables, held over every module and template: words, digits and counts."""

import ast
import math
import re
from importlib import resources
from pathlib import Path

import pytest
from browser import EXCAVATOR, excavator_words, long_numbers
from hypothesis import given
from hypothesis import strategies as st

from edp.errors import count_of
from edp.wording import MISSING, figure, interval, number, setting_text

SOURCE = Path(str(resources.files("edp")))
REPORT = SOURCE / "report"
ABOUT_EXCAVATORS = ("animation/", "control/", "assets/side_view.jinja", "assets/animation.html.jinja")
"""Pages of the geometry of an excavator's front; no other machine has them."""
MODULES = sorted(str(path.relative_to(REPORT)) for path in REPORT.rglob("*.py"))
TEMPLATES = sorted(str(path.relative_to(REPORT)) for path in REPORT.rglob("*.jinja"))
ROUNDED_ELSEWHERE = {
    "common/picture.py": "numbers on axes, by Matplotlib",
    "monitor/drawing.py": "coordinates of an SVG, and levels that are constants",
    "animation/film.py": "text drawn as pixels",
    "animation/page.py": "messages, and the names of stretches that the user gave",
    "search/words.py": "settings, exactly as they were given",
}
FINITE = st.floats(allow_nan=False, allow_infinity=False)


def texts_of(tree):
    """String constants of a module, docstrings, keys and names without a blank left out."""
    skipped = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            skipped.add(node.value)
    constants = (node for node in ast.walk(tree) if isinstance(node, ast.Constant) and node not in skipped)
    return [
        node.value
        for node in constants
        if isinstance(node.value, str) and (" " in node.value or node.value[:1].isupper())
    ]


def fields_of(tree):
    """(line, format) of every number that an f-string formats by itself."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FormattedValue) and isinstance(node.format_spec, ast.JoinedStr):
            spec = "".join(part.value for part in node.format_spec.values if isinstance(part, ast.Constant))
            yield node.lineno, spec


@pytest.mark.parametrize("name", [name for name in MODULES if not name.startswith(ABOUT_EXCAVATORS)])
def test_no_module_speaks_of_an_excavator(name):
    assert excavator_words(texts_of(ast.parse((REPORT / name).read_text(encoding="utf-8")))) == []


@pytest.mark.parametrize("name", [name for name in TEMPLATES if not name.startswith(ABOUT_EXCAVATORS)])
def test_no_template_speaks_of_an_excavator(name):
    text = (REPORT / name).read_text(encoding="utf-8")
    shown = re.sub(r"\{[%{#].*?[%}#]\}|<style.*?</style>|<script.*?</script>", " ", text, flags=re.DOTALL)
    labels = re.findall(r'(?:aria-label|title|alt|placeholder)="([^"]*)"', shown)
    assert excavator_words([*labels, *re.sub(r"<[^>]*>", "\n", shown).splitlines()]) == []


def test_the_search_for_words_finds_them():
    assert all(EXCAVATOR.search(word) for word in ("soil", "Levers", "boom cylinder", "the bucket digs"))
    assert not EXCAVATOR.search("soiled")
    assert excavator_words(["boom up"], own=("boom",)) == []
    assert excavator_words(["boom of the bucket"], own=("boom",)) != []


@pytest.mark.parametrize("name", [name for name in MODULES if name not in ROUNDED_ELSEWHERE])
def test_pages_format_numbers_by_one_helper(name):
    """`{x:g}` shows six digits, `{x:.5g}` five: both are for `edp.wording.figure`."""
    found = [
        (line, spec)
        for line, spec in fields_of(ast.parse((REPORT / name).read_text(encoding="utf-8")))
        if re.fullmatch(r"[+,]*(?:\.[5-9])?[gGeE]|[+,]*\.[4-9]f", spec)
    ]
    assert found == []


BARE = re.compile(r"[+,]*(?:\.(?:[5-9]|\d\d|))?[gG]|[+,]*[fFeE]|[+,]*\.(?:[4-9]|\d\d|)[fF]")
"""Formats that show more than four significant digits, or a power of ten for a number of thousands."""
BY_THE_READER = r"(?:[+,]*(?:\.\d*)?[gGfFeE%])"
ROUNDED_OTHERWISE = {
    "wording.py": "holds the helpers",
    "export/": "numbers in exported code, which are exact",
    "testing/": "messages of checks for authors of plug-ins",
    "report/": "held by the test above",
    "settings/bounds.py": "bounds, exactly as they are checked",
    "logs/reference.py": "factors of units, which are exact",
    "training/identification/machine_text.py": "numbers of a machine file, which are read again",
    "monitor/residuals/balances.py": "names of residuals",
    "workflows/api/predictions.py": "names of columns",
}
"""Modules and folders that write numbers which nobody reads in a terminal."""
USER_MODULES = sorted(
    name
    for path in SOURCE.rglob("*.py")
    if not (name := str(path.relative_to(SOURCE))).startswith(tuple(ROUNDED_OTHERWISE))
)


@pytest.mark.parametrize("name", USER_MODULES)
def test_terminal_texts_format_numbers_by_one_helper(name):
    """Commands round by `edp.wording` alone; messages of other modules may fix up to three decimals."""
    rule = re.compile(BY_THE_READER) if name.startswith("cli/") else BARE
    fields = fields_of(ast.parse((SOURCE / name).read_text(encoding="utf-8")))
    assert [(line, spec) for line, spec in fields if rule.fullmatch(spec)] == []


@given(FINITE, st.one_of(st.none(), st.integers(0, 6)), st.booleans())
def test_numbers_have_four_significant_digits_at_most(value, decimals, signed):
    for text in (number(value, decimals, signed), figure(value)):
        assert long_numbers([text]) == []
        assert len(text) <= 26


@given(st.floats(-1e14, 1e14), st.integers(1, 4))
def test_a_figure_has_as_many_digits_as_asked_for(value, digits):
    shown = re.sub(r"e.*", "", figure(value, digits))
    if "." in shown:
        assert len(re.sub(r"\D", "", shown).lstrip("0")) <= digits


@given(st.floats(1e-5, 1e14).flatmap(lambda size: st.sampled_from([size, -size])))
def test_a_figure_is_the_number_to_four_digits(value):
    shown = float(figure(value).replace(",", "").replace("−", "-"))
    assert math.isclose(shown, value, rel_tol=5.1e-4)


@given(st.integers(-(10**14), 10**14))
def test_whole_numbers_are_shown_in_full(value):
    assert figure(value) == number(value, 0) == f"{value:,}".replace("-", "−")


@pytest.mark.parametrize(
    ("value", "text"),
    [(99.98231, "99.98"), (100.0, "100"), (2.5, "2.5"), (9.99996, "10"), (0.0, "0"), (1e-9, "1e−09"),
     (1e300, "1e+300"), (-12345.6, "−12,346"), (None, MISSING), (math.nan, MISSING), (math.inf, MISSING)],
)  # fmt: skip
def test_figures(value, text):
    assert figure(value) == text


def test_long_numbers_are_found():
    assert long_numbers(["0.012345 mm", "12.345", "1,234.5 s"]) == ["0.012345 mm", "12.345", "1,234.5 s"]
    assert long_numbers(["v1.23456.7", "123,456", "12.34", "0.0001234", "14:02:11.25"]) == []


@given(st.floats(-1e6, 1e6), st.floats(1e-3, 1e6))
def test_the_digits_of_an_interval_follow_its_width(low, width):
    high = low + width
    ends = [float(end.replace(",", "").replace("−", "-")) for end in interval(low, high).split(" to ")]
    # Half of the second digit of the width, or what four digits of the ends allow.
    for shown, end in zip(ends, (low, high), strict=True):
        assert abs(shown - end) <= max(0.051 * (high - low), 5.1e-4 * abs(end), 5.1e-7)
    decimals = [len(end.partition(".")[2]) for end in interval(low, high).split(" to ")]
    assert max(decimals) <= max(0, 1 - math.floor(math.log10(high - low)))


@pytest.mark.parametrize(
    ("low", "high", "text"),
    [(1.23456, 1.34567, "1.23 to 1.35"), (12.3, 845.6, "12 to 846"), (-0.01234, 0.0171, "−0.012 to 0.017"),
     (None, 2.0, "– to 2.00"), (1.0, 1.0, "1.0 to 1.0")],
)  # fmt: skip
def test_intervals(low, high, text):
    assert interval(low, high) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [((), "none"), (None, "none"), (("a", "b"), "a, b"), ({"x": [1, 2]}, "x: 1, 2"), (True, "yes"), (0.001, "0.001"),
     (0.123456789, "0.123456789"), (("p", ("q", "r")), "p, q, r")],
)  # fmt: skip
def test_settings_are_words(value, text):
    assert setting_text(value) == text


@pytest.mark.parametrize(
    ("count", "what", "text"),
    [(1, "recording", "1 recording"), (0, "log", "0 logs"), (2, "output", "2 outputs"), (12345, "run", "12,345 runs"),
     (1, "test recording", "1 test recording"), (2, "entry", "2 entries"), (2, "day", "2 days"), (2, "axis", "2 axes"),
     (2, "switch", "2 switches"), ("3", "log", "3 logs"), (None, "log", "– logs")],
)  # fmt: skip
def test_counts(count, what, text):
    assert count_of(count, what) == text


COUNTED = r"(?:recording|log|channel|output|run|training)"
UNCOUNTED = re.compile(rf"\}}\}}?(?: [a-z][a-z-]*)? {COUNTED}(?:s\b(?!/)|\(s\)|\{{)")
"""Such as "{n} recordings", "{n} log(s)" and "{n} run{'s' * (n > 1)}"; folders (runs/first) are no counts."""
TEXTS = sorted(
    path
    for folder in ("report", "cli", "workflows")
    for path in (SOURCE / folder).rglob("*")
    if path.suffix in (".py", ".jinja")
)


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: str(path.relative_to(SOURCE)))
def test_counts_are_worded_by_one_helper(path):
    """`count_of(n, "recording")` is "1 recording", where ``f"{n} recordings"`` would say "1 recordings"."""
    lines = path.read_text(encoding="utf-8").splitlines()
    assert [line.strip() for line in lines if UNCOUNTED.search(line)] == []


@pytest.mark.parametrize(
    "line",
    [
        'f"{n} recordings"',
        'f"{n} log(s)"',
        'f"{len(x)} free runs of"',
        "{{ n }} channels",
        "f\"{n} run{'s' * (n > 1)}\"",
    ],
)
def test_the_search_for_counts_finds_them(line):
    assert UNCOUNTED.search(line)
