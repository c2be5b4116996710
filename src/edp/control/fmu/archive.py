"""The archive of an FMU, which may be a stranger's: everything is checked before anything is unpacked."""

from __future__ import annotations

import stat
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from edp.errors import ConfigError, DataError
from edp.storage.archives import ArchiveLimits, ZipReader, printable

MAX_FILE = 1 << 28
"""Maximum size of an FMU in bytes. Tools include solvers and tables of about 100 MB."""
MAX_UNPACKED = 1 << 29
"""Maximum unpacked size of all entries in bytes. A ZIP bomb announces thousands of times its size."""
MAX_XML = 1 << 24
"""Maximum size of ``modelDescription.xml`` in bytes, which is enough for 100,000 variables."""
MOST_ENTRIES = 10_000
DESCRIPTION = "modelDescription.xml"
_LIMITS = ArchiveLimits(MAX_FILE, MAX_UNPACKED, MOST_ENTRIES)


class FmuArchive:
    """FMU file that is not unpacked yet.

    Args:
        path: the file.

    Attributes:
        path: the file.

    Raises:
        ConfigError: there is no such file.
        DataError: it is refused by `edp.storage.archives.ZipReader`.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        try:
            status = self.path.stat()
        except OSError as error:
            raise ConfigError(f"'{self.path}': there is no file ({error.strerror}); give an FMU") from error
        if not stat.S_ISREG(status.st_mode):
            raise ConfigError(f"'{self.path}' is no file; give an FMU (.fmu)")
        with self._open() as archive:
            self._sizes = {name: entry.size for name, entry in archive.entries.items()}

    def description(self) -> bytes:
        """Return the bytes of ``modelDescription.xml``.

        Raises:
            DataError: there is none, or it is too large or damaged.
        """
        size = self._sizes.get(DESCRIPTION)
        if size is None:
            raise DataError(f"FMU '{self.path}' has no {DESCRIPTION}; give a file that an FMI tool exported")
        if size > MAX_XML:
            raise DataError(f"FMU '{self.path}': {DESCRIPTION} has {size:,} bytes; at most {MAX_XML:,} are read")
        with self._open() as archive:
            return archive.read(DESCRIPTION)

    def under(self, folder: str) -> list[str]:
        """Return the names of the files below a folder, sorted."""
        return sorted(name for name in self._sizes if name.startswith(f"{folder}/") and not name.endswith("/"))

    def unpack(self, target: Path, folders: Sequence[str]) -> None:
        """Write the files below some folders into another one.

        Raises:
            DataError: an entry is damaged, or the file was changed after it was listed.
        """
        with self._open() as archive:
            archive.unpack(target, [name for folder in folders for name in self.under(folder)])

    def unpack_all(self, target: Path) -> None:
        """Write all files into a folder.

        Raises:
            DataError: an entry is damaged, or the file was changed after it was listed.
        """
        with self._open() as archive:
            archive.unpack(target, [name for name in self._sizes if not name.endswith("/")])

    @contextmanager
    def _open(self) -> Iterator[ZipReader]:
        what, advice = f"FMU '{self.path}'", "do not use this file, or export it again"
        try:
            archive = ZipReader(self.path, what, _LIMITS, advice)
        except OSError as error:
            raise DataError(f"{what} cannot be read: {printable(str(error))}") from error
        with archive:
            yield archive
