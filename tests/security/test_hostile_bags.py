"""Bags that unpack to more than they announce, announce more than they hold, or carry code."""

from __future__ import annotations

import bz2
import contextlib
import json
import os
import resource
import sqlite3
import struct
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
from backports import zstd
from rosbags.rosbag2 import Reader

from edp.errors import DataError
from edp.logs import read_recording, write_recording
from edp.logs.formats.bag_guard import definitions_of
from edp.recording import Recording
from edp.signals import TABLE_A1
from edp.storage.unpacking import measure_unpacked, unpack_to

BOMB = 1 << 32


def log_in(folder: Path, suffix: str) -> Path:
    values = np.arange(200, dtype=np.float32).reshape(100, 2)
    recording = Recording("R", (TABLE_A1["BmUp"], TABLE_A1["CylVels_1"]), values, 100.0)
    return write_recording(recording, folder / f"a{suffix}")


def zeros_in_zstd(size: int) -> bytes:
    """One frame of RFC 8878 whose blocks each repeat a zero 128 KiB times; a compressor would read 4 GiB for it."""
    block = 1 << 17
    count = size // block
    # Magic number, no flags, a window of 8 MiB; a block is its last bit, the type 1 (repeat) and its size.
    headers = [(block << 3) | (1 << 1) | (number == count - 1) for number in range(count)]
    return b"\x28\xb5\x2f\xfd\x00\x68" + b"".join(struct.pack("<I", header)[:3] + b"\x00" for header in headers)


def bomb(kind: str) -> bytes:
    """Some 130 kB (zstd) that unpack to 4 GiB, made without as many bytes in memory."""
    if kind == "zstd":
        return zeros_in_zstd(BOMB)
    if kind == "bz2":
        # Streams one after the other are one content.
        return bz2.compress(bytes(1 << 24)) * 64
    return lz4.frame.compress(bytes(1 << 26))  # small enough to be packed under a limit, too


@pytest.fixture(scope="module")
def zstd_bomb() -> bytes:
    return bomb("zstd")


