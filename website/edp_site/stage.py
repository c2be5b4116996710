"""Input of the site builder: hand-written pages, generated pages, and the files that the pages link to."""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

from edp_site import (
    commands,
    errors,
    formats,
    gallery,
    journal,
    markdown,
    notebooks,
    parts,
    python_api,
    repository_files,
    result_files,
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
"""Pages outside of docs/ and their place on the site."""
_OUTSIDE = ("http://", "https://", "mailto:", "data:", "#")
_FOLDERS_SHOWN = ("examples",)
"""Folders for which a link to the folder shows a page for each file."""


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
    gallery.write_gallery(pages, demo)
    for path in sorted((root / "docs" / "tutorials").glob("*.ipynb")):
        folder = pages / "tutorials"
        _write(folder / f"{path.stem}.md", notebooks.notebook_page(path, folder / "pictures"))
    shutil.copytree(root / "docs" / "images", pages / "images")
    shutil.copytree(root / "website" / "theme", pages / "theme")
    if version is not None:
        script = pages / "theme" / "site.js"
        text = script.read_text(encoding="utf-8")
        script.write_text(f"window.edpVersion = {json.dumps(version)};\n{text}", encoding="utf-8")
    _Copier(root, pages).copy(_made(root))
    (out / "mkdocs.yml").write_text(builder_settings(root / "mkdocs.yml", pages), encoding="utf-8")
    return sorted(pages.rglob("*.md"))


def _made(root: Path) -> dict[str, Callable[[], str]]:
    """Return the function for each generated page; a page of docs/ with the same place is its introduction."""
    benchmarks = results.read_benchmarks(root)
    made: dict[str, Callable[[], str]] = {
        "reference/commands.md": commands.commands_page,
        "reference/settings.md": settings_reference.settings_page,
        "reference/python.md": python_api.python_page,
        "reference/parts.md": parts.parts_page,
        "reference/errors.md": errors.errors_page,
        "reference/formats.md": formats.formats_page,
        "reference/files.md": result_files.files_page,
        "reference/c.md": formats.c_page,
        "results.md": lambda: results.results_page(benchmarks),
        "leaderboard.md": lambda: results.leaderboard_page(benchmarks),
        "decisions/index.md": lambda: journal.decisions_page(root / "docs" / "decisions"),
        "journal/index.md": lambda: journal.journal_page(journal.read_journal(root / "docs" / "journal")),
    }
    for page in benchmarks.pages:
        made[f"results/{page.script}.md"] = partial(results.benchmark_page, benchmarks, page)
    return made


def builder_settings(path: Path, pages: Path) -> str:
    """Return the settings of the builder for a folder of pages.

    Menu entries of missing pages are omitted. ``- How-to: howto/*.md`` becomes a group of the pages of that folder
    without an entry of their own, ``- howto/*.md`` becomes their entries.
    """
    text = path.read_text(encoding="utf-8")
    lines = []
    for line in text.splitlines():
        entry = re.fullmatch(r"(\s+)- (?:(.+): )?([\w./*-]+\.md)", line)
        if entry and "*" in entry[3]:
            names = [page.relative_to(pages).as_posix() for page in pages.glob(entry[3])]
            names = sorted((name for name in names if name not in text), key=lambda name: ("/index." not in name, name))
            indent = entry[1] + 4 * " " if entry[2] else entry[1]
            lines += [f"{entry[1]}- {entry[2]}:"] if entry[2] and names else []
            lines += [f"{indent}- {name}" for name in names]
            continue
        if entry and not (pages / entry[3]).exists():
            continue
        line = re.sub(r"^docs_dir:.*", "docs_dir: pages", line)
        lines.append(re.sub(r"^site_dir:.*", "site_dir: site", line))
    return "\n".join(lines) + "\n"


class _Copier:
    """Copy of the hand-written pages and of the files that they link to, with the links of the site."""

    def __init__(self, root: Path, pages: Path) -> None:
        self.root, self.pages = root.resolve(), pages
        self.shown: set[Path] = set()

    def copy(self, made: dict[str, Callable[[], str]]) -> None:
        """Write all pages of docs/ and of the project, followed by the generated content for their place.

        Args:
            made: function that generates a page, by place.
        """
        sources = {path: Path(*path.relative_to(self.root / "docs").parts) for path in self.root.glob("docs/**/*.md")}
        sources |= {self.root / name: Path(place) for name, place in _PROJECT_PAGES.items()}
        for source, place in sources.items():
            text = source.read_text(encoding="utf-8")
            targets = {link.target for link in markdown.links(text) if not link.target.startswith(_OUTSIDE)}
            moved = {target: self._moved(source, place, target) for target in targets}
            generated = made.get(place.as_posix())
            _write(self.pages / place, markdown.with_links(text, moved) + (f"\n{generated()}" if generated else ""))
        for name, make in made.items():
            if Path(name) not in sources.values():
                _write(self.pages / name, make())

    def _moved(self, source: Path, place: Path, target: str) -> str:
        """Return a link of `source` as it must be in a page at `place`."""
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
        if name in (Path("docs/decisions"), Path("docs/journal")):
            return Path(name.name) / "index.md"
        if name == Path("benchmarks/results"):
            return Path("results.md")
        if name.parent == Path("benchmarks/results"):
            return Path("results") / f"{results.read_result(linked).script}.md"
        if name.parts[0] == "docs" and linked.is_file():
            place = Path(*name.parts[1:])
            return place.with_suffix(".md") if place.suffix == ".ipynb" else place
        return self._show(linked)

    def _show(self, linked: Path) -> Path:
        """Return the page that shows a file or lists a folder of the repository; write it at the first call."""
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
        """Return the pages of the files of a folder by name, as links from the page of the folder."""
        if folder.relative_to(self.root).parts[0] not in _FOLDERS_SHOWN:
            return {}
        files = sorted(path for path in folder.iterdir() if path.is_file() and path.suffix in (".toml", ".py"))
        return {path.name: self._show(path).name for path in files}


def _write(path: Path, text: str) -> None:
    """Write a page. Its headings get the anchors of GitHub, since the builder has other rules."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = text.splitlines()
    for heading in markdown.headings(text):
        line = lines[heading.line - 1].rstrip()
        if not line.endswith("}"):
            lines[heading.line - 1] = f"{line} {{ #{heading.anchor} }}"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
