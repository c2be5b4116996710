"""Archives unpack to what they announce and no further, and cost nothing before they are within their bounds."""

from __future__ import annotations

import ast
import binascii
import bz2
import io
import struct
import tracemalloc
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest

import edp
from edp.errors import DataError
from edp.storage.archives import ArchiveLimits, ZipReader, zip_bytes
from edp.storage.unpacking import measure_unpacked, unpack_to

LIMITS = ArchiveLimits(file_bytes=1 << 26, unpacked_bytes=1 << 24, entries=1000)
SOUND = {"a": b"first", "folder/b": bytes(3000), "c": b""}


def reader(content: bytes) -> ZipReader:
    return ZipReader(content, "archive 'x'", LIMITS, "export it again")


def read_all(content: bytes) -> dict[str, bytes]:
    with reader(content) as archive:
        return {name: archive.read(name) for name in archive.entries}


def refused(content: bytes) -> str:
    """The message of an archive that is refused when it is opened, or when an entry is read; little memory is used."""
    tracemalloc.start()
    try:
        with pytest.raises(DataError) as error:
            read_all(content)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < (1 << 25) + 4 * len(content)
    text = str(error.value)
    assert text.startswith("archive 'x' ")
    assert text.endswith("; export it again")
    assert text.isprintable()
    return text


def raw(data: bytes) -> bytes:
    engine = zlib.compressobj(9, zlib.DEFLATED, -15)
    return engine.compress(data) + engine.flush()


def local(name=b"a", packed=b"", size=0, method=0, crc=0, flags=0, extra=b"", stated=None) -> bytes:
    told = (crc, len(packed), size) if stated is None else stated
    head = struct.pack("<4s5H3L2H", b"PK\x03\x04", 20, flags, method, 0, 0, *told, len(name), len(extra))
    return head + name + extra + packed


def central(name=b"a", packed=0, size=0, method=0, crc=0, flags=0, extra=b"", at=0, attributes=0) -> bytes:
    numbers = (flags, method, 0, 0, crc, packed, size, len(name), len(extra), 0, 0, 0, attributes, at)
    return struct.pack("<4s4B4HL2L5H2L", b"PK\x01\x02", 20, 3, 20, 0, *numbers) + name + extra


def end(count: int, size: int, at: int, comment=b"") -> bytes:
    return struct.pack("<4s4H2LH", b"PK\x05\x06", 0, 0, count, count, size, at, len(comment)) + comment


def archive(*entries: tuple[bytes, bytes]) -> bytes:
    """An archive of entries, each with its local header and its line in the directory (whose place is filled in)."""
    body = b"".join(head for head, _ in entries)
    directory = b"".join(line for _, line in entries)
    return body + directory + end(len(entries), len(directory), len(body))


def one(data=b"x" * 100, method=8, **line) -> bytes:
    packed = raw(data) if method == 8 else data
    facts = {"packed": len(packed), "size": len(data), "method": method, "crc": binascii.crc32(data)}
    head = local(packed=packed, size=facts["size"], method=method, crc=facts["crc"])
    return archive((head, central(**facts | line)))


def test_what_others_write_is_read():
    content = zip_bytes(SOUND.items(), (1980, 1, 1, 0, 0, 0), 0o755)
    with reader(content) as archive:
        assert {name: archive.read(name) for name in archive.entries} == SOUND
    for method in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w", method) as written:
            written.comment = b"a comment"
            written.writestr("folder/", b"")
            for name, data in SOUND.items():
                written.writestr(name, data)
            with written.open("wide ä", "w", force_zip64=True) as stream:
                stream.write(b"wide")
        with reader(buffer.getvalue()) as archive:
            assert {name: archive.read(name) for name in archive.entries} == {
                "folder/": b"",
                **SOUND,
                "wide ä": b"wide",
            }
    np.savez(buffer := io.BytesIO(), a=np.arange(5))
    with reader(buffer.getvalue()) as archive:
        assert np.load(io.BytesIO(archive.read("a.npy"))).tolist() == [0, 1, 2, 3, 4]


class Unseekable(io.RawIOBase):
    """A stream that a writer cannot go back in, so that sizes stand behind the data."""

    def __init__(self):
        self.data = bytearray()

    def writable(self):
        return True

    def write(self, data):
        self.data += data
        return len(data)


def test_sizes_behind_the_data_are_read_and_may_not_differ_from_the_directory():
    with zipfile.ZipFile(stream := Unseekable(), "w", zipfile.ZIP_DEFLATED) as written:
        written.writestr("a", b"x" * 5000)
    content = bytes(stream.data)
    with reader(content) as archive:
        assert archive.read("a") == b"x" * 5000
    data = raw(b"x" * 5000)
    facts = {"packed": len(data), "size": 5000, "method": 8, "crc": binascii.crc32(b"x" * 5000), "flags": 8}
    # The header states other sizes although they are said to stand behind the data.
    head = local(packed=data, method=8, flags=8, stated=(1, 7, 10))
    assert "other sizes" in refused(archive_of(head, facts))
    # Sizes of zero, and no mark that they stand behind.
    head = local(packed=data, method=8, stated=(0, 0, 0))
    assert "other sizes" in refused(archive_of(head, facts | {"flags": 0}))