@pytest.fixture
def little_memory():
    """What a test may take beyond what the process has: less than any bomb here."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (pages * os.sysconf("SC_PAGE_SIZE") + (1 << 29), hard))
    yield
    resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


@pytest.mark.parametrize("kind", ["zstd", "lz4", "bz2"])
def test_unpacking_ends_at_what_is_announced(kind, little_memory, zstd_bomb):
    packed = zstd_bomb if kind == "zstd" else bomb(kind)
    assert len(unpack_to(kind, packed, 4000)) == 4001
    assert 4000 < measure_unpacked(kind, packed, 4000) < 1 << 22


@pytest.mark.parametrize("kind", ["zlib", "zstd", "lz4", "bz2"])
def test_what_is_packed_well_is_unpacked_whole(kind):
    import zlib

    pack = {"zlib": zlib.compress, "zstd": zstd.compress, "lz4": lz4.frame.compress, "bz2": bz2.compress}[kind]
    for size in (1, 1000, 65536, 3_000_001):
        content = np.random.default_rng(size).integers(0, 7, size, dtype=np.uint8).tobytes()
        assert unpack_to(kind, pack(content), size) == content
        assert measure_unpacked(kind, pack(content), size) == size
        assert len(unpack_to(kind, pack(content), size - 1)) == size
        with pytest.raises(EOFError):
            unpack_to(kind, pack(content)[:-9], size)


def records(data: bytes) -> list[tuple[int, bytes]]:
    found, at = [], 8
    while at < len(data) - 8:
        kind, length = struct.unpack_from("<BQ", data, at)
        found.append((kind, data[at + 9 : at + 9 + length]))
        at += 9 + length
    return found


def mcap(path: Path, chunk: bytes, size: int, packing: str = "zstd", indexed: int | None = None) -> Path:
    """An MCAP file with the schemas and topics of a good one, and one chunk."""
    good = records(log_in(path.parent, ".mcap").read_bytes())
    head = next(content for kind, content in good if kind == 0x01)
    out = bytearray(b"\x89MCAP0\r\n")

    def add(kind: int, content: bytes) -> int:
        at = len(out)
        out.extend(struct.pack("<BQ", kind, len(content)) + content)
        return at

    name = struct.pack("<I", len(packing)) + packing.encode()
    times = struct.pack("<QQ", 0, 10**9)
    add(0x01, head)
    content = times + struct.pack("<QI", size, 0) + name + struct.pack("<Q", len(chunk)) + chunk
    place = add(0x06, content)
    channels = [struct.unpack_from("<H", record)[0] for kind, record in good if kind == 0x04]
    places = {channel: add(0x07, struct.pack("<HI", channel, 80) + bytes(80)) for channel in sorted(set(channels))}
    add(0x0F, struct.pack("<I", 0))
    summary = len(out)
    for kind, record in good:
        if kind in (0x03, 0x04):
            add(kind, record)
    stored = size if indexed is None else indexed
    listed = b"".join(struct.pack("<HQ", channel, at) for channel, at in places.items())
    entry = times + struct.pack("<QQI", place, 9 + len(content), len(listed)) + listed
    entry += struct.pack("<Q", 95 * len(places))
    add(0x08, entry + name + struct.pack("<QQ", len(chunk), stored))
    counts = b"".join(
        struct.pack("<HQ", struct.unpack_from("<H", record)[0], 5) for kind, record in good if kind == 0x04
    )
    add(0x0B, struct.pack("<QHIIIIQQI", 5, 1, 1, 0, 0, 1, 0, 10**9, len(counts)) + counts)
    add(0x02, struct.pack("<QQI", summary, 0, 0))
    path.write_bytes(bytes(out) + b"\x89MCAP0\r\n")
    return path


@pytest.mark.parametrize(("announced", "indexed"), [(4000, None), (4000, BOMB), (BOMB, BOMB), (4000, 4000)])
def test_a_chunk_that_lies_is_not_unpacked(tmp_path, little_memory, zstd_bomb, announced, indexed):
    path = mcap(tmp_path / "b.mcap", zstd_bomb, announced, indexed=indexed)
    with pytest.raises(DataError, match=r"b\.mcap.*(claims to hold|Chunk size mismatch|announces)"):
        read_recording(path)


def test_counts_beyond_the_bytes_are_refused(tmp_path):
    path = log_in(tmp_path, ".mcap")
    data = bytearray(path.read_bytes())
    at = 8
    while data[at] != 0x0B:
        at += 9 + struct.unpack_from("<Q", data, at + 1)[0]
    struct.pack_into("<Q", data, at + 9, 1 << 60)
    path.write_bytes(data)
    with pytest.raises(DataError, match="announces 1152921504606846976 messages"):
        read_recording(path)


def test_a_chunk_indexed_twice_is_refused(tmp_path):
    path = log_in(tmp_path, ".mcap")
    data = path.read_bytes()
    at, index = 8, b""
    while data[at] != 0x02:
        length = struct.unpack_from("<Q", data, at + 1)[0]
        if data[at] == 0x08:
            index = data[at : at + 9 + length]
            end = at + 9 + length
        at += 9 + length
    path.write_bytes(data[:end] + index * 1000 + data[end:])
    with pytest.raises(DataError, match="a second index of the chunk"):
        read_recording(path)


MARK = "import pathlib; pathlib.Path('x').touch()"


@pytest.mark.parametrize(
    "definition",
    [
        f"float64 data\n================\nMSG: a/B:\n    pass\n{MARK}\nclass C\nfloat64 data",
        f"float64 data={MARK}",
        'string A="""\n' + MARK + "\nfloat64 data",
    ],
)
@pytest.mark.parametrize("name", ["std_msgs/msg/Float64", f"a/msg/B:\n    pass\n{MARK}\nclass C", f"x';{MARK};'"])
def test_definitions_stay_data(tmp_path, monkeypatch, definition, name):
    from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat
    from rosbags.typesys import TypesysError, store

    def run(*_: object, **__: object) -> None:
        raise AssertionError("code was made of a definition")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(store, "generate_python_code", run)
    with contextlib.suppress(TypesysError):
        definitions_of(MessageDefinition(MessageDefinitionFormat.MSG, definition), name)
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize("suffix", [".mcap", ".db3", ".bag"])
def test_reading_a_bag_makes_no_code(tmp_path, monkeypatch, suffix):
    from rosbags.typesys import store

    path = log_in(tmp_path, suffix)

    def run(*_: object, **__: object) -> None:
        raise AssertionError("code was made of a definition")

    monkeypatch.setattr(store, "generate_python_code", run)
    assert read_recording(path).samples == 100


