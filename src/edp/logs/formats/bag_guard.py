"""Readers of bags that take no size, no type and no schema of a file on trust.

The library unpacks chunks to whatever their bytes lead to, takes message counts as they are stated, asks an SQLite
file for its tables whatever they are, and would make Python code of message definitions and run it. Here chunks are
unpacked to the size announced (which is weighed first), databases hold plain tables only, and definitions stay data.
"""

from __future__ import annotations

import sqlite3
import stat
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, ClassVar

from edp.errors import DataError, brief
from edp.logs.formats.bag_memory import MemoryFile, NoFolder, place
from edp.logs.formats.mcap_check import RATIO, SPARE, check_records
from edp.storage.memory import check_memory
from edp.storage.paths import is_file_at, is_folder_at
from edp.storage.reading import Table
from edp.storage.unpacking import open_zstd, unpack_to

_LONGEST_METADATA = 4 << 20
"""Maximum size of a bag's metadata.yaml in bytes. A topic takes about 500."""
_LONGEST_DEFINITION = 1 << 20
"""Maximum number of characters of a message definition, including the definitions of all its types."""
_PLAIN_TABLES = ("messages", "topics", "schema", "message_definitions", "metadata")
"""Tables of a bag whose columns are checked."""


@dataclass
class Definitions:
    """Message types as data: what `edp.logs.formats.ros_message` needs of a store (which would run them as code)."""

    fielddefs: Mapping[str, Any]


def definitions_of(text: Any, message_type: str) -> Definitions | None:
    """Return the message definitions of a connection, otherwise of a known distribution; None for an unknown type.

    Raises:
        DataError: a definition that is too long.
    """
    from rosbags.interfaces import MessageDefinitionFormat
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

    if text.format == MessageDefinitionFormat.NONE:
        store = get_typestore(Stores(DISTRIBUTION))
        return Definitions(store.fielddefs) if message_type in store.fielddefs else None
    if len(text.data) > _LONGEST_DEFINITION:
        raise DataError(f"a message definition of {len(text.data)} characters")
    types: Table = dict(get_typestore(Stores.EMPTY).fielddefs)
    if text.format == MessageDefinitionFormat.MSG:
        return Definitions(types | get_types_from_msg(text.data, message_type))
    # A line of 80 signs separates the types of a definition, by convention of ROS.
    for part in text.data.split("=" * 80 + "\n"):
        if part.strip():
            types |= get_types_from_idl(part.split("\n", 1)[1] if part.startswith("IDL: ") else part)
    return Definitions(types)


DISTRIBUTION = "ros2_humble"
"""Set of message types for bags without definitions."""


def open_reader(path: Path) -> Any:
    """Return an unopened reader for a ROS 1 or ROS 2 bag, an MCAP file or the folder of a ROS 2 bag.

    Raises:
        DataError: a part that is no regular file, or whose sizes cannot be.
    """
    reader1, reader2 = _readers()
    if is_folder_at(path):
        _check_folder(path)
    return reader1(path) if path.suffix.lower() == ".bag" and is_file_at(path) else reader2(path)


@cache
def _readers() -> tuple[Any, Any]:
    """Return the reader classes of the library, with unpacking limited by `unpack_to`."""
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag1 import reader as rosbag1
    from rosbags.rosbag2 import Reader as Reader2
    from rosbags.rosbag2 import reader as rosbag2
    from rosbags.rosbag2 import storage_mcap

    for kind in ("bz2", "lz4"):
        rosbag1.decompressors[kind] = partial(_unpack_by_ratio, kind)
    for kind in ("lz4", "zstd"):
        storage_mcap.DECOMPRESSORS[kind] = partial(_to_size, kind)
    for name, replacement in {"zstd": _Zstd, "TemporaryDirectory": NoFolder, "Path": place}.items():
        setattr(rosbag2, name, replacement)

    class Mcap(storage_mcap.McapReader):
        def open(self) -> None:
            check_records(_source(self.path))
            super().open()

    class Sqlite(rosbag2.Sqlite3Reader):
        def open(self) -> None:
            _check_database(_source(self.path))
            super().open()

    class Folder(rosbag2.DirectoryReader):
        STORAGE_PLUGINS: ClassVar[Any] = {"mcap": Mcap, "sqlite3": Sqlite}  # type: ignore[misc]

    class Bag2(Reader2):
        STORAGE_PLUGINS: ClassVar[Any] = {"dir": Folder, ".mcap": Mcap, ".db3": Sqlite}  # type: ignore[misc]

    return Reader1, Bag2


def _source(path: Any) -> Path | MemoryFile:
    return path if isinstance(path, MemoryFile) else Path(str(path))