def archive_of(head: bytes, facts: dict) -> bytes:
    return archive((head, central(**facts)))


def test_a_kilobyte_that_holds_ten_gigabytes_unpacks_to_a_kilobyte():
    # Made without 10 GB of memory: 10,000 times the packed form of a megabyte of zeros, flushed so that it repeats.
    engine = zlib.compressobj(9, zlib.DEFLATED, -15)
    first = engine.compress(bytes(1 << 20)) + engine.flush(zlib.Z_FULL_FLUSH)
    piece = engine.compress(bytes(1 << 20)) + engine.flush(zlib.Z_FULL_FLUSH)
    packed = first + 10_000 * piece + engine.flush()
    facts = {"packed": len(packed), "size": 1024, "method": 8, "crc": binascii.crc32(bytes(1024))}
    head = local(packed=packed, size=1024, method=8, crc=facts["crc"])
    assert "announces 1,024 bytes for entry 'a' and holds more" in refused(archive((head, central(**facts))))


def test_a_size_that_no_packing_reaches_is_refused_before_anything_is_unpacked():
    assert "claims 16,000,000 bytes" in refused(one(size=16_000_000))
    assert "would unpack to more than" in refused(
        archive(*((local(), central(packed=1 << 20, size=1 << 22, method=8)) for _ in range(5)))
    )


@pytest.mark.parametrize("count", [1001, 65534, 1_000_000])
def test_too_many_entries_are_refused_before_they_are_listed(count):
    lines = b"".join(central(name=b"%d" % number) for number in range(count))
    last = end(min(count, 0xFFFF), len(lines), 0)
    if count > 0xFFFE:
        wide = struct.pack("<4sQ2H2L4Q", b"PK\x06\x06", 44, 45, 45, 0, 0, count, count, len(lines), 0)
        last = wide + struct.pack("<4sLQL", b"PK\x06\x07", 0, len(lines), 1) + last
    content = lines + last
    tracemalloc.start()
    try:
        with pytest.raises(DataError, match=f"has {count:,} entries, at most 1,000 are read"):
            ZipReader(content, "archive 'x'", LIMITS, "export it again")
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("stated", [0, 1, 3])
def test_a_directory_of_more_or_fewer_entries_than_it_states_is_refused(stated):
    head, line = local(), central()
    content = head + line + line[:-1] + b"b" + end(stated, 2 * len(line), len(head))
    assert "not a ZIP archive, or a damaged one" in refused(content)


def test_entries_that_share_bytes_are_refused():
    data = raw(bytes(1 << 20))
    crc = binascii.crc32(bytes(1 << 20))
    facts = {"packed": len(data), "size": 1 << 20, "method": 8, "crc": crc}
    # One body under many names: the header must agree with each line, so quoted headers are tried as well.
    head = local(name=b"a", packed=data, size=1 << 20, method=8, crc=crc)
    lines = b"".join(central(name=name, **facts) for name in (b"a", b"b"))
    assert "another header" in refused(head + lines + end(2, len(lines), len(head)))
    # A quoted header: the first entry stores the second with its header as its content.
    inner = local(name=b"b", packed=data, size=1 << 20, method=8, crc=crc)
    outer = local(name=b"a", packed=inner, size=len(inner), crc=binascii.crc32(inner))
    quoting = {"packed": len(inner), "size": len(inner), "crc": binascii.crc32(inner)}
    lines = central(name=b"a", **quoting) + central(name=b"b", at=len(outer) - len(inner), **facts)
    assert "shares bytes" in refused(outer + lines + end(2, len(lines), len(outer)))
    # An entry that reaches into the directory.
    lines = central(name=b"a", packed=len(data) + 10, size=1 << 20, method=8, crc=crc)
    longer = local(name=b"a", packed=data, stated=(crc, len(data) + 10, 1 << 20), method=8)
    assert "shares bytes" in refused(longer + lines + end(1, len(lines), len(longer)))


@pytest.mark.parametrize("method", [1, 6, 9, 12, 14, 93, 95, 97, 98, 99])
def test_other_methods_than_stored_and_deflated_are_refused(method):
    assert f"packed by the method {method}, only stored and deflated" in refused(one(method=8).replace(
        struct.pack("<H", 8), struct.pack("<H", method)
    ))  # fmt: skip


