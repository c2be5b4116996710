"""Text that a reader sees on a page, compared with a file, so that no word of a page gets lost unnoticed."""

from __future__ import annotations

import os
import re
from html.parser import HTMLParser
from pathlib import Path

GOLDEN = Path(__file__).parents[1] / "golden" / "pages"
UPDATE = "EDP_UPDATE_PAGES"
"""Variable that writes the files anew: look at the difference before it is committed."""
LINES = frozenset(
    (
        *("title", "p", "h1", "h2", "h3", "li", "tr", "caption", "summary", "dt", "a", "option", "label", "button"),
        *("pre", "figcaption", "footer", "text", "strong", "dl", "div"),
    )
)
CELLS = frozenset(("td", "th", "dd", "span", "small", "b"))
UNSEEN = frozenset(("style", "script"))


class _Text(HTMLParser):
    """Lines of a page: one an element, cells of a row with a bar between them."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.parts: list[str] = []
        self.unseen = 0
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.unseen += tag in UNSEEN
        named = dict(attrs).get("aria-label")
        if named and tag in ("svg", "canvas"):
            self.parts.append(f"\n[{named}]\n")
        self.parts.append("\n" if tag in LINES else " | " if tag in CELLS else "")

    def handle_endtag(self, tag: str) -> None:
        self.unseen -= tag in UNSEEN
        self.parts.append("\n" if tag in LINES else " ")

    def handle_data(self, data: str) -> None:
        if not self.unseen:
            self.parts.append(re.sub(r"\s+", " ", data))


def shown_text(page: str) -> str:
    """Return the text of a page, one line an element."""
    lines = (re.sub(r"[ \n]+", " ", line).strip(" |") for line in "".join(_Text(page).parts).splitlines())
    return "\n".join(filter(None, lines)) + "\n"


def check_text(page: str, name: str) -> None:
    """Compare the text of a page with ``tests/golden/pages/NAME.txt``."""
    file, text = GOLDEN / f"{name}.txt", shown_text(page)
    if os.environ.get(UPDATE):
        file.parent.mkdir(exist_ok=True)
        file.write_text(text, encoding="utf-8")
    assert text.splitlines() == file.read_text(encoding="utf-8").splitlines(), f"{UPDATE}=1 writes the text anew"
