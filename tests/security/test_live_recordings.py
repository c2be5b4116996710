"""MCAP files with JSON messages that are not what they seem: one error each, within bounds."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest

from edp.errors import DataError
from edp.logs import read_recording
from edp.logs.formats.mcap_json import LONGEST_MESSAGE, MAX_PATHS, read_json_mcap
from edp.signals import SignalMap

MAGIC = b"\x89MCAP0\r\n"


def text(value: str | bytes) -> bytes:
    data = value.encode() if isinstance(value, str) else value
    return struct.pack("<I", len(data)) + data


def record(kind: int, body: bytes) -> bytes:
    return struct.pack("<BQ", kind, len(body)) + body


def channel(number: int = 1, topic: str = "/a", encoding: str = "json") -> bytes:
    return record(4, struct.pack("<HH", number, 0) + text(topic) + text(encoding) + text(b""))


def message(content: bytes, tick: int = 0, number: int = 1) -> bytes:
    return record(5, struct.pack("<HIQQ", number, tick, tick * 10_000_000, 0) + content)


def mcap(path: Path, *records: bytes, profile: str = "") -> Path:
    head = record(1, text(profile) + text("test"))
    path.write_bytes(MAGIC + head + b"".join(records) + record(15, bytes(4)) + record(2, bytes(20)) + MAGIC)
    return path


def rows(count: int = 20, **more: object) -> list[bytes]:
    return [message(json.dumps({"CylVels_1": k / 10, **more}).encode(), k) for k in range(count)]


def test_messages_in_json_are_columns(tmp_path):
    more = {"deep": {"list": [1, 2]}, "text": "x", "gone": None}
    path = mcap(tmp_path / "a.mcap", channel(), *rows(**more), message(b'{"CylVels_1":2,"late":5}', 20))
    log = read_json_mcap(path)
    assert set(log.signals) == {"CylVels_1", "deep.list_1", "deep.list_2", "gone", "late"}
    assert np.isnan(log.signal("gone").values).all()
    assert np.isnan(log.signal("late").values).sum() == 20
    assert np.isnan(log.signal("deep.list_1").values).sum() == 1
    recording = read_recording(path, SignalMap(rate_hz=100.0))
    assert recording.channel_names == ("CylVels_1",)
    assert recording.samples == 21


def test_topics_with_the_same_names_are_told_apart(tmp_path):
    other = [message(b'{"CylVels_1":1}', k, 2) for k in range(20)]
    path = mcap(tmp_path / "a.mcap", channel(), channel(2, "/b"), *rows(), *other)
    with pytest.raises(DataError, match=r"/a\.CylVels_1"):
        read_json_mcap(path).signal("CylVels_1")


@pytest.mark.parametrize(
    ("records", "said"),
    [
        ([channel(), message(b"not json")], "not valid JSON"),
        ([channel(), message(b'{"a":NaN}')], "not valid JSON"),
        ([channel(), message(b'{"a":1,"a":2}')], "not valid JSON"),
        ([channel(), message(b"[" * 5000)], "not valid JSON"),
        ([channel(), message(b'{"a":' + b"9" * 5000 + b"}")], "not valid JSON"),
        ([channel(), message(b"\xff\xfe")], "damaged"),
        ([channel(), message(b'{"a":"' + b"x" * LONGEST_MESSAGE + b'"}')], "a message of"),
        ([channel(), message(json.dumps({f"c{n}": n for n in range(MAX_PATHS + 1)}).encode())], "more than 4096"),
        ([message(b"{}")], "which nothing describes"),
        ([channel(encoding="protobuf"), message(b"\0")], r"encodings: protobuf"),
        ([channel(), message(b'{"a":"text"}')], "no numbers"),
        ([channel(topic="/" + "x" * 5000), *rows()], "topic with a name"),
        ([channel(n, f"/{n}") for n in range(1100)], "more than 1024 channels"),
        ([record(4, b"\x01")], "damaged"),
        ([channel(), record(5, b"\x01\x00")], "damaged"),
        ([channel(), record(5, struct.pack("<HIQQ", 1, 0, 2**63, 0) + b"{}")], "a message of"),
        ([record(6, struct.pack("<QQQII", 0, 0, 10, 0, 3) + b"rar" + struct.pack("<Q", 4) + b"abcd")], "packed by"),
        ([record(6, struct.pack("<QQQII", 0, 0, 10, 0, 4) + b"zstd" + struct.pack("<Q", 4) + b"abcd")], "unpacked"),
        ([record(6, struct.pack("<QQQII", 0, 0, 1 << 50, 0, 4) + b"zstd" + struct.pack("<Q", 4) + b"abcd")], "claims"),
        ([channel(1, "/edp/info"), channel(2, "/a"), message(b"{}"), message(b'{"a":1}', 1, 2)], "damaged"),
    ],
)
def test_what_a_file_is_not_is_one_error(tmp_path, records, said):
    with pytest.raises(DataError, match=said) as error:
        read_recording(mcap(tmp_path / "bad.mcap", *records))
    assert "bad.mcap" in str(error.value)


def test_a_file_cut_anywhere_is_refused(tmp_path):
    whole = mcap(tmp_path / "a.mcap", channel(), *rows()).read_bytes()
    for end in range(0, len(whole) - 1, 97):
        (tmp_path / "a.mcap").write_bytes(whole[:end])
        with pytest.raises(DataError):
            read_json_mcap(tmp_path / "a.mcap")
