"""The server: who may see a session, and what a slow, odd or vanished viewer does to it."""

import asyncio
import contextlib
import json
import socket
import threading
import time
from collections.abc import Iterator
from http.client import HTTPConnection

import numpy as np
import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect

from edp.errors import ConfigError
from edp.live import LiveLayout, LiveSession, LiveTrace, Pace
from edp.live.protocol import HEAD, PAST, ROWS
from edp.live.server import MAX_VIEWERS, LiveServer
from edp.live.viewer import Viewer
from edp.signals import Channel, Kind

NAMES = ["<img src=x onerror=alert(1)>", "</script><script>", "a\u202eb"]


class Served:
    """A server in a thread of its own."""

    def __init__(self, server: LiveServer) -> None:
        self.server, self.session = server, server.session
        self._ready, self._loop, self._stop = threading.Event(), None, None
        self._thread = threading.Thread(target=lambda: asyncio.run(self._run()), daemon=True)
        self._thread.start()
        assert self._ready.wait(20)

    async def _run(self) -> None:
        self._loop, self._stop = asyncio.get_running_loop(), asyncio.Event()
        await self.server.run(self._stop, lambda server: self._ready.set())

    def close(self) -> None:
        self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join(20)
        assert not self._thread.is_alive()

    def get(self, path: str, **headers: str) -> tuple[int, str, dict[str, str]]:
        connection = HTTPConnection("127.0.0.1", self.server.port, timeout=20)
        connection.request("GET", path, headers=headers)
        answer = connection.getresponse()
        text = answer.read().decode()
        connection.close()
        return answer.status, text, {name.lower(): value for name, value in answer.getheaders()}

    def viewer(self, token: str | None = None, origin: str | None = None, **options) -> ClientConnection:
        port = self.server.port
        return connect(
            f"ws://127.0.0.1:{port}/{self.server.token if token is None else token}/socket",
            origin=origin or f"http://127.0.0.1:{port}",
            **options,
        )


@pytest.fixture
def served() -> Iterator[Served]:
    traces = [LiveTrace.from_channel(Channel(name, Kind.VELOCITY)) for name in NAMES]
    layout = LiveLayout("<b>title</b>", "source", 100.0, len(NAMES), traces, steered=True)
    one = Served(LiveServer(LiveSession(layout), Pace(100.0)))
    yield one
    one.close()


def stream(session: LiveSession, ticks: int) -> None:
    for _ in range(ticks):
        session.append(np.full(len(NAMES), session.ticks, np.float32))


def until(condition, seconds: float = 20.0) -> None:
    ends = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < ends
        time.sleep(0.01)


def rows_of(viewer: ClientConnection, upto: int) -> list[tuple[int, int, np.ndarray]]:
    """Messages of rows until a tick has come."""
    messages = []
    while not messages or messages[-1][1] + len(messages[-1][2]) < upto:
        message = viewer.recv(timeout=20)
        if isinstance(message, bytes):
            kind, first, count, width, _ = HEAD.unpack_from(message)
            messages.append((kind, first, np.frombuffer(message[HEAD.size :], "<f4").reshape(count, width)))
    return messages


def texts(viewer: ClientConnection, kind: str) -> dict:
    while True:
        message = viewer.recv(timeout=20)
        if isinstance(message, str) and json.loads(message)["type"] == kind:
            return json.loads(message)


def test_a_viewer_sees_what_was_and_what_comes(served):
    stream(served.session, 30)
    until(lambda: served.server._sent == 30)
    with served.viewer() as viewer:
        layout = texts(viewer, "layout")["layout"]
        assert [trace["name"] for trace in layout["traces"]] == [*NAMES[:2], "a\N{REPLACEMENT CHARACTER}b"]
        before = rows_of(viewer, 30)
        stream(served.session, 20)
        after = rows_of(viewer, 50)
    assert [kind for kind, _, _ in before] == [PAST]
    assert {kind for kind, _, _ in after} == {ROWS}
    values = np.concatenate([rows[:, 0] for _, _, rows in (*before, *after)])
    assert values.tolist() == list(range(50))


@pytest.mark.parametrize("token", ["", "wrong", "x" * 4000, "%00", "ä"])
def test_without_the_token_there_is_neither_page_nor_socket(served, token):
    path = token.encode("utf-8").decode("latin-1")
    assert served.get(f"/{path}/" if token != "ä" else "/%C3%A4/")[0] == 403
    assert served.get(f"/{served.server.token[:-1]}/")[0] == 403
    with pytest.raises(InvalidStatus, match="403"):
        served.viewer(token="wrong")
    assert served.get("/")[0] == 403


def test_tokens_are_new_and_long():
    session = LiveSession(LiveLayout("t", "s", 1.0, 1, []))
    tokens = {LiveServer(session, None).token for _ in range(50)}
    assert len(tokens) == 50
    assert min(map(len, tokens)) >= 32


def test_pages_of_others_open_no_socket_and_other_names_no_page(served):
    with pytest.raises(InvalidStatus, match="403"):
        served.viewer(origin="http://evil.example")
    with pytest.raises(InvalidStatus, match="403"):
        served.viewer(origin=f"http://localhost:{served.server.port}")  # of another host than it asks
    path = f"/{served.server.token}/"
    for host in ("evil.example", f"evil.example:{served.server.port}", "127.0.0.1:1", "[", "127.0.0.1"):
        assert served.get(path, Host=host)[0] == 421
    assert served.get(path, Host=f"localhost:{served.server.port}")[0] == 200
    assert served.get(f"{path}other")[0] == 404