SCHEMAS = {
    "a view": "CREATE VIEW more AS SELECT * FROM messages",
    "a trigger": "CREATE TRIGGER t AFTER INSERT ON topics BEGIN DELETE FROM messages; END",
    "a virtual table": "CREATE VIRTUAL TABLE v USING fts5(a)",
}


@pytest.mark.parametrize("what", SCHEMAS)
def test_databases_hold_plain_tables_only(tmp_path, what):
    path = log_in(tmp_path, ".db3")
    base = sqlite3.connect(path)
    base.execute(SCHEMAS[what])
    base.commit()
    base.close()
    with pytest.raises(DataError, match="is not one of the plain tables"):
        read_recording(path)


def test_computed_columns_and_repeated_topics_are_refused(tmp_path):
    path = log_in(tmp_path, ".db3")
    base = sqlite3.connect(path)
    base.execute("ALTER TABLE messages RENAME TO old")
    base.execute(
        "CREATE TABLE messages(id INTEGER, topic_id INTEGER, timestamp INTEGER, "
        "data BLOB GENERATED ALWAYS AS (zeroblob(1000000000)))"
    )
    base.execute("INSERT INTO messages(id, topic_id, timestamp) SELECT id, topic_id, timestamp FROM old")
    base.commit()
    with pytest.raises(DataError, match="'messages' has computed columns"):
        read_recording(path)
    base.execute("DROP TABLE messages")
    base.execute("ALTER TABLE old RENAME TO messages")
    columns = [row[1] for row in base.execute("PRAGMA table_info(topics)")]
    base.execute("CREATE TABLE t AS SELECT * FROM topics")
    base.execute("DROP TABLE topics")
    base.execute(f"CREATE TABLE topics({', '.join(columns)})")
    base.execute("INSERT INTO topics SELECT * FROM t")
    base.execute("INSERT INTO topics SELECT * FROM t")
    base.execute("DROP TABLE t")
    base.commit()
    base.close()
    with pytest.raises(DataError, match=r"topics have . numbers"):
        read_recording(path)


def test_a_name_is_not_an_option_of_the_database(tmp_path):
    path = log_in(tmp_path, ".db3").rename(tmp_path / "a?mode=rwc&x=.db3")
    with pytest.raises(DataError, match="must not hold"):
        read_recording(path)


def bag_folder(tmp_path: Path, compression: str, packed: bytes | None = None) -> Path:
    folder = tmp_path / "bag"
    folder.mkdir()
    name = "a.mcap.zstd" if compression == "file" else "a.mcap"
    data = log_in(tmp_path, ".mcap").read_bytes()
    (folder / name).write_bytes(packed or (zstd.compress(data) if compression == "file" else data))
    (folder / "metadata.yaml").write_text(
        "rosbag2_bagfile_information: {version: 5, storage_identifier: mcap, "
        f"relative_file_paths: [{name}], compression_format: zstd, compression_mode: {compression}, "
        "duration: {nanoseconds: 990000000}, starting_time: {nanoseconds_since_epoch: 0}, message_count: 0, "
        "topics_with_message_count: []}"
    )
    return folder


