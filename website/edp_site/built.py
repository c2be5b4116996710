"""Checks of the built site: links and anchors, nothing loaded from elsewhere, and what a page needs for every reader.

``python -m edp_site.built SITE`` takes addresses out of the scripts of the theme, makes the search work
from files, prints what is wrong, and ends with 1 where something is.
"""

from __future__ import annotations

import json
import re
import sys
from html.parser import HTMLParser
from pathlib import Path
from typing import NamedTuple
from urllib.parse import unquote

_OUTSIDE = re.compile(r"^(?:[a-z][a-z0-9+.-]*:)?//", re.IGNORECASE)
_LOADED = {
    "script": "src",
    "img": "src",
    "iframe": "src",
    "source": "src",
    "video": "src",
    "audio": "src",
    "object": "data",
}
"""Elements that load what an attribute names when the page is opened; those of `link` depend on their relation."""
_LOADING_RELATIONS = {
    "stylesheet",
    "icon",
    "preload",
    "prefetch",
    "preconnect",
    "dns-prefetch",
    "modulepreload",
    "manifest",
}
_IN_STYLES = re.compile(r"(?:@import\s+|url\()\s*['\"]?((?:https?:)?//[^'\")\s]+)", re.IGNORECASE)
_IN_SCRIPTS = re.compile(r"https?://(?!www\.w3\.org/|fontawesome\.com)[\w.-]+")
"""Addresses in scripts; those of the exceptions name vocabularies of markup, and a licence in a comment."""
NOWHERE = "about:blank#"
_UNNEEDED = {"404.html"}
"""Pages whose links begin at the root of a server."""


class Page(NamedTuple):
    """What one page holds.

    Attributes:
        anchors: ids and names that a link may lead to.
        links: targets of links.
        loaded: what opening the page loads.
        problems: what a reader without eyes or mouse would miss.
    """

    anchors: frozenset[str]
    links: tuple[str, ...]
    loaded: tuple[str, ...]
    problems: tuple[str, ...]


class _Reader(HTMLParser):
    def __init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self.anchors: set[str] = set()
        self.links: list[str] = []
        self.loaded: list[str] = []
        self.problems: list[str] = []
        self.titles = self.first_headings = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.anchors |= {str(given[name]) for name in ("id", "name") if given.get(name)}
        self.titles += tag == "title"
        self.first_headings += tag == "h1"
        if tag == "a" and given.get("href"):
            self.links.append(str(given["href"]))
        relations = set(str(given.get("rel", "")).lower().split())
        if tag in _LOADED and given.get(_LOADED[tag]):
            self.loaded.append(str(given[_LOADED[tag]]))
        elif tag == "link" and relations & _LOADING_RELATIONS:
            self.loaded.append(str(given.get("href")))
        self.loaded += _IN_STYLES.findall(str(given.get("style", "")))
        if tag == "html" and not given.get("lang"):
            self.problems.append("the page states no language")
        if tag == "img" and not given.get("alt"):
            self.problems.append(f"a picture without a text: {given.get('src')}")


def read_page(path: Path) -> Page:
    """Return the parts of a page that the checks need."""
    reader = _Reader()
    reader.feed(path.read_text(encoding="utf-8", errors="replace"))
    problems = list(reader.problems)
    if not reader.titles:
        problems.append("the page has no title")
    if reader.first_headings != 1:
        problems.append(f"{reader.first_headings} headings of the first level; one must hold")
    return Page(frozenset(reader.anchors), tuple(reader.links), tuple(reader.loaded), tuple(problems))


def problems_of(site: Path) -> list[str]:
    """Broken links and anchors, loads from elsewhere, and missing texts of a built site, a line each.

    Pages in ``gallery/`` are reports that EDP wrote: of them only what they load is looked at.
    """
    files = sorted(site.rglob("*.html"))
    pages = {path.resolve(): read_page(path) for path in files}
    problems = [] if len(pages) > 1 else [f"'{site}' holds no built site"]
    for path, page in pages.items():
        name = path.relative_to(site.resolve()).as_posix()
        problems += [f"{name}: loads {target}" for target in page.loaded if _OUTSIDE.match(target)]
        if name not in _UNNEEDED and not name.startswith("gallery/"):
            problems += [f"{name}: {problem}" for problem in page.problems]
            problems += _broken(path, page, name, pages)
    for path in sorted((site / "assets").rglob("*.js")):
        found = _IN_SCRIPTS.findall(path.read_text(encoding="utf-8", errors="replace"))
        problems += [f"{path.relative_to(site)}: could load from {address}" for address in sorted(set(found))]
    for path in sorted(site.rglob("*.css")):
        found = _IN_STYLES.findall(path.read_text(encoding="utf-8", errors="replace"))
        problems += [f"{path.relative_to(site)}: loads {target}" for target in found]
    return problems


def seal(site: Path) -> int:
    """Take addresses out of the scripts of the theme, which load diagrams, viewers and the like from elsewhere.

    No page of ours asks for those; without the addresses none can by mistake.

    Returns:
        How many addresses were replaced.
    """
    replaced = 0
    for path in sorted((site / "assets").rglob("*.js")):
        text, count = _IN_SCRIPTS.subn(NOWHERE, path.read_text(encoding="utf-8"))
        if count:
            path.write_text(text, encoding="utf-8")
        replaced += count
    return replaced


def search_from_files(site: Path) -> Path:
    """Write the script that a page which was opened as a file reads in place of the index and the worker of its search.

    A page of a file may fetch neither; scripts it may load. ``theme/site.js`` hands the worker's text to the browser.

    Raises:
        FileNotFoundError: the builder wrote no index.
    """
    workers = {path.name: path.read_text(encoding="utf-8") for path in sorted((site / "assets").rglob("workers/*.js"))}
    index = json.loads((site / "search.json").read_text(encoding="utf-8"))
    script = site / "search.js"
    script.write_text(
        f"var __index = {json.dumps(index)};\nwindow.edpWorkers = {json.dumps(workers)};\n", encoding="utf-8"
    )
    return script


def _broken(path: Path, page: Page, name: str, pages: dict[Path, Page]) -> list[str]:
    found = []
    for link in page.links:
        if _OUTSIDE.match(link) or re.match(r"^[a-z][a-z0-9+.-]*:", link):
            continue
        target, _, anchor = unquote(link).partition("#")
        target = target.partition("?")[0]
        place = (path.parent / target).resolve() if target else path
        place = place / "index.html" if place.is_dir() else place
        if not place.exists():
            found.append(f"{name}: {link}: there is no such file")
        elif anchor and place in pages and anchor not in pages[place].anchors and anchor != "__codelineno":
            found.append(f"{name}: {link}: the page has no such anchor")
    return found


def main() -> int:
    """Check the site that is named; 1 where something is wrong."""
    site = Path(sys.argv[1])
    seal(site)
    search_from_files(site)
    problems = problems_of(site)
    size = sum(path.stat().st_size for path in site.rglob("*") if path.is_file())
    print(
        "\n".join(
            [*problems, f"{len(list(site.rglob('*.html')))} pages, {size / 1e6:.1f} MB, {len(problems)} problems"]
        )
    )
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
