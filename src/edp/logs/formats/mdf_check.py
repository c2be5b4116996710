"""Whether the blocks of an MDF 4 file fit together, looked at before a library follows them.

A file that was cut off, or whose bytes were changed, has links that lead nowhere, back or into the middle of data, or
counts that its data do not bear out. Each block is visited once, so a chain that bites its own tail ends here.
Layout: ASAM MDF 4.1, a block is id (4 bytes), reserved (4), length (8), count of links (8), links (8 each), data.
"""

from __future__ import annotations

import mmap
import struct
from dataclasses import dataclass
from pathlib import Path

from edp.errors import DataError
from edp.storage.memory import check_memory
from edp.storage.unpacking import DEFLATE_RATIO, measure_unpacked

_HEAD = 24
"""Size of a block's header before its links, bytes: id 4, reserved 4, length 8, number of links 8."""
_FIRST = 64
"""Position of the header block, after the identification of the file."""
_MAX_BLOCK = 1 << 31
"""Maximum size of an unpacked block in bytes. Larger data are stored as lists of blocks."""
_COPIES = 3
"""Number of copies of a packed block in memory: unpacked, transposed, and as columns."""
_DEEPEST_CONVERSION = 8
"""Maximum nesting depth of checked conversions. `mdf_conversion.DEEPEST` limits applied conversions."""
_MAX_ENTRIES = 2_000_000
"""Maximum number of entries of all conversions, counted as often as the library loads them."""
_MAX_TEXT = 1 << 26
"""Maximum size in bytes of the texts that blocks share, in any file."""
_TEXT_RATIO = 8
"""Additional size of shared texts per byte of the file, beyond `_MAX_TEXT`."""
_PACKINGS = ("zlib", "zlib", "lz4", "lz4", "zstd", "zstd")
"""Compression by type of a packed block. The data of every second type are transposed."""
_DATA = {b"##DT", b"##DV", b"##DZ", b"##DL", b"##HL", b"##LD", b"##SD", b"##RD", b"##DI", b"##RV", b"##RI"}
_NAMED = {b"##CN", b"##CG", b"##CC", b"##SI", b"##AT", b"##EV", b"##CH", b"##FH", b"##DG", b"##HD", b"##CA"}
_PACKED_HEAD = 24
"""Size in bytes of a packed block's header: inner type, compression, parameter, unpacked and packed size."""
# The links that make the tree: each of their targets belongs to one block. `None`: all of them.
_TREE: dict[bytes, tuple[int, ...] | None] = {
    b"##HD": (0, 1, 2, 3, 4),
    b"##DG": (0, 1, 2),
    b"##CG": (0, 1, 4),
    b"##CN": (0, 1),
    b"##CA": (0,),
    b"##DL": None,
    b"##HL": None,
    b"##LD": None,
    b"##FH": (0,),
    b"##AT": (0,),
    b"##EV": (0,),
    b"##CH": (0, 1),
    b"##SR": (0, 1),
}


@dataclass(frozen=True)
class _Block:
    at: int
    id: bytes
    length: int
    links: tuple[int, ...]

    @property
    def data_at(self) -> int:
        return self.at + _HEAD + 8 * len(self.links)


def check_blocks(path: Path) -> None:
    """Walk all blocks of an MDF 4 file.

    Raises:
        DataError: the file is cut off, was not closed by its logger, or its blocks do not fit together.
    """
    with path.open("rb") as stream:
        head = stream.read(_FIRST + _HEAD)
        if len(head) < _FIRST + _HEAD:
            raise _damage_error(path, "ends inside its header (truncated)")
        version = struct.unpack_from("<H", head, 28)[0]
        if not 400 <= version < 500:
            raise DataError(
                f"'{path}' holds MDF version {head[8:16].decode(errors='replace').strip()}; save it as MDF 4"
            )
        if head.startswith(b"UnFinMF"):
            raise DataError(
                f"'{path}' was not closed by its logger (an unfinalised MDF file); open it in the measurement tool and "
                "save it again"
            )
        with mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as view:
            try:
                _Walk(path, view).run()
            except struct.error as error:
                raise _damage_error(path, f"has a block that is cut off ({error})") from error


