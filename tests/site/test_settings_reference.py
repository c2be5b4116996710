"""The reference of settings, which is made from the code."""

import pytest

from edp_site.settings_reference import BASIC, ROOTS, sections_of, settings_page

SECTIONS = [section for table, cls in ROOTS.values() for section in sections_of(table, cls)]


def test_every_key_has_a_meaning():
    assert [key.path for section in SECTIONS for key in section.keys if not key.meaning] == []


@pytest.mark.parametrize("basic", sorted(BASIC))
def test_every_basic_key_exists(basic):
    table, _, kind = basic.rpartition(".")
    keys = {key.path for section in SECTIONS for key in section.keys}
    assert basic in keys or (kind == "kind" and any(path.startswith(table) for path in keys))


def test_the_page_shows_bounds_and_defaults():
    page = settings_page()
    assert (
        "| `epochs` | *basic* | integer | `20` | 1 &lt;= x" in page
        or "| `epochs` | *basic* | integer | `20` | 1 <= x" in page
    )
