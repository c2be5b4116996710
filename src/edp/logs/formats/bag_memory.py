"""Files of a bag that is packed file by file, unpacked into memory: a reader of logs writes nothing to disk."""

from __future__ import annotations

import io
from pathlib import Path, PurePath
from typing import Any, NamedTuple

from edp.errors import DataError
from edp.storage.memory import check_memory

_COPIES = 3
"""A growing buffer is copied into one twice as large."""
_STEP = 1 << 24
"""Bytes between two checks of the memory that is left."""


class Size(NamedTuple):
    """What of a file's status is asked for."""

    st_size: int


class MemoryFile:
    """A file that lies in memory, with what the library of bags asks of a path."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.data = b""
        self.stem = PurePath(name).stem
        self.suffix = PurePath(name).suffix

    def __str__(self) -> str:
        return self.name

    def exists(self) -> bool:
        """It does."""
        return True

    def is_dir(self) -> bool:
        """It is none."""
        return False

    def stat(self) -> Size:
        """How large it is."""
        return Size(len(self.data))

    def open(self, mode: str = "r") -> Any:
        """A stream of bytes, to read it or to write all of it."""
        return _Sink(self) if "w" in mode else io.BytesIO(self.data)


class _Sink(io.BytesIO):
    """What is written becomes the file's content when the stream is closed."""

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
    """Stands for the temporary folder that the library unpacks to."""

    name = "packed bag"

    def __enter__(self) -> str:
        return self.name

    def __exit__(self, *_: object) -> None:
        return None


def place(*parts: Any) -> Any:
    """`Path`, and in `NoFolder` a file in memory."""
    if parts[0] != NoFolder.name:
        return Path(*parts)
    if len(parts) != 2:
        raise DataError(f"a packed file {parts[1:]!r}")
    return MemoryFile(str(parts[1]))
