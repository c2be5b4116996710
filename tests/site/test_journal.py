"""Form of the journal: fields, length, tags, and what the page shows of each finding."""

from __future__ import annotations

from pathlib import Path

import pytest

from edp_site.journal import MAX_WORDS, TAGS, journal_page, read_finding, read_journal

FOLDER = Path(__file__).parents[2] / "docs" / "journal"
FINDINGS = read_journal(FOLDER)
FORM = """# A is faster than B

- Question: Is A faster than B?
- Setup: One core.
- Result: A 1 s | B 2 s.
- Conclusion: A is used.
- Command: `edp demo`
- Date: 2026-01-31 (`01234567`)
- Tags: speed, training
"""


def test_every_file_of_the_journal_is_a_finding_with_a_number_of_its_own():
    numbers = [one.name[:4] for one in FINDINGS]
    assert len(FINDINGS) == len(list(FOLDER.iterdir()))
    assert len(set(numbers)) == len(numbers)
    assert numbers == sorted(numbers)
    assert len({one.title for one in FINDINGS}) == len(FINDINGS)


def test_findings_are_short_and_every_tag_is_used():
    assert [one.name for one in FINDINGS if one.words > MAX_WORDS] == []
    assert {tag for one in FINDINGS for tag in one.tags} == set(TAGS)


def test_the_page_has_a_row_per_finding(tmp_path):
    (tmp_path / "0001-a.md").write_text(FORM, encoding="utf-8")
    (finding,) = read_journal(tmp_path)
    assert finding.tags == ("speed", "training")
    assert finding.words == 17
    row = "| [A is faster than B](0001-a.md) | A is used. | speed, training | <time>2026-01-31</time> |"
    assert row in journal_page([finding]).splitlines()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("- Setup: One core.\n", "", "got fields"),
        ("- Setup: One core.\n", "One core.\n", "got fields"),
        ("speed", "sped", r"got tags \['sped'\]"),
        ("# A", "A", "expected a title"),
    ],
)
def test_another_form_is_refused(tmp_path, old, new, message):
    (tmp_path / "0001-a.md").write_text(FORM.replace(old, new), encoding="utf-8")
    with pytest.raises(ValueError, match=message):
        read_finding(tmp_path / "0001-a.md")
