"""Writer for bags: a topic with one message per sample, and a topic with EDP's metadata."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.errors import DataError
from edp.logs.formats.edp_metadata import facts_text
from edp.recording import Recording

FACTS_TOPIC = "/edp/info"
_TOPIC = "/edp/recording"
_TYPE = "edp_msgs/msg/Sample"
_TEXT = "std_msgs/msg/String"
_BLOCK_ROWS = 1 << 13
"""Number of messages serialised at a time."""


def write_bag(recording: Recording, path: Path, container: str) -> None:
    """Write `recording` to `path` as ``mcap``, ``rosbag2`` (SQLite) or ``rosbag1``.

    Raises:
        DataError: a channel's name cannot name a field, or rosbags is not installed.
    """
    odd = [name for name in recording.channel_names if not (name.isascii() and name.isidentifier())]
    if odd:
        raise DataError(
            f"channel(s) {', '.join(odd)} cannot be fields of a message (letters, digits, underscore); rename them in "
            "the signal map"
        )
    try:
        import rosbags  # noqa: F401
    except ImportError as error:
        raise DataError(
            "bags and MCAP files need the package rosbags, which is not installed; run pip install "
            "'excavator-dynamics-predictor[ros]', or write CSV, Parquet or MAT"
        ) from error
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".bag") as name:
        folder = Path(name)
        unfinished_bag = _write1(recording, folder) if container == "rosbag1" else _write2(recording, folder, container)
        # The target exists already and keeps its name; a move within a folder copies nothing.
        shutil.move(unfinished_bag, path)


def _write2(recording: Recording, folder: Path, container: str) -> Path:
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.rosbag2.enums import CompressionFormat, CompressionMode

    plugin = StoragePlugin.MCAP if container == "mcap" else StoragePlugin.SQLITE3
    target = folder / "bag"
    writer = Writer(target, version=9, storage_plugin=plugin)
    if container == "mcap":
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        _fill(writer, recording, "ros2_humble", cdr=True)
    return next(file for file in target.iterdir() if file.suffix in (".mcap", ".db3"))


def _write1(recording: Recording, folder: Path) -> Path:
    from rosbags.rosbag1 import Writer

    target = folder / "bag.bag"
    writer = Writer(target)
    writer.set_compression(Writer.CompressionFormat.LZ4)
    with writer:
        _fill(writer, recording, "ros1_noetic", cdr=False)
    return target


def _fill(writer: Any, recording: Recording, distribution: str, cdr: bool) -> None:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores(distribution))
    fields = "".join(f"float32 {name}\n" for name in recording.channel_names)
    store.register(get_types_from_msg(f"std_msgs/Header header\n{fields}", _TYPE))
    facts = writer.add_connection(FACTS_TOPIC, _TEXT, typestore=store)
    samples = writer.add_connection(_TOPIC, _TYPE, typestore=store)
    text = store.types[_TEXT](data=facts_text(recording))
    pack = store.serialize_cdr if cdr else store.serialize_ros1
    writer.write(facts, 0, bytes(pack(text, _TEXT)))
    for start in range(0, recording.samples, _BLOCK_ROWS):
        values = recording.values[start : start + _BLOCK_ROWS]
        at_ns = np.rint(np.arange(start, start + len(values)) * (1e9 / recording.rate_hz)).astype(np.int64)
        for stamp, message in zip(at_ns.tolist(), _messages(values, at_ns, start, cdr)):
            writer.write(samples, stamp, message)


def _messages(values: NDArray[np.float32], at_ns: NDArray[np.int64], start: int, cdr: bool) -> Iterator[bytes]:
    """Yield serialised messages: a header with stamp and empty frame, then the values."""
    seconds, nanoseconds = np.divmod(at_ns, 1_000_000_000)
    if cdr:
        # 4 bytes of encoding, stamp, an empty text (its length counts the zero behind it) and 3 bytes to align.
        head = [np.full(len(values), 0x00000100, dtype="<u4"), seconds.astype("<i4"), nanoseconds.astype("<u4")]
        head += [np.full(len(values), 1, dtype="<u4"), np.zeros(len(values), dtype="<u4")]
    else:
        rows = np.arange(start, start + len(values))
        head = [rows.astype("<u4"), seconds.astype("<u4"), nanoseconds.astype("<u4")]
        head += [np.zeros(len(values), dtype="<u4")]
    parts = [part.view(np.uint8).reshape(len(values), 4) for part in head]
    body = np.ascontiguousarray(values.astype("<f4")).view(np.uint8).reshape(len(values), -1)
    whole = np.hstack([*parts, body])
    return (row.tobytes() for row in whole)
