"""In-memory unpacking of compressed bag files; the readers do not write to disk."""

from __future__ import annotations

import io
from pathlib import Path, PurePath
from typing import Any, NamedTuple

from edp.errors import DataError
from edp.storage.memory import check_memory

_COPIES = 3
"""Memory factor of a growing buffer, which is copied into a buffer twice as large."""
_STEP = 1 << 24
"""Number of bytes between two checks of the remaining memory."""


class Size(NamedTuple):
    """File status with the size only."""

    st_size: int


class MemoryFile:
    """File in memory with the path operations that the bag library uses."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.data = b""
        self.stem = PurePath(name).stem
        self.suffix = PurePath(name).suffix

    def __str__(self) -> str:
        return self.name

    def exists(self) -> bool:
        """Return True."""
        return True

    def is_dir(self) -> bool:
        """Return False."""
        return False

    def stat(self) -> Size:
        """Return the size."""
        return Size(len(self.data))

    def open(self, mode: str = "r") -> Any:
        """Return a byte stream for reading, or for writing the whole content."""
        return _Sink(self) if "w" in mode else io.BytesIO(self.data)


class _Sink(io.BytesIO):
    """Stream that stores its content in the file when it is closed."""

    def __init__(self, file: MemoryFile) -> None:
        super().__init__()
        self.file = file
        self.weighed = 0

    def write(self, data: Any) -> int:
        if self.tell() + len(data) > self.weighed:
            self.weighed = self.tell() + len(data) + _STEP
            check_memory(
                Path(self.file.name), _COPIES * self.weighed, "this packed file", "unpack the bag with zstd first"
            )
        return super().write(data)

    def close(self) -> None:
        if not self.closed:
            self.file.data = self.getvalue()
        super().close()


class NoFolder:
    """Substitute for the temporary folder into which the library unpacks."""

    name = "packed bag"

    def __enter__(self) -> str:
        return self.name

    def __exit__(self, *_: object) -> None:
        return None


def place(*parts: Any) -> Any:
    """Return `Path`, and in `NoFolder` a file in memory."""
    if parts[0] != NoFolder.name:
        return Path(*parts)
    if len(parts) != 2:
        raise DataError(f"a packed file {parts[1:]!r}")
    return MemoryFile(str(parts[1]))