class _Walk:
    def __init__(self, path: Path, view: mmap.mmap) -> None:
        self.path = path
        self.view = view
        self.blocks: dict[int, _Block] = {}

    def run(self) -> None:
        owned: set[int] = set()
        todo = [self.block(_FIRST)]
        if todo[0].id != b"##HD":
            raise self.broken(_FIRST, "no header block")
        while todo:
            block = todo.pop()
            tree = _TREE.get(block.id, ())
            chosen = range(len(block.links)) if tree is None else tree
            for link_index, target in enumerate(block.links):
                if not target or (target in self.blocks and link_index not in chosen):
                    continue
                linked_block = self.block(target)
                if link_index in chosen:
                    # A tree has one owner a block; a second one makes a cycle, or doubles what is loaded.
                    if target in owned:
                        raise self.broken(target, f"a {_name(linked_block)} block that two others own")
                    owned.add(target)
                todo.append(linked_block)
            self.numbers(block)
        self.conversions()

    def block(self, at: int) -> _Block:
        if at in self.blocks:
            return self.blocks[at]
        size = len(self.view)
        if at + _HEAD > size:
            raise self.broken(at, f"a link behind the end of the file ({size} bytes; truncated?)")
        identity, _, length, count = struct.unpack_from("<4sIQQ", self.view, at)
        if not (identity.startswith(b"##") and identity[2:].isalnum()):
            raise self.broken(at, "no block where a link leads")
        if length < _HEAD + 8 * count or at + length > size:
            raise self.broken(at, f"a {identity[2:].decode()} block of {length} bytes in a file of {size} (truncated?)")
        links = struct.unpack_from(f"<{count}Q", self.view, at + _HEAD)
        self.blocks[at] = _Block(at, identity, length, links)
        return self.blocks[at]

    def numbers(self, block: _Block) -> None:
        """Check counts and sizes on which the library relies."""
        if block.id == b"##DZ":
            _, _, _, _, original, packed = struct.unpack_from("<2sBBIQQ", self.view, block.data_at)
            # 64 bytes more: the head of a packed stream weighs in the shortest ones.
            fits = packed <= block.length and original <= min(_MAX_BLOCK, DEFLATE_RATIO * (packed + 64))
            if not fits:
                raise self.broken(block.at, f"a packed block of {packed} bytes that claims to hold {original}")
            check_memory(self.path, _COPIES * original, "a packed block", "it may be damaged; record smaller blocks")
            self.unpack(block, packed, original)
        elif block.id == b"##DG" and len(block.links) >= 3:
            self.group(block)

    def unpack(self, block: _Block, packed: int, original: int) -> None:
        """Unpack a block to at most its announced size; the library itself has no limit."""
        kind = struct.unpack_from("<2sBBIQQ", self.view, block.data_at)[1]
        if kind >= len(_PACKINGS):
            raise self.broken(block.at, f"a block packed in a way {kind} that is not known")
        start = block.data_at + _PACKED_HEAD
        if start + packed > block.at + block.length:
            raise self.broken(block.at, f"a packed block of {packed} bytes in {block.length}")
        try:
            size = measure_unpacked(_PACKINGS[kind], self.view[start : start + packed], original)
        except Exception as error:
            # Each packing has exceptions of its own for damaged bytes.
            raise self.broken(block.at, f"a packed block that cannot be unpacked ({error})") from error
        if size != original:
            more = "more than " if size > original else ""
            raise self.broken(
                block.at, f"a packed block that announces {original} bytes and holds {more}{min(size, original)}"
            )

    def conversions(self) -> None:
        """Check conversion tables: without cycles, of limited depth, number and text."""
        seen: dict[int, tuple[int, int]] = {}
        entries = 0
        text = sum(self.text_of(block) for block in self.blocks.values() if block.id not in _DATA)
        for block in self.blocks.values():
            if block.id == b"##CN" and len(block.links) >= 8 and block.links[4]:
                count, more = self.conversion(block.links[4], seen, 0)
                entries, text = entries + count, text + more
        if entries > _MAX_ENTRIES or text > _MAX_TEXT + _TEXT_RATIO * len(self.view):
            raise _damage_error(
                self.path,
                f"states {entries} entries of conversions and {text} bytes of text, by blocks used many times",
            )

    def conversion(self, at: int, seen: dict[int, tuple[int, int]], depth: int) -> tuple[int, int]:
        """Return the entries and bytes of text of one conversion, with those within it."""
        if depth > _DEEPEST_CONVERSION:
            raise self.broken(at, "a conversion within itself, or too many within one another")
        if at not in seen:
            block = self.block(at)
            entries, text = 1 + len(block.links), self.text_of(block)
            for link in block.links[4:]:
                if link and self.block(link).id == b"##CC":
                    count, more = self.conversion(link, seen, depth + 1)
                    entries, text = entries + count, text + more
            seen[at] = entries, text
        return seen[at]

    def text_of(self, block: _Block) -> int:
        """Return the number of text bytes linked from a block."""
        targets = [self.block(link) for link in block.links if link] if block.id in _NAMED else []
        return sum(target.length for target in targets if target.id in (b"##TX", b"##MD"))

    def group(self, group: _Block) -> None:
        """Check a sorted data group: its records fill its data, and its channels fit into a record."""
        first = group.links[1]
        if not first:
            return
        head = self.block(first)
        if head.id != b"##CG" or len(head.links) < 2:
            raise self.broken(first, "no channel group where a data group leads")
        _, cycles, _, _, _, values, invalid = struct.unpack_from("<QQHHIII", self.view, head.data_at)
        record_ids = self.view[group.data_at]
        # Unsorted groups mix records of several lengths, which the library sorts itself.
        if head.links[0] or record_ids:
            return
        data = self.block(group.links[2]) if group.links[2] else None
        columns = data is not None and data.id in (b"##LD", b"##DV")
        needed = cycles * (values + (0 if columns else invalid))
        memory_bytes = 0 if data is None else self.held(data)
        if memory_bytes != needed:
            raise _damage_error(
                self.path,
                f"announces {cycles} records of {values + invalid} bytes and holds {memory_bytes} bytes of them "
                "(truncated?)",
            )
        self.channels(head.links[1], values)

    def channels(self, at: int, record: int) -> None:
        seen: set[int] = set()
        while at:
            if at in seen:
                raise self.broken(at, "a chain of channels without an end")
            seen.add(at)
            channel = self.block(at)
            if channel.id != b"##CN" or len(channel.links) < 8:
                raise self.broken(at, "no channel where a link leads")
            kind, _, coded, shift, offset, bits = struct.unpack_from("<BBBBII", self.view, channel.data_at)
            # Virtual channels (3 and 6) have no bytes in the record.
            if coded > 16 or (kind not in (3, 6) and offset + (shift + bits + 7) // 8 > record):
                raise self.broken(at, f"a channel that lies outside its record of {record} bytes")
            at = channel.links[0]

    def held(self, data: _Block) -> int:
        """Return the number of record bytes behind a link to data blocks."""
        total, at, seen = 0, data.at, set[int]()
        while at:
            if at in seen:
                raise self.broken(at, "a chain of data blocks without an end")
            seen.add(at)
            block = self.block(at)
            if block.id not in _DATA:
                raise self.broken(at, f"a {_name(block)} block where data should be")
            if block.id == b"##HL":
                at = block.links[0] if block.links else 0
                continue
            if block.id in (b"##DL", b"##LD"):
                count = struct.unpack_from("<I", self.view, block.data_at + 4)[0]
                total += sum(self.bytes_of(link) for link in block.links[1 : 1 + count] if link)
                at = block.links[0] if block.links else 0
                continue
            return total + self.bytes_of(at)
        return total

    def bytes_of(self, at: int) -> int:
        block = self.block(at)
        if block.id == b"##DZ":
            return int(struct.unpack_from("<2sBBIQQ", self.view, block.data_at)[4])
        if block.id not in (b"##DT", b"##DV"):
            raise self.broken(at, f"a {_name(block)} block where data should be")
        return block.length - _HEAD

    def broken(self, at: int, what: str) -> DataError:
        return _damage_error(self.path, f"has at byte {at} {what}")


def _name(block: _Block) -> str:
    return block.id[2:].decode()


def _damage_error(path: Path, what: str) -> DataError:
    return DataError(f"'{path}' is a damaged MDF file: it {what}; copy or export it again")
