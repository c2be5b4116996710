"""Reader of untrusted ZIP archives: bounds the number of entries and the size of the unpacked data.

All of EDP reads and writes ZIP archives here. `zipfile` reads a directory of any length, unpacks by methods that take
any amount of memory, and lets entries share their bytes.

Layout: PKWARE, APPNOTE.TXT 6.3.10; methods 0 (stored) and 8 (deflated).
"""

from __future__ import annotations

import binascii
import io
import os
import stat
import struct
import zipfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from edp.errors import DataError
from edp.storage.unpacking import DEFLATE_RATIO, DamagedError, unpack_raw

_STORED, _DEFLATED = 0, 8
_END, _END64, _LOCATOR64 = b"PK\x05\x06", b"PK\x06\x06", b"PK\x06\x07"
_CENTRAL, _LOCAL = b"PK\x01\x02", b"PK\x03\x04"
_END_BYTES, _LOCATOR_BYTES, _END64_BYTES, _CENTRAL_BYTES, _LOCAL_BYTES = 22, 20, 56, 46, 30
_LONGEST_COMMENT = 0xFFFF
_FULL16, _FULL32 = 0xFFFF, 0xFFFFFFFF
"""Field values of a ZIP record that refer to a 64-bit number in its ZIP64 field."""
_ENCRYPTED, _SIZES_BEHIND, _PATCHED, _STRONG, _UTF8, _MASKED = 1, 1 << 3, 1 << 5, 1 << 6, 1 << 11, 1 << 13
_UNIX_TYPE = 16
_LONGEST_NAME = 1024
_LONGEST_SHOWN = 80


def printable(text: str) -> str:
    """Return text of an author for a message: printable and short."""
    shown = "".join(letter if letter.isprintable() else "?" for letter in text[: _LONGEST_SHOWN + 1])
    return shown if len(shown) <= _LONGEST_SHOWN else shown[:_LONGEST_SHOWN] + "..."


@dataclass(frozen=True)
class ArchiveLimits:
    """Bounds of an archive.

    Attributes:
        file_bytes: size of the archive itself.
        unpacked_bytes: sum of the announced sizes of all entries.
        entries: number of entries.
    """

    file_bytes: int
    unpacked_bytes: int
    entries: int


@dataclass(frozen=True)
class ArchiveEntry:
    """One entry of an archive.

    Attributes:
        name: path inside the archive, with ``/``; that of a folder ends so.
        size: bytes when unpacked, as announced.
        packed: bytes in the archive.
        method: 0 (stored) or 8 (deflated).
        crc: CRC-32 of the unpacked bytes.
        at: position of its local header.
    """

    name: str
    size: int
    packed: int
    method: int
    crc: int
    at: int


class _Damaged(Exception):
    """Error in an archive: not a ZIP file, damaged, or outside its bounds."""


