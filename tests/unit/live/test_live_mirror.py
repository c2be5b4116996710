"""The session in Rerun: what goes where, that it is optional, and that its server listens on loopback and is quiet."""

import json
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import numpy as np
import pytest

from edp.errors import ConfigError
from edp.live.layout import Forecast, LiveLayout, LiveTrace
from edp.live.session import LiveSession
from edp.workflows.live import mirror
from edp.workflows.live.mirror import RerunMirror, entities, quiet_environment

TRACES = (LiveTrace("v/1 <b>", "mm/s", 1e3), LiveTrace("T", "degC", 1.0, -273.15))
AHEAD = Forecast("v", "mm/s", 1e3, ticks=10, column=2, lower=3, upper=4, coverage=0.9, measured=0)
LAYOUT = LiveLayout("t", "s", 100.0, 6, TRACES, [AHEAD], statistics={"cusum 1": 5})


def test_every_column_that_is_shown_has_a_path_of_its_own():
    paths = entities(LAYOUT, lambda name: name.replace("/", "|"))
    assert [column for column, *_ in paths.values()] == [0, 1, 2, 3, 4, 5]
    assert paths["measured/v|1 <b> [mm|s]"] == (0, 1e3, 0.0, 0.0)
    assert paths["measured/T [degC]"] == (1, 1.0, -273.15, 0.0)
    assert paths["predicted/v [mm|s], network, 10 ticks ahead, lower"] == (3, 1e3, 0.0, 0.1)
    assert paths["monitor/cusum 1"] == (5, 1.0, 0.0, 0.0)


def test_settings_of_the_user_are_left_alone(tmp_path: Path, monkeypatch):
    monkeypatch.setenv("HOME", "/home/somebody")
    variables = quiet_environment(tmp_path)
    assert {variables[name] for name in ("HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME")} == {str(tmp_path)}


def test_without_the_package_one_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(ConfigError, match=r"pip install 'excavator-dynamics-predictor\[rerun\]'"):
        RerunMirror(LiveSession(LAYOUT))


@pytest.mark.processes
def test_a_server_that_does_not_start_is_one_error(monkeypatch, tmp_path: Path):
    program = tmp_path / "rerun"
    program.write_text("#!/bin/sh\n[ $1 = analytics ] && exit 0\necho 'the port \a is taken' >&2\nexit 3\n")
    program.chmod(0o755)
    monkeypatch.setattr(mirror, "_program", lambda: program)
    with pytest.raises(ConfigError, match="Rerun does not start: the port  is taken"):
        mirror._start_server(tmp_path, *mirror._free_ports(2))
    program.write_text("#!/bin/sh\necho no >&2\nexit 1\n")
    with pytest.raises(ConfigError, match="does not turn its telemetry off, and is not started: no"):
        mirror._start_server(tmp_path, 1, 2)


def test_a_session_is_given_in_pieces_to_a_server_on_loopback(tmp_path: Path):
    pytest.importorskip("rerun", reason="rerun-sdk is not installed: pip install 'excavator-dynamics-predictor[rerun]'")
    session = LiveSession(LAYOUT)
    shown = RerunMirror(session)
    kept = tmp_path / "kept.rrd"
    try:
        # The program itself, not a module that starts it as a child.
        assert Path(shown._process.args[0]).name.lower().startswith("rerun")
        settings = json.loads(next(shown._folder.rglob("analytics.json")).read_text(encoding="utf-8"))
        assert settings["analytics_enabled"] is False
        options = shown._process.args
        assert options[options.index("--bind") + 1] == "127.0.0.1"
        with urllib.request.urlopen(shown.address, timeout=30) as answer:
            assert b"rerun" in answer.read().lower()
        port = int(options[options.index("--port") + 1])
        for other in {info[4][0] for info in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)}:
            if not other.startswith("127."):
                with socket.socket() as one:
                    one.settimeout(2.0)
                    assert one.connect_ex((other, port)) != 0
        reader = subprocess.Popen(
            [str(mirror._program()), f"rerun+http://127.0.0.1:{port}/proxy", "--save", str(kept)],
            env=quiet_environment(tmp_path), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        rows = np.arange(6 * 120, dtype=np.float32).reshape(120, 6)
        for row in rows:
            session.append(row)
        session.event("alarm", "a sentence")
        ends = time.monotonic() + 60
        while not (kept.exists() and kept.stat().st_size > 5000) and time.monotonic() < ends:
            time.sleep(0.2)
        assert shown.skipped == 0
    finally:
        shown.close()
        reader.terminate()
        reader.wait(20)
    assert shown._process.returncode is not None
    said = subprocess.run(
        [str(mirror._program()), "rrd", "print", "-vv", str(kept)],
        env=quiet_environment(tmp_path), capture_output=True, text=True, timeout=120,
    ).stdout  # fmt: skip
    assert "predicted" in said
    assert "monitor" in said