def test_a_packed_bag_is_unpacked_within_bounds(tmp_path, little_memory, zstd_bomb):
    folder = bag_folder(tmp_path, "file", zstd_bomb)
    with pytest.raises(DataError, match="unpacks to more than"):
        read_recording(folder)
    (folder / "a.mcap.zstd").unlink()
    os.mkfifo(folder / "a.mcap.zstd")
    with pytest.raises(DataError, match="a log is a regular file"):
        read_recording(folder)
    (folder / "metadata.yaml").write_text("a: " + "[" * (5 << 20))
    with pytest.raises(DataError, match="a log is a regular file"):
        read_recording(folder)


@pytest.mark.parametrize("suffix", [".mcap", ".db3"])
def test_a_bag_packed_file_by_file_is_read_in_memory(tmp_path, suffix):
    written = log_in(tmp_path, suffix)
    with Reader(written) as reader:
        facts = {
            "version": 5,
            "storage_identifier": {".mcap": "mcap", ".db3": "sqlite3"}[suffix],
            "relative_file_paths": [f"a{suffix}.zstd"],
            "compression_format": "zstd",
            "compression_mode": "file",
            "duration": {"nanoseconds": reader.duration - 1},
            "starting_time": {"nanoseconds_since_epoch": reader.start_time},
            "message_count": reader.message_count,
            "topics_with_message_count": [
                {
                    "message_count": connection.msgcount,
                    "topic_metadata": {
                        "name": connection.topic,
                        "type": connection.msgtype,
                        "serialization_format": "cdr",
                        "offered_qos_profiles": "",
                    },
                }
                for connection in reader.connections
            ],
        }
    folder = tmp_path / "bag"
    folder.mkdir()
    (folder / f"a{suffix}.zstd").write_bytes(zstd.compress(written.read_bytes()))
    (folder / "metadata.yaml").write_text(json.dumps({"rosbag2_bagfile_information": facts}))
    read, plain = read_recording(folder), read_recording(written)
    assert read.channel_names == plain.channel_names
    np.testing.assert_array_equal(read.values, plain.values)


@pytest.mark.parametrize("deep", [10, 100_000])
def test_metadata_nested_deep_is_refused(tmp_path, deep):
    folder = bag_folder(tmp_path, "none")
    (folder / "metadata.yaml").write_text("a: " + "[" * deep + "]" * deep)
    with pytest.raises(DataError):
        read_recording(folder)


def test_bags_of_ros_1_are_unpacked_within_bounds(little_memory):
    from rosbags.rosbag1 import reader

    from edp.logs.formats.bag_guard import open_reader

    with pytest.raises(FileNotFoundError):
        open_reader(Path("missing.db3"))
    # lz4 cannot pack better than 255 to 1, so all of it is within the bound.
    assert len(lz4.frame.compress(bytes(1 << 24))) > (1 << 24) / 1100
    with pytest.raises(DataError, match="unpack to more than"):
        reader.decompressors["bz2"](bomb("bz2"))


@pytest.mark.parametrize("count", [1_000_000_000, 100_001])
def test_lists_of_nothing_do_not_fill_memory(count):
    from edp.logs.formats.ros_message import layout_of

    class Types:
        fielddefs = {  # noqa: RUF012
            "a/msg/A": ((), [("list", (3, ((2, "a/msg/B"), count)))]),
            "a/msg/B": ((), []),
            "a/msg/C": ((), [("list", (3, ((2, "a/msg/D"), 1000)))]),
            "a/msg/D": ((), [("list", (3, ((2, "a/msg/B"), 1000)))]),
        }

    for kind in ("a/msg/A", "a/msg/C"):
        with pytest.raises(DataError, match=r"a list of|more than 100,000 fields"):
            layout_of(bytes(8), kind, Types(), cdr=True)