class ZipReader:
    """Entries of a ZIP archive of a stranger, all of which are checked before the first is unpacked.

    Args:
        source: a regular file, or its content.
        what: description for messages (``FMU 'a.fmu'``).
        limits: limits of the content.
        advice: advice if the archive is refused.

    Attributes:
        entries: entries by name.

    Raises:
        DataError: not an archive, or one that is damaged, too large, encrypted or packed by another method; or whose
            entries leave their folder, are links, share a name or share bytes.
        OSError: the file cannot be read.
    """

    def __init__(self, source: Path | bytes, what: str, limits: ArchiveLimits, advice: str) -> None:
        self.what, self.limits, self.advice = what, limits, advice
        self._stream: IO[bytes] = io.BytesIO(source) if isinstance(source, bytes) else _open_unblocked(source)
        try:
            if not isinstance(source, bytes) and not stat.S_ISREG(os.fstat(self._stream.fileno()).st_mode):
                raise self._refusal_error("is not a regular file")
            self._size = self._stream.seek(0, os.SEEK_END)
            if self._size > limits.file_bytes:
                raise self._refusal_error(f"has {self._size:,} bytes, at most {limits.file_bytes:,} are read")
            self.entries = self._list_entries()
        except BaseException:
            self._stream.close()
            raise

    def __enter__(self) -> ZipReader:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    def read(self, name: str) -> bytes:
        """Return the bytes of an entry.

        Raises:
            DataError: the entry is damaged, or holds more or less than it announces.
            KeyError: there is no such entry.
        """
        entry = self.entries[name]
        try:
            start, _ = self._data_at(entry)
            packed = self._bytes(start, entry.packed)
            data = packed if entry.method == _STORED else unpack_raw(packed, entry.size)
        except (_Damaged, DamagedError) as error:
            raise self._refusal_error(f"is damaged at entry '{printable(name)}' ({error})") from error
        if len(data) != entry.size:
            more = "more" if len(data) > entry.size else "fewer"
            raise self._refusal_error(f"announces {entry.size:,} bytes for entry '{printable(name)}' and holds {more}")
        if binascii.crc32(data) != entry.crc:
            raise self._refusal_error(f"is damaged: the checksum of entry '{printable(name)}' does not fit")
        return data

    def unpack(self, target: Path, names: Iterable[str]) -> None:
        """Write some entries into a folder, each below the folders of its name.

        Raises:
            DataError: an entry is missing or damaged.
            OSError: a file cannot be written.
        """
        for name in names:
            if name not in self.entries:
                raise self._refusal_error(f"has no entry '{printable(name)}'")
            file = target / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(self.read(name))

    def _list_entries(self) -> dict[str, ArchiveEntry]:
        try:
            count, size, at = self._directory_place()
            # Before the directory is read: its length is what the rest costs.
            if count > self.limits.entries:
                raise self._refusal_error(f"has {count:,} entries, at most {self.limits.entries:,} are read")
            if not count * _CENTRAL_BYTES <= size <= count * (_CENTRAL_BYTES + _LONGEST_NAME):
                raise _Damaged(f"a directory of {size:,} bytes for {count:,} entries")
            entries = list(self._entries(self._bytes(at, size), count))
            self._check_names(entries)
            self._check_places(entries, at)
        except (_Damaged, struct.error, UnicodeDecodeError) as error:
            raise self._refusal_error(f"is not a ZIP archive, or a damaged one ({error})") from error
        return {entry.name: entry for entry in entries}

    def _directory_place(self) -> tuple[int, int, int]:
        """Return how many entries the directory has, how many bytes, and where it begins."""
        tail_at = max(0, self._size - _END_BYTES - _LONGEST_COMMENT)
        tail = self._bytes(tail_at, self._size - tail_at)
        end_in_tail = tail.rfind(_END)
        if end_in_tail < 0 or end_in_tail + _END_BYTES > len(tail):
            raise _Damaged("its end is missing")
        disk, start_disk, here, count, size, at, comment = struct.unpack_from("<4H2LH", tail, end_in_tail + 4)
        end_at = tail_at + end_in_tail
        if end_at + _END_BYTES + comment != self._size:
            raise _Damaged("bytes behind its end")
        if _FULL16 in (here, count) or _FULL32 in (size, at):
            locator_at = end_at - _LOCATOR_BYTES
            kind, disk, end_at, disks = struct.unpack("<4sLQL", self._bytes(locator_at, _LOCATOR_BYTES))
            if kind != _LOCATOR64 or disks > 1:
                raise _Damaged("its ZIP64 end is missing")
            kind, _, _, _, _, start_disk, here, count, size, at = struct.unpack(
                "<4sQ2H2L4Q", self._bytes(end_at, _END64_BYTES)
            )
            if kind != _END64:
                raise _Damaged("its ZIP64 end is missing")
        if disk or start_disk or here != count:
            raise _Damaged("a part of several archives")
        if at + size != end_at:
            raise _Damaged("a directory that does not end where the end begins")
        return count, size, at

    def _entries(self, directory: bytes, count: int) -> Iterator[ArchiveEntry]:
        at = total = 0
        for _ in range(count):
            head = struct.unpack_from("<4s4B4HL2L5H2L", directory, at)
            kind, flags, method = head[0], head[5], head[6]
            crc, packed, size, named, extra_bytes, comment = head[9:15]
            attributes, local_at = head[17], head[18]
            if kind != _CENTRAL:
                raise _Damaged("an entry without its mark")
            at += _CENTRAL_BYTES
            if at + named + extra_bytes + comment > len(directory):
                raise _Damaged("an entry that is cut off")
            name = directory[at : at + named].decode("utf-8" if flags & _UTF8 else "cp437")
            extra = directory[at + named : at + named + extra_bytes]
            at += named + extra_bytes + comment
            size, packed, local_at = _wide(extra, size, packed, local_at)
            self._check_entry(name, flags, method, attributes)
            if method == _STORED and size != packed:
                raise _Damaged(f"entry '{printable(name)}' is stored and has two sizes")
            if size > DEFLATE_RATIO * (packed + 64):
                raise self._refusal_error(
                    f"claims {size:,} bytes for entry '{printable(name)}', packed into {packed:,}"
                )
            total += size
            if total > self.limits.unpacked_bytes:
                raise self._refusal_error(f"would unpack to more than {self.limits.unpacked_bytes:,} bytes")
            yield ArchiveEntry(name, size, packed, method, crc, local_at)
        if at != len(directory):
            raise _Damaged("a directory with bytes behind its entries")

    def _check_entry(self, name: str, flags: int, method: int, attributes: int) -> None:
        shown = f"entry '{printable(name)}'"
        if not _is_inside(name):
            raise self._refusal_error(f"has an {shown} that does not name a file inside the archive")
        if stat.S_ISLNK(attributes >> _UNIX_TYPE):
            raise self._refusal_error(f"has an {shown} that is a link")
        if flags & (_ENCRYPTED | _STRONG | _MASKED):
            raise self._refusal_error(f"has an {shown} that is encrypted")
        if flags & _PATCHED or method not in (_STORED, _DEFLATED):
            raise self._refusal_error(
                f"has an {shown} packed by the method {method}, only stored and deflated ones are read"
            )

    def _check_names(self, entries: Sequence[ArchiveEntry]) -> None:
        # Two names that some file systems take for one would overwrite each other.
        names: set[str] = set()
        files: set[str] = set()
        for entry in entries:
            name = entry.name.removesuffix("/").casefold()
            if name in names:
                raise self._refusal_error(f"has an entry '{printable(entry.name)}' that stands twice")
            names.add(name)
            if not entry.name.endswith("/"):
                files.add(name)
        for name in names:
            folder = name.rpartition("/")[0]
            if folder in files:
                raise self._refusal_error(f"has an entry '{printable(folder)}' that is a file and a folder")

    def _check_places(self, entries: Iterable[ArchiveEntry], directory_at: int) -> None:
        """Refuse entries that overlap another entry or the directory: one byte would unpack many times."""
        free_from = 0
        for entry in sorted(entries, key=lambda each: each.at):
            _, end = self._data_at(entry)
            if entry.at < free_from or end > directory_at:
                raise self._refusal_error(f"has an entry '{printable(entry.name)}' that shares bytes with another one")
            free_from = end

    def _data_at(self, entry: ArchiveEntry) -> tuple[int, int]:
        """Return where the packed bytes of an entry begin and end; its header must agree with the directory."""
        head = struct.unpack("<4s5H3L2H", self._bytes(entry.at, _LOCAL_BYTES))
        kind, flags, method, named, extra_bytes = head[0], head[2], head[3], head[9], head[10]
        crc, packed, size = head[6:9]
        name = self._bytes(entry.at + _LOCAL_BYTES, named).decode("utf-8" if flags & _UTF8 else "cp437")
        extra = self._bytes(entry.at + _LOCAL_BYTES + named, extra_bytes)
        size, packed, _ = _wide(extra, size, packed, 0)
        if kind != _LOCAL or name != entry.name or method != entry.method or flags & _ENCRYPTED:
            raise _Damaged(f"entry '{printable(entry.name)}' has another header than its directory states")
        # With the sizes behind the data, the header holds zeros.
        stated = (crc, packed, size)
        if stated != (entry.crc, entry.packed, entry.size) and not (flags & _SIZES_BEHIND and not any(stated)):
            raise _Damaged(f"entry '{printable(entry.name)}' has other sizes than its directory states")
        start = entry.at + _LOCAL_BYTES + named + extra_bytes
        return start, start + entry.packed

    def _bytes(self, at: int, count: int) -> bytes:
        if at < 0 or at + count > self._size:
            raise _Damaged("a place outside of the file")
        self._stream.seek(at)
        data = self._stream.read(count)
        if len(data) != count:
            raise _Damaged("the file became shorter while it was read")
        return data

    def _refusal_error(self, why: str) -> DataError:
        return DataError(f"{self.what} {why}; {self.advice}")


