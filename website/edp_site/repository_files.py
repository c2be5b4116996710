"""Files of the repository that pages link to: settings, scripts, results; each becomes a page of the site."""

from __future__ import annotations

from pathlib import Path

_LANGUAGES = {".py": "python", ".toml": "toml", ".json": "json", ".c": "c", ".h": "c", ".sh": "sh", ".md": "markdown"}
MAX_SHOWN = 60_000
"""Bytes of a file that a page shows whole: measured figures can be megabytes."""
MAX_LISTED = 60
"""Files of a folder that a page lists."""
_HIDDEN = "---\nsearch:\n  exclude: true\n---\n\n"
"""The search of the site shall find what is said of a file, not each line of it."""


def file_page(path: Path, name: str) -> str:
    """Return a page that shows a file.

    Args:
        path: the file.
        name: its path in the repository, the title.
    """
    size = path.stat().st_size
    try:
        text = path.read_text(encoding="utf-8") if size <= MAX_SHOWN else ""
    except UnicodeDecodeError:
        text = ""
    if not text:
        return f"{_HIDDEN}# {name}\n\n{size:,} bytes; in the repository at this path.\n"
    fence = "`" * 4
    return f"{_HIDDEN}# {name}\n\n{fence}{_LANGUAGES.get(path.suffix, 'text')}\n{text.rstrip()}\n{fence}\n"


def folder_page(folder: Path, name: str, linked: dict[str, str]) -> str:
    """Return a page that lists a folder.

    Args:
        folder: the folder.
        name: its path in the repository, the title.
        linked: by file name, the page that shows it.
    """
    names = sorted(path.name for path in folder.iterdir() if not path.name.startswith((".", "__")))
    rows = [f"* [{entry}]({linked[entry]})" if entry in linked else f"* {entry}" for entry in names[:MAX_LISTED]]
    return f"{_HIDDEN}# {name}\n\n" + "\n".join(rows) + "\n"
