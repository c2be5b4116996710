"""The checks of the language find what the style guide excludes, and the repository holds to them."""

import sys
from collections import Counter
from pathlib import Path

import pytest

import edp

sys.path.insert(0, str(Path(__file__).parents[1] / "language"))
import english
import reading

OLD = (
    "What a training that ends here gives; this one is over with it.",
    "Of the data that each part is to have.",
    "Errors of a look-ahead predictor beside the twin.",
    "Print a line a log, then each kind.",
    "A course judged on others.",
    "A value that is no number.",
)
NEW = (
    "End training before the current epoch is complete and return the fitted model with the best weights so far.",
    "Return the fraction of the data for training, validation and test.",
    "Compare the twin with a k-step-ahead predictor at the same samples, for their common outputs.",
    "Print one line per log, then each type of finding once with the logs affected.",
)


@pytest.mark.parametrize("text", OLD)
def test_sentences_that_readers_did_not_understand_are_found(text):
    assert english.check_text(text)


@pytest.mark.parametrize("text", NEW)
def test_rewritten_sentences_pass(text):
    assert not english.check_text(text)


def test_names_and_docstrings_of_a_module_are_checked():
    source = 'def of(x):\n    """Of a series."""\n\ndef read_x(x):\n    """Return the value."""\n'
    assert {finding.rule for finding in english.check_module(source, "a.py")} == {
        "relative clause as a noun",
        "name of a function",
    }


def test_code_blocks_of_a_page_are_not_checked():
    page = "# Title\n\nThe model beside it.\n\n```sh\njudge --beside\n```\n"
    assert [finding.line for finding in english.check_page(page, "a.md")] == [3]


def test_new_files_have_no_findings_and_old_ones_no_more_than_before():
    counts = Counter(finding.file for finding in english.check_repository())
    assert english.compare_with_allowed(counts, english.read_allowed()) == []


def test_more_findings_than_allowed_are_reported():
    assert len(english.compare_with_allowed(Counter({"a.py": 2, "b.py": 1, "c.py": 1}), {"a.py": 1, "b.py": 1})) == 2


def test_allowed_numbers_are_lowered_and_never_raised():
    allowed = {"a.py": 2, "b.py": 1, "gone.py": 4}
    assert english.lower_allowed(Counter({"a.py": 1, "b.py": 3, "new.py": 2}), allowed) == {"a.py": 1, "b.py": 1}


def test_docstrings_of_the_public_interface_have_no_findings():
    documented = {name: (getattr(edp, name).__doc__ or "") for name in edp.__all__ if callable(getattr(edp, name))}
    flagged = {name: english.check_text(" ".join(text.split("\n\n")[0].split())) for name, text in documented.items()}
    assert not {name: rules for name, rules in flagged.items() if rules}


def test_reading_test_draws_the_same_items_for_a_seed_without_file_names(tmp_path):
    items = reading.draw_items(3)
    assert items == reading.draw_items(3) != reading.draw_items(4)
    assert Counter(item.kind for item in items)["docstring"] == reading.COUNTS["docstring"]
    reading.write_items(items, tmp_path)
    text = (tmp_path / "items.md").read_text()
    assert text.count("\n## ") == len(items)
    assert "src/edp" not in text.replace("``src/edp``", "")


def test_score_counts_unmarked_items_as_wrong_and_leaves_controls_out():
    key = {"1": {"kind": "name"}, "2": {"kind": "name"}, "3": {"kind": reading.CONTROL}}
    assert reading.score(key, {"1": True, "3": True}) == {"name": 0.5, "all": 0.5, "control": 1.0}
