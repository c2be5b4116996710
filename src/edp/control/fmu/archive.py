"""The archive of an FMU, which may be a stranger's: names, kinds and sizes are checked before anything is unpacked."""

from __future__ import annotations

import stat
import struct
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from edp.errors import ConfigError, DataError

MOST_FILE = 1 << 28
"""Bytes of the file: tools pack solvers and tables of some 100 MB."""
MOST_UNPACKED = 1 << 29
"""Bytes of all entries: a bomb announces thousands of times its size."""
MOST_XML = 1 << 24
"""Bytes of ``modelDescription.xml``: some 100,000 variables."""
MOST_ENTRIES = 10_000
LONGEST_SHOWN = 80
DESCRIPTION = "modelDescription.xml"
DAMAGE = (
    zipfile.BadZipFile, zlib.error, EOFError, struct.error, ValueError, NotImplementedError, RuntimeError,
    OverflowError, IndexError,
)  # fmt: skip
"""What damaged archives make the standard library raise, `RuntimeError` for encrypted ones."""


def plain(text: str) -> str:
    """Text of an author for a message: printable and short."""
    shown = "".join(letter if letter.isprintable() else "?" for letter in text[: LONGEST_SHOWN + 1])
    return shown if len(shown) <= LONGEST_SHOWN else shown[:LONGEST_SHOWN] + "..."


class FmuArchive:
    """An FMU on disk, of which nothing was unpacked yet.

    Args:
        path: the file.

    Attributes:
        path: the file.

    Raises:
        ConfigError: there is no such file.
        DataError: it is no archive, or one whose entries leave their folder, are links, stand twice, are encrypted, or
            would unpack to more than any FMU needs.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        try:
            facts = self.path.stat()
        except OSError as error:
            raise ConfigError(f"'{self.path}': there is no file ({error.strerror}); give an FMU") from error
        # A pipe would be waited for, a device read without end.
        if not stat.S_ISREG(facts.st_mode):
            raise ConfigError(f"'{self.path}' is no file; give an FMU (.fmu)")
        if facts.st_size > MOST_FILE:
            raise DataError(f"FMU '{self.path}' has {facts.st_size:,} bytes; at most {MOST_FILE:,} are read")
        with self._open() as archive:
            self._entries = {entry.filename: entry for entry in archive.infolist()}
            self._check(archive.infolist())

    def description(self) -> bytes:
        """The bytes of ``modelDescription.xml``.

        Raises:
            DataError: there is none, or it is too large or damaged.
        """
        entry = self._entries.get(DESCRIPTION)
        if entry is None:
            raise DataError(f"FMU '{self.path}' has no {DESCRIPTION}; give a file that an FMI tool exported")
        if entry.file_size > MOST_XML:
            raise DataError(
                f"FMU '{self.path}': {DESCRIPTION} has {entry.file_size:,} bytes; at most {MOST_XML:,} are read"
            )
        with self._open() as archive:
            return archive.read(entry)

    def under(self, folder: str) -> list[str]:
        """Names of the files below a folder, sorted."""
        return sorted(
            name for name, entry in self._entries.items() if name.startswith(f"{folder}/") and not entry.is_dir()
        )

    def unpack(self, target: Path, folders: Sequence[str]) -> None:
        """Write the files below some folders into another one.

        Raises:
            DataError: an entry is damaged.
        """
        with self._open() as archive:
            for name in [name for folder in folders for name in self.under(folder)]:
                file = target / name
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_bytes(archive.read(self._entries[name]))

    @contextmanager
    def _open(self) -> Iterator[zipfile.ZipFile]:
        try:
            with zipfile.ZipFile(self.path) as archive:
                yield archive
        except DAMAGE as error:
            raise DataError(
                f"FMU '{self.path}' is no archive of an FMU, or a damaged one ({plain(str(error))}); export it again"
            ) from error
        except OSError as error:
            raise DataError(f"FMU '{self.path}' cannot be read: {plain(str(error))}") from error

    def _check(self, entries: Sequence[zipfile.ZipInfo]) -> None:
        where = f"FMU '{self.path}'"
        if len(entries) > MOST_ENTRIES:
            raise DataError(f"{where} has {len(entries):,} entries; at most {MOST_ENTRIES:,} are read")
        total = sum(entry.file_size for entry in entries)
        if total > MOST_UNPACKED:
            raise DataError(f"{where} would unpack to {total:,} bytes; at most {MOST_UNPACKED:,} are")
        # Two names that some file systems take for one would overwrite each other.
        names: set[str] = set()
        for entry in entries:
            name = entry.filename
            if not _inside(name) or entry.orig_filename != name:
                raise DataError(
                    f"{where}: entry '{plain(entry.orig_filename)}' does not name a file inside the archive; do not "
                    "use this file"
                )
            if stat.S_ISLNK(entry.external_attr >> 16):
                raise DataError(f"{where}: entry '{plain(name)}' is a link, which no FMU needs; do not use this file")
            if entry.flag_bits & 1:
                raise DataError(f"{where}: entry '{plain(name)}' is encrypted; ask its author for an open one")
            if name.lower() in names:
                raise DataError(f"{where}: entry '{plain(name)}' stands twice; do not use this file")
            names.add(name.lower())


def _inside(name: str) -> bool:
    """Whether a name stays inside the folder it is unpacked into, on every system."""
    parts = name.removesuffix("/").split("/")
    return (
        name.isprintable()
        and not any(sign in name for sign in '\\:*?"<>|')
        and all(part not in ("", ".", "..") for part in parts)
    )
