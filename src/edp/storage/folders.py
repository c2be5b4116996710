"""Kinds of EDP folders, and the check before a command writes into a folder."""

from __future__ import annotations

from pathlib import Path

from edp.errors import StorageError
from edp.storage.paths import is_entry_at

MARKS = {
    "run.json": "run",
    "store.json": "store",
    "study.json": "study",
    "monitor.json": "monitor",
    "entries": "registry",
    "fleet.json": "fleet",
    "export.sha256": "export",
    "bundle.json": "network",
    "twin.json": "twin",
    "controller.json": "controller",
}
"""File or folder that identifies a type of EDP folder, with the name of the type. The first match decides."""


def kind_of(folder: str | Path) -> str | None:
    """Return the kind of an EDP folder (a key in `MARKS`); None for an absent, empty or foreign folder.

    Raises:
        StorageError: the folder cannot be looked into.
    """
    return next((kind for mark, kind in MARKS.items() if is_entry_at(Path(folder, mark))), None)


def check_kind(folder: str | Path, *allowed: str, what: str) -> None:
    """Refuse to write into a folder of another kind.

    Args:
        folder: output folder of a command.
        allowed: kinds of `MARKS` that the command may write into, beside absent, empty and foreign folders.
        what: the command, for the message.

    Raises:
        StorageError: it is a folder of another kind; nothing was changed.
    """
    kind = kind_of(folder)
    if kind is not None and kind not in allowed:
        article = "an" if kind[0] in "aeiou" else "a"
        raise StorageError(
            f"'{folder}' is the folder of {article} {kind}, into which {what} does not write; nothing was changed. "
            "Choose a new or empty folder"
        )
