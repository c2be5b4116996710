"""``--rerun``: the session in the viewer Rerun in addition to EDP's page; needs Rerun's package.

Rerun is started by its command line, which unlike its Python interface can be told to listen on loopback only; its
telemetry is off in a settings folder of its own, so that those of the user stay as they are. Rows go in segments from a
thread of their own: a viewer that is slow loses rows, and never slows the source.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from edp.errors import ConfigError, brief
from edp.live.layout import LiveLayout
from edp.live.session import LiveSession
from edp.storage.paths import is_there

LOOPBACK = "127.0.0.1"
PIECE_S = 0.5
"""Time between batches of rows. A batch costs the same for one row as for fifty."""
MAX_ROWS = 6000
"""Maximum number of rows in a batch; further rows are omitted."""
START_S, END_S = 30.0, 3.0
MEMORY = "1GiB"
"""Memory of Rerun's server for viewers that connect later. The oldest rows are removed first."""
TIMELINE = "session"


class RerunMirror:
    """Rerun server in its own process, with a thread that sends a session's rows.

    Args:
        session: session to display.

    Attributes:
        address: address of the page.
        skipped: rows that were left out because the source ran ahead.

    Raises:
        ConfigError: the package is not installed, or its server does not start.
    """

    def __init__(self, session: LiveSession) -> None:
        try:
            import rerun
        except ImportError as error:
            raise ConfigError(
                "--rerun needs the package rerun-sdk, which is not installed; run pip install "
                "'excavator-dynamics-predictor[rerun]', or leave --rerun out: the own page shows the same"
            ) from error
        self._rerun, self._session, self.skipped = rerun, session, 0
        self._sent, self._told = session.ticks, 0
        self._over = threading.Event()
        self._files = contextlib.ExitStack()
        try:
            self._folder = folder = Path(
                self._files.enter_context(tempfile.TemporaryDirectory(ignore_cleanup_errors=True))
            )
            port, page = _free_ports(2)
            self._process = _start_server(folder, port, page)
            inner = f"rerun+http://{LOOPBACK}:{port}/proxy"
            self.address = f"http://{LOOPBACK}:{page}/?url={quote(inner, safe='')}"
            self._stream = rerun.RecordingStream("edp_live", send_properties=False)
            self._stream.connect_grpc(inner)
        except BaseException:
            self._files.close()
            raise
        self._entities = entities(session.layout, rerun.escape_entity_path_part)
        self._thread = threading.Thread(target=self._follow, name="edp-live-rerun", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Send the remaining rows, and stop the server."""
        self._over.set()
        self._thread.join(END_S)
        with contextlib.suppress(Exception):  # a server that has gone takes nothing any more, which is no news
            self._stream.flush(timeout_sec=END_S)
            self._stream.disconnect()
        self._process.terminate()
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._files.close()

    def _follow(self) -> None:
        try:
            while not self._over.wait(PIECE_S):
                self._give()
            self._give()
        except Exception as error:  # Rerun's own errors have no common base
            self._session.event("warning", f"Rerun shows nothing more ({brief(error)}); this page goes on")

    def _give(self) -> None:
        session, rerun = self._session, self._rerun
        for event in session.events(self._told):
            self._told = event.number + 1
            at = [rerun.TimeColumn(TIMELINE, duration=[event.tick / session.layout.rate_hz])]
            level = {"alarm": "ERROR", "warning": "WARN"}.get(event.kind, "INFO")
            columns = rerun.TextLog.columns(text=[event.text], level=[level])
            rerun.send_columns("events", indexes=at, columns=columns, recording=self._stream)
        waiting = session.ticks - self._sent
        if waiting <= 0:
            return
        first, rows = session.read(session.ticks - min(waiting, MAX_ROWS), MAX_ROWS)
        self.skipped += first - self._sent
        self._sent = first + len(rows)
        seconds = (first + np.arange(len(rows))) / session.layout.rate_hz
        for path, (column, factor, offset, ahead_s) in self._entities.items():
            times = [rerun.TimeColumn(TIMELINE, duration=seconds + ahead_s)]
            values = rerun.Scalars.columns(scalars=rows[:, column].astype(np.float64) * factor + offset)
            rerun.send_columns(path, indexes=times, columns=values, recording=self._stream)


def entities(layout: LiveLayout, escaped: Any = str) -> Mapping[str, tuple[int, float, float, float]]:
    """Return path in Rerun of each column that is shown: column, factor and offset to the shown unit, seconds ahead.

    Predictions stand at the time for which they were made, below the same unit as what is measured.

    Args:
        layout: layout of the session.
        escaped: a name as one part of a path; names are text, whatever is in them.
    """
    paths: dict[str, tuple[int, float, float, float]] = {}
    for column, trace in enumerate(layout.traces):
        paths[f"measured/{escaped(f'{trace.name} [{trace.unit}]')}"] = (column, trace.factor, trace.offset, 0.0)
    for one in layout.forecasts:
        what = f"{one.name} [{one.unit}], {one.model}, {one.ticks} ticks ahead"
        ends = {"": one.column, ", lower": one.lower, ", upper": one.upper}
        for end, at_column in ends.items():
            if at_column is not None:
                path = f"predicted/{escaped(what + end)}"
                paths[path] = (at_column, one.factor, one.offset, one.ticks / layout.rate_hz)
    for name, at_column in (layout.statistics or {}).items():
        paths[f"monitor/{escaped(name)}"] = (at_column, 1.0, 0.0, 0.0)
    return paths


def quiet_environment(folder: Path) -> dict[str, str]:
    """Return environment variables that disable Rerun's telemetry and keep its settings in the session folder."""
    places = dict.fromkeys(("HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_CACHE_HOME", "APPDATA", "LOCALAPPDATA"))
    return {**os.environ, **dict.fromkeys(places, str(folder))}


def _start_server(folder: Path, port: int, page: int) -> subprocess.Popen[bytes]:
    """Return the Rerun's server, once it listens."""
    variables, call = quiet_environment(folder), [str(_program())]
    quiet: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, "env": variables}
    done = subprocess.run([*call, "analytics", "disable"], stderr=subprocess.PIPE, timeout=START_S, **quiet)
    if done.returncode:
        raise ConfigError(f"Rerun does not turn its telemetry off, and is not started: {_last(done.stderr)}")
    options = ["--serve-web", "--bind", LOOPBACK, "--port", str(port), "--web-viewer-port", str(page)]
    with (folder / "said.txt").open("wb") as errors:
        process = subprocess.Popen([*call, *options, "--server-memory-limit", MEMORY], stderr=errors, **quiet)
    ends = time.monotonic() + START_S
    while not all(map(_listens, (port, page))):
        if process.poll() is not None or time.monotonic() > ends:
            process.kill()
            process.wait()
            text = _last((folder / "said.txt").read_bytes())
            raise ConfigError(f"Rerun does not start: {text}; leave --rerun out")
        time.sleep(0.05)
    return process


def _program() -> Path:
    """Return Rerun's own program.

    The module of the same purpose starts a child process, which would outlive the session.
    """
    spec = importlib.util.find_spec("rerun_cli")
    if spec is None or spec.origin is None:
        raise ConfigError("rerun-sdk is installed without its command line; install it from its wheel")
    folder = Path(spec.origin).parent
    names = ("rerun.exe",) if sys.platform == "win32" else ("Rerun.app/Contents/MacOS/Rerun", "rerun")
    return next((folder / name for name in names if is_there(folder / name)), folder / names[-1])


def _last(text: bytes) -> str:
    lines = text.decode("utf-8", "replace").strip().splitlines()
    return "".join(letter for letter in (lines or ["it says nothing"])[-1] if letter.isprintable())[:300]


def _free_ports(count: int) -> list[int]:
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for one in sockets:
            one.bind((LOOPBACK, 0))
        return [int(one.getsockname()[1]) for one in sockets]


def _listens(port: int) -> bool:
    with socket.socket() as one:
        one.settimeout(1.0)
        return one.connect_ex((LOOPBACK, port)) == 0
