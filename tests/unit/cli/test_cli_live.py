"""``edp live`` as a command: one source, files at the end, a clean end by Ctrl-C."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import numpy as np
import pytest

from edp.logs import read_recording, write_recording
from edp.recording import Recording
from edp.signals import TABLE_A1, Channel, Kind


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> Path:
    rng = np.random.default_rng(0)
    channels = (*list(TABLE_A1.values())[:2], Channel("<script>alert(1)</script>", Kind.GENERIC))
    values = rng.normal(size=(120, 3)).astype(np.float32)
    path = tmp_path_factory.mktemp("live") / "log.parquet"
    write_recording(Recording("log", channels, values, 100.0), path)
    return path


def test_a_log_is_played_to_its_end_saved_and_recorded(edp, log, tmp_path):
    page, bag = tmp_path / "s.html", tmp_path / "s.mcap"
    pytest.importorskip("foxglove")
    ended = edp("live", "--log", log, "--until-end", "--speed", "inf", "--save", page, "--record", bag, "--json")
    assert ended.code == 0, ended.err
    assert ended.json["ticks"] == 120
    assert ended.json["ended"].startswith("the log has ended")
    assert "http://127.0.0.1:" in ended.err
    assert '"count":120' in page.read_text(encoding="utf-8")
    original, back = read_recording(log), read_recording(bag)
    assert back.rate_hz == 100.0
    assert [c.kind for c in back.channels] == [c.kind for c in original.channels]
    np.testing.assert_array_equal(back.values, original.values)
    again = edp("live", "--log", log, "--until-end", "--record", bag)
    assert again.code == 1
    assert "choose a new file" in again.err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "takes one source, and no source was given"),
        (("--sim", "M22", "--udp", "0"), "--sim and --udp was given"),
        (("--log", "nowhere.csv"), "nowhere.csv"),
        (("--sim", "M23"), "M23"),
        (("--loop", "digging"), "digging"),
        (("--udp", "0"), "give --rate"),
        (("--ros2", "--rate", "100"), "needs ROS 2"),
        (("--sim", "M22", "--speed", "0"), "times real time"),
        (("--sim", "M22", "--save", "a.txt"), "ends in .html"),
        (("--sim", "M22", "--record", "a.bag"), "ends in .mcap"),
        (("nowhere", "--sim", "M22"), "nowhere"),
        (("--loop", "grade", "--plant", "nowhere"), "nowhere"),
        (("--loop", "grade", "--plant", "some.fmu"), "there is no file"),
        (("--sim", "M22", "--plant", "runs/twin"), "--plant does not apply to --sim; it belongs to --loop"),
        (("--loop", "grade", "--excitation", "dig"), "--excitation does not apply to --loop; it belongs to --sim"),
        (("--sim", "M22", "--monitor", "nowhere"), "nowhere"),
    ],
)
def test_what_cannot_be_is_one_error(edp, words, message):
    ended = edp("live", *words)
    assert ended.code == 1
    assert message in ended.err
    assert ended.err.count("error:") == 1


def test_a_port_in_use_ends_before_anything_is_played(edp, log, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        ended = edp("live", "--log", log, "--port", port)
    assert ended.code == 1
    assert f"port {port}" in ended.err
    assert "another --port" in ended.err


def test_ctrl_c_ends_the_session_and_its_files(log, tmp_path):
    page = tmp_path / "s.html"
    command = [sys.executable, "-m", "edp", "live", "--log", str(log), "--speed", "0.1", "--save", str(page), "--json"]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env={**os.environ, "COLUMNS": "200"}
    )
    try:
        address = ""
        while not address:
            line = process.stderr.readline()
            assert line, "the command ended"
            found = re.search(r"http://\S+", line)
            address = found.group() if found else ""
        with urllib.request.urlopen(address, timeout=30) as answer:
            assert "Content-Security-Policy" in answer.headers
        time.sleep(0.3)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 0, err
    assert "Traceback" not in err
    assert json.loads(out)["ended"] == "the session was ended"
    assert page.exists()
