"""The reference page of channels, kinds and units is what the code knows."""

from pathlib import Path

from edp.logs.reference import reference_page
from edp.logs.units import normalise_unit
from edp.signals import KINDS, UNITS, VOCABULARY

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "channels.md"


def test_page_is_that_of_the_code():
    assert PAGE.read_text(encoding="utf-8") == reference_page(), "write it with python -m edp.logs.reference"


def test_page_names_everything():
    page = reference_page()
    spans = ("Ground_", "Fault_")  # named by their first and last
    for name in [*KINDS, *UNITS, *(name for name in VOCABULARY if not name.startswith(spans))]:
        assert f"`{name}`" in page, name


def test_german_spellings():
    assert [normalise_unit(unit) for unit in ("U/min", "1/min", "°C", "Grad")] == ["rpm", "rpm", "degC", "deg"]
