"""The hand-written pages as a whole: their number of words, code blocks, figures and links."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from edp_site import markdown
from edp_site.links import broken_links

ROOT = Path(__file__).parents[2]
OLD_PAGES = {
    *("commands", "settings"),
}
"""Pages of docs/ that other pages replace, without ``.md``; delete a name here together with its page."""
OUTSIDE = ("findings", "decisions", "journal")
"""Pages and folders that keep history and count nowhere."""
MAX_WORDS_PER_PAGE = 1_500
MAX_WORDS = 50_000
MIN_BLOCKS_PER_1000_WORDS = 6.0
MIN_FIGURES = 40
_PICTURE = re.compile(r"!\[[^\]]*\]\(|<img\s")


def hand_written() -> list[Path]:
    """Return the pages of docs/ and of the site that people write, without history."""
    docs = [page for page in sorted((ROOT / "docs").rglob("*.md")) if _part_of(page) not in OUTSIDE]
    return [*docs, *sorted((ROOT / "website" / "pages").glob("*.md"))]


def _part_of(page: Path) -> str:
    return page.relative_to(ROOT / "docs").with_suffix("").parts[0]


NEW = [page for page in hand_written() if page.stem not in OLD_PAGES or page.parent != ROOT / "docs"]
NOTEBOOKS = sorted((ROOT / "docs" / "tutorials").glob("*.ipynb"))


def words_of(text: str) -> int:
    """Return the number of words outside of code blocks; bars of tables and signs do not count."""
    return sum(bool(re.search(r"\w", word)) for line in markdown.prose(text) for word in line.split())


def text_of(page: Path) -> str:
    """Return a page, or the texts of a notebook with its code in blocks."""
    text = page.read_text(encoding="utf-8")
    if page.suffix != ".ipynb":
        return text
    cells = [(cell["cell_type"], "".join(cell["source"])) for cell in json.loads(text)["cells"]]
    return "\n".join(source if kind == "markdown" else f"```python\n{source}\n```" for kind, source in cells)


def figures_of(page: Path) -> int:
    """Return the number of figures of a page, or of pictures in the outputs of a notebook."""
    text = page.read_text(encoding="utf-8")
    if page.suffix == ".ipynb":
        return text.count('"image/png"')
    return len(_PICTURE.findall("\n".join(markdown.prose(text))))


def test_words_blocks_and_figures_are_counted(tmp_path):
    page = tmp_path / "a.md"
    page.write_text("# One two\n\n| three | - |\n\n```\ncode here\n```\n\n![four](a.png)\n", encoding="utf-8")
    assert words_of(text_of(page)) == 4
    assert figures_of(page) == 1
    book = {"cells": [{"cell_type": "markdown", "source": ["one two"]}, {"cell_type": "code", "source": ["x = 1"]}]}
    (tmp_path / "a.ipynb").write_text(json.dumps(book), encoding="utf-8")
    assert words_of(text_of(tmp_path / "a.ipynb")) == 2
    assert len(list(markdown.fences(text_of(tmp_path / "a.ipynb")))) == 1


@pytest.mark.parametrize("page", NEW, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_a_page_is_short(page):
    assert words_of(text_of(page)) <= MAX_WORDS_PER_PAGE


def test_an_old_page_that_is_gone_has_no_name_here():
    assert {name for name in OLD_PAGES if not (ROOT / "docs" / f"{name}.md").exists()} == set()


def test_all_pages_together_are_short():
    assert sum(words_of(text_of(page)) for page in NEW) <= MAX_WORDS


def test_tutorials_and_howto_pages_show_code():
    pages = [page for page in NEW if page.parent.name in ("howto", "tutorials")]
    texts = [text_of(page) for page in [*pages, *NOTEBOOKS]]
    blocks = sum(len(list(markdown.fences(text))) for text in texts)
    assert blocks / sum(map(words_of, texts)) >= MIN_BLOCKS_PER_1000_WORDS / 1000


def test_there_are_many_figures():
    assert sum(figures_of(page) for page in [*NEW, *NOTEBOOKS]) >= MIN_FIGURES


def test_no_link_of_a_hand_written_page_is_broken():
    pages = [page for page in hand_written() if page.is_relative_to(ROOT / "docs")]
    assert broken_links(pages, ROOT) == []