def test_the_page_has_a_policy_and_no_name_in_it_is_markup(served):
    status, page, headers = served.get(f"/{served.server.token}/")
    assert status == 200
    policy = dict(rule.split(" ", 1) for rule in headers["content-security-policy"].split("; "))
    assert policy["default-src"] == policy["base-uri"] == policy["form-action"] == policy["frame-ancestors"] == "'none'"
    assert policy["script-src"].startswith("'sha256-")
    assert "unsafe" not in headers["content-security-policy"]
    assert policy["connect-src"] == f"ws://127.0.0.1:{served.server.port}"
    assert headers["referrer-policy"] == "no-referrer"
    assert headers["cache-control"] == "no-store"
    assert "<b>title</b>" not in page
    assert "&lt;b&gt;title" in page


def test_a_session_can_be_saved_by_the_page(served):
    stream(served.session, 10)
    status, page, headers = served.get(f"/{served.server.token}/session.html")
    assert status == 200
    assert "attachment" in headers["content-disposition"]
    assert '"count":10' in page


def test_viewers_steer_the_playback_and_odd_requests_are_told(served):
    pace = served.server.pace
    with served.viewer() as viewer:
        viewer.send('{"do":"pause","value":1}')
        until(lambda: pace.paused)
        viewer.send('{"do":"speed","value":4}')
        until(lambda: pace.speed == 4.0)
        viewer.send('{"do":"speed","value":0}')
        assert "times real time" in texts(viewer, "refused")["text"]
        viewer.send('{"do":"delete"}')
        assert "names one of" in texts(viewer, "refused")["text"]
        viewer.send("x" * 100_000)
        with contextlib.suppress(Exception):
            while True:
                viewer.recv(timeout=20)
    assert pace.speed == 4.0
    with served.viewer() as other:  # the server is still there for others
        texts(other, "layout")


def test_a_source_that_runs_by_itself_is_not_steered(served):
    served.server.pace = None
    with served.viewer() as viewer:
        viewer.send('{"do":"pause","value":1}')
        assert "runs by itself" in texts(viewer, "refused")["text"]


def test_a_stalled_viewer_loses_frames_and_nobody_else_does(served, monkeypatch):
    monkeypatch.setattr("edp.live.viewer.MAX_WAITING", 4)
    width, ticks = 4000, 300  # large rows fill the buffers of the system soon
    served.server.session = served.session = session = LiveSession(LiveLayout("t", "s", 100.0, width, []))
    narrow = socket.socket()
    narrow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 16)
    narrow.connect(("127.0.0.1", served.server.port))
    with (
        served.viewer(max_queue=1, sock=narrow, max_size=None, close_timeout=0.1) as stalled,
        served.viewer(max_size=None) as good,
    ):
        texts(stalled, "layout")
        texts(good, "layout")
        received = []
        reading = threading.Thread(target=lambda: received.extend(rows_of(good, ticks)))
        reading.start()
        for tick in range(ticks):
            session.append(np.full(width, tick, np.float32))
            time.sleep(0.003)
        reading.join(30)
        values = np.concatenate([rows[:, 0] for _, _, rows in received])
        assert values.tolist() == list(range(ticks))
        assert session.ticks == ticks
        drops = sorted(one.dropped for one in served.server.viewers)
        assert drops[0] == 0 < drops[1]
        assert max(len(one._rows) for one in served.server.viewers) <= 4
        # What it lost is told as soon as it takes anything again.
        assert texts(stalled, "dropped")["ticks"] > 0


def test_a_viewer_that_leaves_is_forgotten_and_too_many_are_refused(served):
    with contextlib.ExitStack() as stack:
        for _ in range(MAX_VIEWERS):
            stack.enter_context(served.viewer())
        until(lambda: len(served.server.viewers) == MAX_VIEWERS)
        with pytest.raises(InvalidStatus, match="503"):
            served.viewer()
    until(lambda: not served.server.viewers)
    raw = socket.create_connection(("127.0.0.1", served.server.port))
    raw.sendall(b"GET / HT")
    raw.close()  # a browser that leaves in the middle of a word
    assert served.get(f"/{served.server.token}/")[0] == 200


def test_a_port_in_use_is_one_clear_error(served):
    taken = LiveServer(served.session, None, port=served.server.port)
    with pytest.raises(ConfigError, match=r"cannot listen on 127\.0\.0\.1, port \d+.*another --port"):
        asyncio.run(taken.run(asyncio.Event()))
    with pytest.raises(ConfigError, match="cannot listen on"):
        asyncio.run(LiveServer(served.session, None, host="192.0.2.1").run(asyncio.Event()))


def test_requests_beyond_the_allowed_rate_are_left_out():
    class Quiet:
        class transport:
            @staticmethod
            def get_extra_info(name: str) -> None:
                return None

    async def ask() -> int:
        viewer = Viewer(Quiet())
        return sum(viewer.may_ask() for _ in range(500))

    assert 30 <= asyncio.run(ask()) < 100
