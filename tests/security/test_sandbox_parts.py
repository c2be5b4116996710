"""The parts of the sandbox one by one: messages, filters, the audit hook, memory that is free."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
import pytest

from edp.cli import notices
from edp.errors import DataError
from edp.logs import FORMATS, WriteOptions, read_recording, write_recording
from edp.logs.sandboxed import plain_map
from edp.logs.served import map_of
from edp.recording import Recording
from edp.sandbox import sandbox, watch
from edp.sandbox.audit import hook
from edp.sandbox.protocol import HEADER_BYTES, packed, receive
from edp.signals import TABLE_A1, Channel, ChannelMap, Kind, SignalMap
from edp.storage import memory as limits

SUFFIXES = [part.suffixes[0] for part in FORMATS.values()]


def recording(samples):
    channels = (TABLE_A1["BmUp"], TABLE_A1["CylVels_1"], Channel("Extra", Kind.GENERIC))
    return Recording("R1", channels, np.ones((samples, 3), dtype=np.float32), 100.0)


def test_the_command_line_says_what_takes_long(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["edp", "data", "check", "a.csv"])
    try:
        notices.tell_of_slow_logs()
        heard = sandbox._watcher
        for seconds in (5.1, 6.0, 9.0, 10.5, 15.0, 21.2):
            heard(Path("day/a[/b]\x1b.mf4"), seconds, 1_200_000_000)
        heard(Path("b.mf4"), 5.0, 3_000_000)
        watch(None)
        monkeypatch.setattr(sys, "argv", ["edp", "data", "check", "a.csv", "--json"])
        notices.tell_of_slow_logs()
        assert sandbox._watcher is None
    finally:
        watch(None)
    said = capsys.readouterr().err
    assert "\x1b" not in said
    assert [line.partition("(")[2] for line in said.splitlines()] == [
        "5 s, 1.2 GB)", "10 s, 1.2 GB)", "21 s, 1.2 GB)", "5 s, 3 MB)"
    ]  # fmt: skip


def test_maps_pass_unchanged():
    plain = SignalMap(
        (ChannelMap("a", "b", "bar", Kind.PRESSURE, None, 2.0, "x"), ChannelMap("c", "", constant=1e30)),
        "t", "ms", None, 50.0, False, ("t", "b"), "v", ";", ",", True,
    )  # fmt: skip
    assert map_of(plain_map(plain)) == plain
    assert map_of(plain_map(SignalMap())) == SignalMap()


def feed(data):
    left = memoryview(data)

    def read_into(view):
        nonlocal left
        if len(left) < len(view):
            raise EOFError
        view[:] = left[: len(view)]
        left = left[len(view) :]

    return read_into


@pytest.mark.parametrize(
    "message",
    [
        (HEADER_BYTES + 1).to_bytes(8, "little"),
        packed({"arrays": [["<f8", 3]]}),
        packed({"arrays": [["<f8", -1]]}),
        packed({"arrays": [["<f8", 1e3]]}),
        packed({"arrays": [["<f8", True]]}),
        packed({"arrays": [["O", 1]]}),
        packed({"arrays": [["<M8[s]", 1]]}),
        packed({"arrays": [["<f8,<f8", 1]]}),
        packed({"arrays": [["(2,)<f8", 1]]}),
        packed({"arrays": 5}),
        packed({"arrays": [5]}),
        (2).to_bytes(8, "little") + b"[]",
        (2).to_bytes(8, "little") + b"\xff\xff",
        (200_000).to_bytes(8, "little") + b"[" * 200_000,
    ],
)
def test_messages_beyond_their_bounds_are_refused(message):
    with pytest.raises(ValueError):  # noqa: PT011 - of many kinds
        receive(feed(message + bytes(64)), 16)


def test_the_audit_hook_alone_refuses(tmp_path):
    judge = hook([tmp_path])
    judge("open", (str(tmp_path / "a"), "r", os.O_RDONLY))
    judge("open", (3, "r", os.O_RDONLY))
    judge("import", ("json",))
    for event, arguments in [
        ("open", (str(tmp_path / "a"), "w", os.O_WRONLY | os.O_CREAT)),
        ("open", ("/etc/passwd", "r", os.O_RDONLY)),
        ("open", (str(tmp_path / ".." / "b"), "r", os.O_RDONLY)),
        ("open", (b"/etc/passwd", "r", os.O_RDONLY)),
        ("sqlite3.connect", ("file:/etc/passwd?mode=ro",)),
        ("socket.connect", ()),
        ("subprocess.Popen", ()),
        ("pickle.find_class", ()),
    ]:
        with pytest.raises(PermissionError):
            judge(event, arguments)


def test_free_memory_is_the_least_of_machine_group_and_limits(tmp_path, monkeypatch):
    groups = tmp_path / "groups"
    (groups / "a" / "b").mkdir(parents=True)
    (groups / "a" / "memory.max").write_text("1000000\n")
    (groups / "a" / "memory.current").write_text("400000\n")
    (groups / "a" / "memory.stat").write_text("anon 5\ninactive_file 100000\n")
    (groups / "a" / "b" / "memory.max").write_text("max\n")
    (groups / "a" / "b" / "memory.current").write_text("1\n")
    old = groups / "memory" / "c"
    old.mkdir(parents=True)
    (old / "memory.limit_in_bytes").write_text("900000")
    (old / "memory.usage_in_bytes").write_text("300000")
    (tmp_path / "cgroup").write_text("0::/a/b\n4:memory,cpu:/c\n3:cpuset:/\n")
    assert sorted(limits._groups(tmp_path / "cgroup", groups)) == [600_000, 700_000]
    assert list(limits._groups(tmp_path / "none", groups)) == []
    for name in ("_machine", "_groups", "_own_limits"):
        monkeypatch.setattr(limits, name, (lambda: 50) if name == "_machine" else (list))
    assert limits.free_bytes() == 50
    monkeypatch.setattr(limits, "_own_limits", lambda: [-3, 9])
    assert limits.free_bytes() == 0


@pytest.mark.parametrize("version", ["v5", "v7.3"])
def test_limits_grow_with_what_a_mat_file_holds(tmp_path, version):
    from edp.logs.formats.matlab.unpacking import unpack

    told = []
    limits.listen(lambda *limit: told.append(limit))
    try:
        for samples in (10, 10_000):
            unpack(write_recording(recording(samples), tmp_path / "a.mat", WriteOptions(mat_version=version)))
    finally:
        limits.listen(None)
    announced = [limit for limit in told if limit[1]]
    assert len(announced) == 2
    assert announced[1][0] - announced[0][0] > 8 * 9_000 * 12


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes with names are POSIX")
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_what_is_no_regular_file_is_refused_unopened(tmp_path, suffix):
    pipe, link = tmp_path / f"pipe{suffix}", tmp_path / f"link{suffix}"
    os.mkfifo(pipe)
    link.symlink_to(pipe)
    endless = tmp_path / f"zero{suffix}"
    endless.symlink_to("/dev/zero")
    for path in (pipe, link, endless):
        with pytest.raises(DataError, match="a regular file"):
            read_recording(path)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes with names are POSIX")
def test_a_bag_with_a_pipe_in_it_is_refused(tmp_path):
    bag = tmp_path / "bag"
    bag.mkdir()
    (bag / "metadata.yaml").write_text("rosbag2_bagfile_information: {}")
    os.mkfifo(bag / "a.db3")
    with pytest.raises(DataError, match="a regular file"):
        read_recording(bag)