def _to_size(kind: str, data: bytes, size: int) -> bytes:
    """Unpack at most one byte more than announced, which the library then refuses."""
    return unpack_to(kind, data, size)


def _unpack_by_ratio(kind: str, data: bytes) -> bytes:
    """Unpack parts whose unpacked size is not announced where the library looks."""
    # A chunk of ROS 1 announces its size in its header, which the library's call does not hand over.
    limit = RATIO * len(data) + SPARE
    unpacked_bytes = unpack_to(kind, data, limit)
    if len(unpacked_bytes) > limit:
        raise DataError(f"{len(data)} bytes packed by {kind} that unpack to more than {limit}")
    return unpacked_bytes


class _Zstd:
    """Replacement of the zstd functions that the library uses: whole messages, and whole files of a packed bag."""

    @staticmethod
    def decompress(data: bytes) -> bytes:
        return _unpack_by_ratio("zstd", data)

    @staticmethod
    def open(stream: Any, mode: str) -> Any:
        return open_zstd(stream, mode, RATIO * Path(stream.name).stat().st_size + SPARE)


def _check_folder(folder: Path) -> None:
    for part in sorted(folder.iterdir()):
        if not (part.suffix in (".db3", ".mcap", ".zstd") or part.name == "metadata.yaml"):
            continue
        about = part.stat()
        if not stat.S_ISREG(about.st_mode):
            raise DataError(f"'{part}' is no regular file; a bag's folder holds files only")
        if part.name == "metadata.yaml" and about.st_size > _LONGEST_METADATA:
            raise DataError(f"'{part}' has {about.st_size} bytes, at most {_LONGEST_METADATA} are read")


def _check_database(path: Path | MemoryFile) -> None:
    """Accept plain tables only: views, virtual tables and computed columns would execute their author's code.

    Raises:
        DataError: any other thing in the file, topics with the same number, or texts that are too long.
    """
    # Signs with a meaning in SQLite's file names: a part of the path would become options.
    if any(sign in str(path) for sign in "?#%"):
        raise DataError(f"'{path}': a bag's path must not hold '?', '#' or '%'; rename it")
    size = path.stat().st_size
    if isinstance(path, MemoryFile):
        base = sqlite3.connect(":memory:")
    else:
        base = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)
    try:
        if isinstance(path, MemoryFile):
            # Bytes 18 and 19 tell how it is written to; a base in memory knows only one way.
            base.deserialize(path.data[:18] + b"\1\1" + path.data[20:])
        # A value cannot be longer than the file, whatever its header says.
        base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, min(max(size, 4096), (1 << 31) - 1))
        # Functions and virtual tables that the schema names must not run as trusted ones.
        base.execute("PRAGMA trusted_schema = OFF")
        schema_rows = base.execute("SELECT type, name, sql FROM sqlite_master LIMIT 1000").fetchall()
        odd = [name for kind, name, sql in schema_rows if not _plain(kind, name, sql)]
        if odd:
            raise DataError(
                f"'{path}': {odd[0]!r} is not one of the plain tables and indices of a bag; record it again"
            )
        for table in {name for kind, name, _ in schema_rows if kind == "table" and name in _PLAIN_TABLES}:
            # Column 6 tells computed columns, which ordinary table_info leaves out.
            if any(row[6] for row in base.execute(f"PRAGMA table_xinfo({table})")):
                raise DataError(f"'{path}': table '{table}' has computed columns; record the bag again")
        names = {name for _, name, _ in schema_rows}
        if "topics" in names:
            count, different = base.execute("SELECT count(*), count(DISTINCT id) FROM topics").fetchone()
            if count != different:
                raise DataError(f"'{path}': {count} topics have {different} numbers; record the bag again")
    except sqlite3.Error as error:
        raise DataError(f"'{path}' cannot be read as a bag: {brief(error)}; copy or record it again") from error
    finally:
        base.close()


def _plain(kind: str, name: str, sql: str | None) -> bool:
    text = " ".join((sql or "").upper().split())
    if kind == "index":
        return text.startswith("CREATE INDEX") or not sql
    return kind == "table" and text.startswith("CREATE TABLE") and " AS SELECT" not in text


def check_counts(path: Path, counts: Table, files: list[Path]) -> None:
    """Refuse counts of messages that the bytes of a bag cannot hold, so that no room is taken for them.

    Raises:
        DataError: such a count.
    """
    most = sum(file.stat().st_size for file in files) * RATIO + SPARE
    for topic, count in counts.items():
        if not isinstance(count, int) or not 0 <= count <= most:
            raise DataError(f"'{path}': topic {topic[:80]!r} announces {count!r} messages; copy or record it again")
    # Eight bytes a time stamp, for each announced message.
    check_memory(path, 8 * max(counts.values(), default=0), "the times of a topic", "it may be damaged")
