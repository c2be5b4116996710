"""The gallery: the pages that `edp demo` and other commands wrote, copied into the site as they are."""

from __future__ import annotations

import html
import re
import shutil
from pathlib import Path

_TITLE = re.compile(r"<title>(.*?)</title>", re.DOTALL | re.IGNORECASE)
MOST_BYTES = 8_000_000
"""A page that is larger is named, not copied."""


def write_gallery(pages: Path, demo: Path | None) -> None:
    """Write the gallery's page, and beside it the pages of a demo.

    Args:
        pages: folder of the site's pages.
        demo: folder that holds ``.html`` pages at any depth; None, or one without pages: the gallery says how to
            get them.
    """
    found = sorted(demo.rglob("*.html")) if demo and demo.is_dir() else []
    text = (pages / "gallery.md").read_text(encoding="utf-8")
    rows = []
    for path in found:
        name = "_".join(path.relative_to(demo).parts) if demo else path.name
        title = _TITLE.search(path.read_text(encoding="utf-8", errors="replace")[:20_000])
        shown = html.unescape(title[1]).strip() if title else name
        size = path.stat().st_size
        if size <= MOST_BYTES:
            (pages / "gallery").mkdir(exist_ok=True)
            shutil.copy(path, pages / "gallery" / name)
            rows.append(f"* [{shown}](gallery/{name}) ({size / 1e6:.1f} MB, `{path.name}`)")
        else:
            rows.append(f"* {shown}: {size / 1e6:.1f} MB, too large to be copied")
    listed = "\n".join(rows) if rows else "This site was built without them."
    (pages / "gallery.md").write_text(text.replace("<!-- pages of the demo -->", listed), encoding="utf-8")