def _open_unblocked(path: Path) -> IO[bytes]:
    # Without waiting for the other end of a pipe.
    return open(os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)), "rb")


def _wide(extra: bytes, size: int, packed: int, at: int) -> tuple[int, int, int]:
    """Return sizes and offset of an entry, taken from its ZIP64 field if present."""
    from_field = [size == _FULL32, packed == _FULL32, at == _FULL32]
    if not any(from_field):
        return size, packed, at
    offset = 0
    while offset + 4 <= len(extra):
        kind, length = struct.unpack_from("<2H", extra, offset)
        offset += 4
        if kind == 1:
            if length < 8 * sum(from_field) or offset + length > len(extra):
                break
            wide = iter(struct.unpack_from(f"<{sum(from_field)}Q", extra, offset))
            size, packed, at = (
                next(wide) if from_field else old for from_field, old in zip(from_field, (size, packed, at))
            )
            return size, packed, at
        offset += length
    raise _Damaged("a ZIP64 entry without its sizes")


def _is_inside(name: str) -> bool:
    """Return whether a name stays inside the folder it is unpacked into, on every system."""
    parts = name.removesuffix("/").split("/")
    return (
        len(name) <= _LONGEST_NAME
        and name.isprintable()
        and not any(sign in name for sign in '\\:*?"<>|')
        and all(part not in ("", ".", "..") for part in parts)
    )


def zip_bytes(files: Iterable[tuple[str, bytes]], date: tuple[int, int, int, int, int, int], mode: int) -> bytes:
    """Return a ZIP archive with deflated entries, equal for equal content.

    Args:
        files: names inside the archive, and contents.
        date: date of every entry: year, month, day, hour, minute, second.
        mode: Unix mode of every entry.
    """
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files:
            entry = zipfile.ZipInfo(name, date)
            entry.compress_type, entry.external_attr = zipfile.ZIP_DEFLATED, mode << _UNIX_TYPE
            # Unix: other origins have no mode.
            entry.create_system = 3
            archive.writestr(entry, content)
    return buffer.getvalue()
