"""Check of the links and anchors of Markdown pages."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from pathlib import Path

from edp_site import markdown

_OUTSIDE = ("http://", "https://", "mailto:", "data:")


def broken_links(pages: Iterable[Path], root: Path) -> list[str]:
    """Return the links to missing files, folders or anchors, and the links out of the repository.

    Args:
        pages: Markdown files.
        root: folder that every target must lie in.

    Returns:
        A line for each problem: page, line, target, and what is wrong.
    """
    problems = []
    for page in sorted(pages):
        for link in markdown.links(page.read_text(encoding="utf-8")):
            if link.target.startswith(_OUTSIDE):
                continue
            if reason := _reason(page, link.target, root):
                problems.append(f"{page.relative_to(root)}:{link.line}: {link.target}: {reason}")
    return problems


def _reason(page: Path, target: str, root: Path) -> str:
    """Return why a link is broken; empty for a valid link."""
    name, _, anchor = target.partition("#")
    place = (page.parent / name).resolve() if name else page.resolve()
    if not place.is_relative_to(root.resolve()):
        return "leads out of the repository"
    if not place.exists():
        return "there is no such file"
    if anchor and place.suffix == ".md" and anchor not in _anchors(place, place.stat().st_mtime_ns):
        return f"the page has no heading with the anchor '{anchor}'"
    return ""


@cache
def _anchors(page: Path, changed_ns: int) -> set[str]:
    return markdown.anchors(page.read_text(encoding="utf-8"))