@pytest.mark.parametrize("packing", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_bzip2_and_lzma_of_pythons_own_writer_are_refused(packing):
    with zipfile.ZipFile(buffer := io.BytesIO(), "w", packing) as written:
        written.writestr("a", bytes(1 << 22))
    assert "only stored and deflated" in refused(buffer.getvalue())


@pytest.mark.parametrize("flag", [1, 1 << 6 | 1, 1 << 6, 1 << 13])
def test_encrypted_entries_are_refused(flag):
    assert "is encrypted" in refused(one(flags=flag))


def test_wrong_checksums_and_sizes_are_refused():
    data = b"x" * 100
    wrong = binascii.crc32(data) ^ 1
    packed = raw(data)
    facts = {"packed": len(packed), "size": 100, "method": 8}
    assert "checksum of entry 'a'" in refused(
        archive((local(packed=packed, size=100, method=8, crc=wrong), central(crc=wrong, **facts)))
    )
    longer = facts | {"size": 101}
    assert "holds fewer" in refused(archive((local(packed=packed, size=101, method=8), central(**longer))))
    assert "two sizes" in refused(one(method=0, size=99))
    cut = {"packed": len(packed) - 2, "size": 100, "method": 8}
    assert "is damaged at entry 'a'" in refused(
        archive((local(packed=packed[:-2], size=100, method=8), central(**cut)))
    )


def test_names_that_two_file_systems_read_differently_are_refused():
    def named(*names: bytes) -> bytes:
        at, entries = 0, []
        for name in names:
            head = local(name=name)
            entries.append((head, central(name=name, at=at)))
            at += len(head)
        return archive(*entries)

    with reader(named(b"a", b"b/", b"b/c")) as sound:
        assert list(sound.entries) == ["a", "b/", "b/c"]
    for names in ((b"a", b"a"), (b"a", b"A"), (b"a/", b"a"), (b"a", b"a/")):
        assert "stands twice" in refused(named(*names))
    assert "a file and a folder" in refused(named(b"a", b"a/b"))
    for name in (b"../a", b"/a", b"a//b", b"a\\b", b"C:a", b"a\x00b", b"", b"a/../b", b".", b"x" * 1025):
        refused(named(name))


@pytest.mark.parametrize("place", range(0, 200, 3))
def test_every_cut_and_every_changed_byte_is_one_error_or_no_harm(place):
    content = zip_bytes(SOUND.items(), (1980, 1, 1, 0, 0, 0), 0o755)
    refused(content[: place * len(content) // 200])
    changed = bytearray(content)
    changed[place * len(content) // 200] ^= 0xFF
    try:
        read = read_all(bytes(changed))
    except DataError:
        return
    # A changed date or mode harms nothing; a changed name is another name.
    assert sorted(read.values()) == sorted(SOUND.values())


def test_what_stands_behind_the_end_is_refused():
    assert "bytes behind its end" in refused(one() + b"x")


@pytest.mark.parametrize("packing", ["zlib", "bz2", "lz4", "zstd"])
def test_streams_end_at_the_announced_size(packing):
    data = bytes(50 << 20)
    if packing == "lz4":
        packed = pytest.importorskip("lz4.frame").compress(data)
    elif packing == "zstd":
        packed = pytest.importorskip("backports.zstd").compress(data)
    else:
        packed = {"zlib": zlib, "bz2": bz2}[packing].compress(data)
    tracemalloc.start()
    try:
        assert len(unpack_to(packing, packed, 1000)) == 1001
        assert 1000 < measure_unpacked(packing, packed, 1000) <= 1000 + (2 << 20)
        assert tracemalloc.get_traced_memory()[1] < 8 << 20
    finally:
        tracemalloc.stop()
    assert measure_unpacked(packing, packed, 1 << 30) == len(data)
    with pytest.raises(Exception):  # noqa: B017, PT011 - each packing has its own
        unpack_to(packing, packed[: len(packed) // 2], 1 << 30)


PACKING = {"zipfile", "zlib", "gzip", "bz2", "lzma", "lz4", "zstd", "zstandard", "tarfile", "zipimport", "brotli"}
DOORS = {
    "storage/archives.py": "ZIP archives",
    "storage/unpacking.py": "streams",
}
"""The only modules that pack or unpack."""
CALLS = {
    # A file that leaves with an export and runs without EDP; it reads the arrays that were written beside it.
    "export/casadi/runtime.py": {"load"},
    # Arrays that a program of `edp verify` wrote, which consent was given to; plain .npy files without packing.
    "workflows/parity/forms/casadi.py": {"load"},
    "workflows/parity/forms/onnx_runtime.py": {"load"},
}
UNPACKING_CALLS = {"load", "unpack_archive", "extractall", "make_archive"}


def sources():
    root = Path(edp.__file__).parent
    for file in sorted(root.rglob("*.py")):
        yield file.relative_to(root).as_posix(), ast.parse(file.read_text(encoding="utf-8"))


def test_nothing_else_of_edp_packs_or_unpacks():
    found = set()
    for name, tree in sources():
        for node in ast.walk(tree):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names = [node.module or "", *(f"{node.module}.{alias.name}" for alias in node.names)]
            if any(PACKING & set(full.split(".")) for full in names):
                found.add(name)
    assert found == set(DOORS)


def test_numpy_and_shutil_unpack_nothing_elsewhere():
    """`numpy.load` unpacks .npz files of any size; `shutil` unpacks everything."""
    found: dict[str, set[str]] = {}
    for name, tree in sources():
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
                owner = node.func.value.id if isinstance(node.func.value, ast.Name) else ""
                called = node.func.attr
                if called in UNPACKING_CALLS and (called != "load" or owner in ("np", "numpy")):
                    found.setdefault(name, set()).add(called)
    assert found == {name: calls for name, calls in CALLS.items() if name in found}
