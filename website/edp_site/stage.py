"""Lays out what the builder of the site reads: hand-written pages, pages made from the code, and files they link to."""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path

from edp_site import (
    commands,
    formats,
    gallery,
    markdown,
    notebooks,
    parts,
    python_api,
    repository_files,
    results,
    settings_reference,
)

ROOT = Path(__file__).parents[2]
_PROJECT_PAGES = {
    "README.md": "project/readme.md",
    "CONTRIBUTING.md": "project/contributing.md",
    "CHANGELOG.md": "project/changelog.md",
    "SECURITY.md": "project/security.md",
}
"""Pages beside docs/ by their place on the site."""
_OUTSIDE = ("http://", "https://", "mailto:", "data:", "#")
_FOLDERS_SHOWN = ("examples",)
"""Folders whose files get a page each where the folder itself is linked to."""


def stage(out: Path, demo: Path | None = None, root: Path = ROOT, version: str | None = None) -> list[Path]:
    """Write the pages of the site and the builder's settings.

    Args:
        out: folder that is emptied first; ``pages`` and ``mkdocs.yml`` lie in it then.
        demo: folder of `edp demo`, whose pages go into the gallery; without one the gallery says how to make them.
        root: of the repository.
        version: that the pages are of; they then have a selector of the versions beside theirs.

    Returns:
        The Markdown pages that were written.
    """
    pages = out / "pages"
    shutil.rmtree(pages, ignore_errors=True)
    pages.mkdir(parents=True)
    for path in sorted((root / "website" / "pages").glob("*.md")):
        _write(pages / path.name, path.read_text(encoding="utf-8"))
    for name, make in _made(root).items():
        _write(pages / name, make())
    gallery.write_gallery(pages, demo)
    for path in sorted((root / "examples" / "notebooks").glob("*.ipynb")):
        folder = pages / "notebooks"
        _write(folder / f"{path.stem}.md", notebooks.notebook_page(path, folder / "pictures"))
    shutil.copytree(root / "docs" / "images", pages / "images")
    shutil.copytree(root / "website" / "theme", pages / "theme")
    if version is not None:
        script = pages / "theme" / "site.js"
        text = script.read_text(encoding="utf-8")
        script.write_text(f"window.edpVersion = {json.dumps(version)};\n{text}", encoding="utf-8")
    _Copier(root, pages).copy()
    (out / "mkdocs.yml").write_text(builder_settings(root / "mkdocs.yml", pages), encoding="utf-8")
    return sorted(pages.rglob("*.md"))


def _made(root: Path) -> dict[str, Callable[[], str]]:
    return {
        "reference/commands.md": commands.commands_page,
        "reference/settings.md": settings_reference.settings_page,
        "reference/python.md": python_api.python_page,
        "reference/parts.md": parts.parts_page,
        "reference/formats.md": formats.formats_page,
        "reference/c.md": formats.c_page,
        "leaderboard.md": lambda: results.results_page(
            root / "benchmarks" / "results",
            results.read_goals(root / "benchmarks" / "goals.toml"),
            results.read_archive(root / "benchmarks" / "archive.toml"),
        ),
        "decisions/index.md": lambda: decisions_page(root / "docs" / "decisions"),
    }


def decisions_page(folder: Path) -> str:
    """A table of the decisions by number."""
    lines = [
        "# Decisions",
        "",
        "What was decided, why, and what was given up for it.",
        "",
        "| No. | Decision |",
        "|---|---|",
    ]
    for path in sorted(folder.glob("*.md")):
        first = markdown.headings(path.read_text(encoding="utf-8"))[0]
        title = re.sub(r"^\d+[.:]?\s*", "", first.text)
        lines.append(f"| {path.name[:4]} | [{title}]({path.name}) |")
    return "\n".join(lines) + "\n"


def builder_settings(path: Path, pages: Path) -> str:
    """The settings of the builder for pages that lie beside them; entries of pages that are not there are left out."""
    lines = []
    for line in path.read_text(encoding="utf-8").splitlines():
        entry = re.fullmatch(r"\s+- (?:.+: )?([\w./-]+\.md)", line)
        if entry and not (pages / entry[1]).exists():
            continue
        line = re.sub(r"^docs_dir:.*", "docs_dir: pages", line)
        lines.append(re.sub(r"^site_dir:.*", "site_dir: site", line))
    return "\n".join(lines) + "\n"


class _Copier:
    """Copies hand-written pages, and whatever in the repository they link to, with links that hold on the site."""

    def __init__(self, root: Path, pages: Path) -> None:
        self.root, self.pages = root.resolve(), pages
        self.shown: set[Path] = set()

    def copy(self) -> None:
        """All pages of docs/ and of the project."""
        sources = {path: Path(*path.relative_to(self.root / "docs").parts) for path in self.root.glob("docs/**/*.md")}
        sources |= {self.root / name: Path(place) for name, place in _PROJECT_PAGES.items()}
        for source, place in sources.items():
            text = source.read_text(encoding="utf-8")
            targets = {link.target for link in markdown.links(text) if not link.target.startswith(_OUTSIDE)}
            moved = {target: self._moved(source, place, target) for target in targets}
            _write(self.pages / place, markdown.with_links(text, moved))

    def _moved(self, source: Path, place: Path, target: str) -> str:
        """A link of `source`, which goes to `place`, as it must read there."""
        name, hash_sign, anchor = target.partition("#")
        linked = (source.parent / name).resolve()
        if not name or not linked.exists() or not linked.is_relative_to(self.root):
            return target  # the check of links tells
        there = self._place_of(linked)
        return os.path.relpath(there, place.parent).replace(os.sep, "/") + hash_sign + anchor

    def _place_of(self, linked: Path) -> Path:
        name = linked.relative_to(self.root)
        if name.as_posix() in _PROJECT_PAGES:
            return Path(_PROJECT_PAGES[name.as_posix()])
        if name == Path("docs/decisions"):
            return Path("decisions/index.md")
        if name.parts[0] == "docs" and linked.is_file():
            return Path(*name.parts[1:])
        return self._show(linked)

    def _show(self, linked: Path) -> Path:
        """The page that shows a file or lists a folder of the repository; written the first time."""
        name = linked.relative_to(self.root)
        if linked.is_dir():
            place = Path("files") / name / "index.md"
        else:
            place = Path("files") / name.with_name(f"{name.name}.md")
        if linked not in self.shown:
            self.shown.add(linked)
            if linked.is_dir():
                text = repository_files.folder_page(linked, name.as_posix(), self._within(linked))
            else:
                text = repository_files.file_page(linked, name.as_posix())
            _write(self.pages / place, text)
        return place

    def _within(self, folder: Path) -> dict[str, str]:
        """Pages of the files of a folder by name, as links from the folder's page."""
        if folder.relative_to(self.root).parts[0] not in _FOLDERS_SHOWN:
            return {}
        files = sorted(path for path in folder.iterdir() if path.is_file() and path.suffix in (".toml", ".py"))
        return {path.name: self._show(path).name for path in files}


def _write(path: Path, text: str) -> None:
    """A page, whose headings get the anchors that they have on GitHub, where the builder would make others."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = text.splitlines()
    for heading in markdown.headings(text):
        line = lines[heading.line - 1].rstrip()
        if not line.endswith("}"):
            lines[heading.line - 1] = f"{line} {{ #{heading.anchor} }}"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
